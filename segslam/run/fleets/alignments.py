"""Alignments of submaps kept in files, one for each pair of drives, so that a component is adjusted again quickly."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from segslam.core.config import RefineConfig
from segslam.core.trajectory import Poses
from segslam.core.types import SegslamError
from segslam.run.fleets.drives import key_of
from segslam.slam.adjustment import Adjustment
from segslam.slam.adjustment.alignment import Alignment
from segslam.slam.adjustment.known import Compute, Guess

Key = tuple[int, ...]
"""Keyframes of the target and of the source by their own drives, and the rounded initial guess."""
Kept = Mapping[Key, Alignment | None]
ROW = np.dtype(
    [
        ("key", np.int64, 8),
        ("converged", bool),
        ("T_target_source", np.float64, (4, 4)),
        ("information", np.float64, (6, 6)),
        ("overlap", np.float64),
    ]
)


class Part(NamedTuple):
    """A drive in a component."""

    name: str
    key: str
    """A hash of all that its submaps depend on."""
    num_keyframes: int


def part_of(
    name: str, drive_key: str, T_own_keyframe: Poses, adjustment: Adjustment | None, *, config: RefineConfig
) -> Part:
    """A drive with the key of its submaps: of the recording and its settings, of the poses and the corrections that
    its own run found, and of the settings of the component."""
    poses = hashlib.sha256(T_own_keyframe.tobytes()).hexdigest()
    corrections = None if adjustment is None else (adjustment.correction_deg, adjustment.sweep)
    key = key_of(drive_key, poses, corrections, config.model_dump())
    return Part(name, key, len(T_own_keyframe))


class Alignments:
    """The alignments between the drives of a component: those kept in files, or new ones."""

    def __init__(self, folder: Path, parts: Sequence[Part]) -> None:
        self._folder, self._parts = folder, parts
        self._first_ids = np.cumsum([0, *(part.num_keyframes for part in parts)])
        self._files: dict[Path, dict[Key, Alignment | None]] = {}
        self._changed = set[Path]()

    def __call__(self, target_id: int, source_id: int, guess: Guess, compute: Compute) -> Alignment | None:
        """As `known.Kept`. Raises SegslamError, naming the file, if it is damaged."""
        ends = np.array([target_id, source_id])
        drives = np.searchsorted(self._first_ids, ends, side="right") - 1
        target, source = (self._parts[number] for number in drives)
        file = self._folder / f"{source.name} in {target.name}-{key_of(target.key, source.key)}.npy"
        if file not in self._files:
            self._files[file] = read_alignments(file) if file.exists() else {}
        kept, key = self._files[file], (*(ends - self._first_ids[drives]).tolist(), *guess)
        if key not in kept:
            kept[key] = compute()
            self._changed.add(file)
        return kept[key]

    def changed(self) -> Iterator[tuple[Path, Kept]]:
        """The files with new alignments, and their whole content."""
        for file in sorted(self._changed):
            yield file, self._files[file]


def write_alignments(file: Path, kept: Kept) -> None:
    """Write alignments, in the order of their keys, without loss."""
    rows = np.zeros(len(kept), ROW)
    for row, (key, found) in zip(rows, sorted(kept.items()), strict=True):
        row["key"], row["converged"] = key, found is not None
        if found is not None:
            row["T_target_source"], row["information"] = found.T_target_source, found.information
            row["overlap"] = found.overlap
    np.save(file, rows)


def read_alignments(file: Path) -> dict[Key, Alignment | None]:
    """Raises SegslamError, naming the file, if it is damaged."""
    try:
        rows = np.load(file)
        if rows.dtype != ROW or rows.ndim != 1:
            raise ValueError(f"rows of {rows.dtype}")
    except (OSError, ValueError, EOFError) as error:
        raise SegslamError(f"{file}: damaged ({error!r}); remove it, and call `segslam fleet` again") from error
    return {
        tuple(key.tolist()): Alignment(T, information, float(overlap)) if converged else None
        for key, converged, T, information, overlap in rows
    }

"""What a fleet keeps in a file for each pair of drives: their relation, and alignments of submaps."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from segslam.core import whole_files
from segslam.core.config import RefineConfig
from segslam.core.trajectory import Poses
from segslam.output.log.records import codec
from segslam.run.fleets.drives import key_of
from segslam.slam.adjustment.alignment import Alignment
from segslam.slam.adjustment.known import Compute, Guess
from segslam.slam.adjustment.rounds import Adjustment

unless_damaged = partial(whole_files.unless_damaged, remedy="remove it, and call `segslam fleet` again")

Key = tuple[int, ...]
"""Keyframes of the target and of the source by their own drives, and the rounded initial guess."""


@dataclass(frozen=True, slots=True, eq=False)
class KeptAlignment:
    """An alignment, as a file has it."""

    key: Key
    found: Alignment | None
    """None if it did not converge."""


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
        file = self._folder / f"{source.name} in {target.name}-{key_of(target.key, source.key)}.json"
        if file not in self._files:
            rows = read_kept(file, tuple[KeptAlignment, ...]) if file.exists() else ()
            self._files[file] = {one.key: one.found for one in rows}
        kept, key = self._files[file], (*(ends - self._first_ids[drives]).tolist(), *guess)
        if key not in kept:
            kept[key] = compute()
            self._changed.add(file)
        return kept[key]

    def changed(self) -> Iterator[tuple[Path, tuple[KeptAlignment, ...]]]:
        """The files with new alignments, and their whole content, in the order of the keys."""
        for file in sorted(self._changed):
            yield file, tuple(KeptAlignment(key, found) for key, found in sorted(self._files[file].items()))


def write_kept(file: Path, kind: Any, value: Any) -> None:
    """A value of this type, a record or a tuple of them, as JSON without loss."""
    file.write_text(json.dumps(codec(kind).encode(value)) + "\n", encoding="utf-8")


def read_kept(file: Path, kind: Any) -> Any:
    """Raises SegslamError, naming the file, if it is damaged."""
    with unless_damaged(file):
        return codec(kind).decode(json.loads(file.read_text(encoding="utf-8")), {})

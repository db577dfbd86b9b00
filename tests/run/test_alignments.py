"""Alignments of submaps that are kept in files, and what they depend on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.types import SegslamError
from segslam.run.fleets.kept import Alignments, KeptAlignment, Part, part_of, read_kept, write_kept
from segslam.slam.adjustment.alignment import Alignment
from segslam.slam.adjustment.known import Guess
from segslam.slam.adjustment.rounds import Adjustment

RNG = np.random.default_rng(5)
FOUND = Adjustment(9, 8, 0, 1.0, 1.0, 0.2, True, 1.0, sweep_s=0.1, sweep_sigma_s=0.002, sweep_from_deg=180.0)
GUESS: Guess = (0, 0, 314, 4, -1, 0)
MONDAY, FRIDAY = Part("monday", "key of monday", 10), Part("friday", "key of friday", 20)


def _alignment() -> Alignment:
    return Alignment(geometry.exp(RNG.normal(size=6)), RNG.normal(size=(6, 6)), 0.4)


def _equal(one: Alignment | None, other: Alignment | None) -> bool:
    if one is None or other is None:
        return one is other
    return (
        np.array_equal(one.T_target_source, other.T_target_source)
        and np.array_equal(one.information, other.information)
        and one.overlap == other.overlap
    )


def _computed(alignments: Alignments, target_id: int, source_id: int, guess: Guess = GUESS) -> bool:
    """Whether an alignment is computed, not kept."""
    calls = []
    alignments(target_id, source_id, guess, lambda: calls.append(1))
    return bool(calls)


def _kept(folder: Path) -> Alignment:
    """Keyframe 3 of friday in keyframe 2 of monday, kept in a file."""
    found = _alignment()
    alignments = Alignments(folder, [MONDAY, FRIDAY])
    assert alignments(2, 10 + 3, GUESS, lambda: found) is found
    ((file, kept),) = alignments.changed()
    write_kept(file, tuple[KeptAlignment, ...], kept)
    return found


def test_a_kept_alignment_is_used_wherever_its_drives_stand_in_a_component(tmp_path: Path) -> None:
    found = _kept(tmp_path)
    alignments = Alignments(tmp_path, [Part("sunday", "key of sunday", 7), MONDAY, FRIDAY])

    def computed() -> Alignment | None:
        raise AssertionError

    again = alignments(7 + 2, 17 + 3, GUESS, computed)
    assert _equal(again, found)
    assert list(alignments.changed()) == []


def test_another_guess_pair_of_keyframes_or_order_of_the_drives_is_computed(tmp_path: Path) -> None:
    _kept(tmp_path)
    assert not _computed(Alignments(tmp_path, [MONDAY, FRIDAY]), 2, 13)
    assert _computed(Alignments(tmp_path, [MONDAY, FRIDAY]), 2, 13, (0, 0, 314, 4, -1, 1))
    assert _computed(Alignments(tmp_path, [MONDAY, FRIDAY]), 2, 14)
    assert _computed(Alignments(tmp_path, [MONDAY, FRIDAY]), 1, 13)
    assert _computed(Alignments(tmp_path, [FRIDAY, MONDAY]), 3, 22)


@pytest.mark.parametrize("changed", [0, 1])
def test_alignments_of_a_drive_that_was_mapped_otherwise_are_computed(tmp_path: Path, changed: int) -> None:
    _kept(tmp_path)
    parts = [MONDAY, FRIDAY]
    parts[changed] = parts[changed]._replace(key="another")
    assert _computed(Alignments(tmp_path, parts), 2, 13)


def test_the_key_of_a_drive_contains_recording_settings_poses_and_correction() -> None:
    poses = np.stack([geometry.exp(RNG.normal(size=6)) for _ in range(3)])
    moved = poses.copy()
    moved[2, 0, 3] += 1e-9
    settings = RefineConfig()
    parts = [
        part_of("monday", "key", poses, FOUND, config=settings),
        part_of("monday", "key of another version", poses, FOUND, config=settings),
        part_of("monday", "key", moved, FOUND, config=settings),
        part_of("monday", "key", poses, None, config=settings),
        part_of("monday", "key", poses, replace(FOUND, correction_deg=0.1), config=settings),
        part_of("monday", "key", poses, replace(FOUND, sweep_s=0.05), config=settings),
        part_of("monday", "key", poses, FOUND, config=settings.model_copy(update={"voxel_m": 0.7})),
    ]
    assert parts[0] == part_of("monday", "key", poses.copy(), replace(FOUND), config=RefineConfig())
    assert len({part.key for part in parts}) == len(parts)


def test_alignments_are_read_as_they_were_written(tmp_path: Path) -> None:
    computed = {(3, 5): _alignment(), (3, 4): None, (0, 9): _alignment()}
    alignments = Alignments(tmp_path, [MONDAY])
    for (target_id, source_id), found in computed.items():
        alignments(target_id, source_id, GUESS, lambda found=found: found)
    ((file, kept),) = alignments.changed()
    assert [one.key for one in kept] == [(*pair, *GUESS) for pair in sorted(computed)], "not as they were computed"
    write_kept(file, tuple[KeptAlignment, ...], kept)
    again = read_kept(file, tuple[KeptAlignment, ...])
    assert [one.key for one in again] == [one.key for one in kept]
    assert all(_equal(one.found, computed[one.key[:2]]) for one in again)


@pytest.mark.parametrize("content", [b"", b"no JSON", b"[3]", b'{"key": 3}'])
def test_a_damaged_file_is_named(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "kept.json"
    file.write_bytes(content)
    with pytest.raises(SegslamError, match=r"kept\.json: damaged"):
        read_kept(file, tuple[KeptAlignment, ...])

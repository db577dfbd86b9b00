"""Lists of scan pairs, from files or selected by true poses as in the paper, and their trials.

A trial is two scans, each possibly rotated or with labels removed, and their true relative pose.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core import geometry
from segslam.core.errors import brief
from segslam.core.trajectory import ROTATION_TOLERANCE, rows_of_same_scan
from segslam.core.types import IndexPairs, Label, Labels, Points, SegslamError, Trajectory, Transform
from segslam.core.whole_files import read_text

MIN_GAP = 50
"""Smallest number of scans between the two of a pair, as in the paper's lists."""


@dataclass(frozen=True, slots=True, eq=False)
class PairList:
    """Pairs of scans, `pairs` (n, 2): numbers of source and target."""

    name: str
    pairs: IndexPairs
    num_whole: int
    """Number of pairs before sampling."""
    truth: Mapping[tuple[int, int], Transform] | None = None
    """T_target_source of each pair if the list contains it; otherwise the data set's poses are used."""


PAPER_PAIR = PairList("0 and 10", np.array([[0, 10]]), 1)
"""The scans of 05 with which the paper tests rotation and removal of labels."""


def read_pairs(file: Path) -> PairList:
    """A list from a text file with `source target` per line, or from a JSON list of {source, target, T_target_source}.

    Raises SegslamError, naming file and line, for another form.
    """
    text = read_text(file, "pairs", "give a file with `source target` on each line")
    pairs = _from_json(file, text) if file.suffix == ".json" else _from_text(file, text)
    if len(pairs.pairs) == 0:
        raise SegslamError(f"{file}: contains no pairs; write `source target` on each line")
    return pairs


def cut_pairs(reference: Trajectory, *, name: str, min_m: float, max_m: float, min_gap: int = MIN_GAP) -> PairList:
    """All pairs, older scan first, that are `min_m` to `max_m` apart and at least `min_gap` scans apart in time."""
    positions = reference.T_world_lidar[:, :3, 3]
    found = [np.empty((0, 2), dtype=int)]
    for row, index in enumerate(reference.scan_index):
        later = np.flatnonzero(reference.scan_index >= index + min_gap)
        distance_m = np.linalg.norm(positions[later] - positions[row], axis=1)
        chosen = later[(distance_m >= min_m) & (distance_m < max_m)]
        found.append(np.column_stack([np.full(len(chosen), index), reference.scan_index[chosen]]))
    pairs = np.concatenate(found)
    return PairList(name, pairs, len(pairs))


def sample_pairs(whole: PairList, *, num_pairs: int | None, seed: int) -> PairList:
    """A random sample of `num_pairs` pairs, in the order of the list; all if there are not more, or for None."""
    if num_pairs is None or num_pairs >= len(whole.pairs):
        return whole
    rows = np.random.default_rng(seed).choice(len(whole.pairs), num_pairs, replace=False)
    return replace(whole, pairs=whole.pairs[np.sort(rows)])


def scans_named(lists: Sequence[PairList]) -> set[int]:
    """Numbers of all scans in the lists."""
    return set(chain.from_iterable(one.pairs.ravel().tolist() for one in lists))


def true_poses(pairs: PairList, reference: Trajectory | None) -> dict[tuple[int, int], Transform]:
    """T_target_source of each pair (source, target). Raises SegslamError for a pair without known true pose."""
    keys = [(int(source), int(target)) for source, target in pairs.pairs]
    if pairs.truth is not None:
        return {key: pairs.truth[key] for key in keys}
    if reference is None:
        raise SegslamError(
            f"{pairs.name}: the data has no true poses; put KITTI's poses/NN.txt there, or give a JSON list with poses"
        )
    numbers = np.array(sorted(scans_named([pairs])), dtype=int)
    rows = rows_of_same_scan(numbers, reference.scan_index)
    if len(rows) < len(numbers):
        missing = np.setdiff1d(numbers, numbers[rows[:, 0]])
        raise SegslamError(
            f"{pairs.name}: scan {missing[0]} has no true pose, nor have {len(missing) - 1} other scans; put them "
            "there, or give a list whose scans all have one"
        )
    T_world = dict(zip(numbers[rows[:, 0]].tolist(), reference.T_world_lidar[rows[:, 1]], strict=True))
    return {(source, target): geometry.inverse(T_world[target]) @ T_world[source] for source, target in keys}


def _from_text(file: Path, text: str) -> PairList:
    pairs = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 2 or not all(word.isdecimal() and len(word) < 19 for word in words[:2]):
            raise SegslamError(f"{file}:{number}: expected two scan numbers, source and target, found {line.strip()!r}")
        pairs.append((int(words[0]), int(words[1])))
    return PairList(file.stem, np.array(pairs, dtype=int).reshape(-1, 2), len(pairs))


def _from_json(file: Path, text: str) -> PairList:
    try:
        truth = {(int(row["source"]), int(row["target"])): _rigid(row["T_target_source"]) for row in json.loads(text)}
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise SegslamError(
            f"{file}: expected a list of objects with source, target and T_target_source (4x4): {error}"
        ) from error
    pairs = np.array(list(truth), dtype=int).reshape(-1, 2)
    return PairList(file.stem, pairs, len(pairs), truth)


def _rigid(values: Any) -> Transform:
    """The transform of 16 numbers by rows. Raises ValueError unless they are one."""
    matrix = np.array(values, dtype=float).reshape(4, 4)
    if np.isfinite(matrix).all():
        T_target_source = geometry.nearest_transform(matrix)
        if np.abs(matrix - T_target_source).max() <= ROTATION_TOLERANCE:
            return T_target_source
    raise ValueError(f"{brief(str(values))} is not a rigid transform")


@dataclass(frozen=True, slots=True)
class ScanVariant:
    """A scan, and the changes applied to it before registration."""

    index: int
    yaw_deg: float = 0.0
    """Rotation about z."""
    lost: float = 0.0
    """Share of the points, 0 to 1, whose labels are removed."""
    draw: int = 0
    """Number of the random draw of those points."""

    @property
    def T_variant_scan(self) -> Transform:  # noqa: N802  (a transform)
        """The rotation as a transform."""
        return geometry.transform(geometry.yaw(math.radians(self.yaw_deg)), 0.0)

    def turned(self, points: Points) -> Points:
        """The points of the scan in the frame of this variant."""
        return geometry.apply(self.T_variant_scan, points).astype(points.dtype) if self.yaw_deg else points

    def remaining(self, labels: Labels) -> Labels:
        """The labels of the scan, with the removed ones set to UNLABELLED."""
        if not self.lost:
            return labels
        lost = np.random.default_rng([self.draw, self.index]).random(len(labels)) < self.lost
        return np.where(lost, np.uint8(Label.UNLABELLED), labels)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A pair of variants to register; `T_target_source` is the true pose between the variants."""

    pairs: str
    """Name of the list that contains the pair."""
    source: ScanVariant
    target: ScanVariant
    T_target_source: Transform

    @property
    def key(self) -> tuple[str, ScanVariant, ScanVariant]:
        """Identifies the trial."""
        return self.pairs, self.source, self.target


def pair_trials(
    pairs: PairList,
    reference: Trajectory | None,
    *,
    step_deg: float = 360.0,
    lost_percent: Sequence[float] = (0.0,),
    num_draws: int = 1,
    seed: int = 0,
    both: bool = False,
) -> list[Trial]:
    """The trials of each pair; by default one, of the unchanged scans.

    The source is rotated about z in steps of `step_deg`. Each of the shares `lost_percent` of its labels is removed
    `num_draws` times at random (a share of 0 once), with `both` also from the target. Raises SegslamError for a pair
    without known true pose.
    """
    trials = []
    draws = range(seed * num_draws, (seed + 1) * num_draws)
    losses = [(percent, draw) for percent in lost_percent for draw in (draws if percent else (0,))]
    for (source, target), T_target_source in true_poses(pairs, reference).items():
        for yaw_deg, (percent, draw) in product(np.arange(0.0, 360.0, step_deg), losses):
            moved = ScanVariant(source, float(yaw_deg), percent / 100, draw)
            fixed = ScanVariant(target, lost=percent / 100, draw=draw) if both else ScanVariant(target)
            T_true = fixed.T_variant_scan @ T_target_source @ geometry.inverse(moved.T_variant_scan)
            trials.append(Trial(pairs.name, moved, fixed, T_true))
    return trials

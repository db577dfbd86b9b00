"""Pairs of scans whose poses are known, real and simulated, each registered, verified and described."""

import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.pose_files import read_poses
from segslam.core.threads import Stopwatch
from segslam.core.trajectory import Poses
from segslam.core.types import Rejected
from segslam.registration.prepared import PreparedScan
from segslam.scans import Dataset, open_dataset
from segslam.verification import register_prepared
from segslam.verification.pair import tried_poses
from segslam.verification.rivals import rivals_of
from segslam.verification.trial import Trial
from tools.benchmarks import common
from tools.benchmarks.registration.scans import courtyard_points
from tools.benchmarks.scenes import Task, prepared_keyframe
from tools.benchmarks.score.ratio import Pair, Pose
from tools.benchmarks.submaps import NEAR_M, Submaps, drive_pairs

GAP = 40
"""Scans between the two of a pair of a real drive, at least."""
TRUTH_KITTI = 3.0, 3.0
"""m, degrees: the truth of KITTI's thinned keyframes is off by up to 0.8 m along the road, and its own revisits."""
SEARCH_SHARE, RIVAL_SHARE = 0.99, 1e-9
"""Rivals are searched of poses that fit as well as this `verify.max_false_share` asks, so also of ones that would be
rejected without rivals, and none is dropped that matters for this one, so that no lead is unknown."""
DAYS = ("_0", "_1", "_2", "_3")
"""Ends of the names of the drives through a town."""


def described(task: Task, config: Config) -> Pair:
    """What the scans show at the poses that the registration tries, and its verdict."""
    started = time.process_time()
    found = register_prepared(task.source, task.target, config=config, gate=task.gate)
    seconds = time.process_time() - started
    verdict = common.verdict(found, task.T_target_source, task.tolerance)
    trial, strict = (
        Trial(task.source, task.target, _asking(share, config), task.gate, Stopwatch())
        for share in (SEARCH_SHARE, RIVAL_SHARE)
    )
    tried = tried_poses(trial)
    tried = [] if isinstance(tried, Rejected) else tried
    is_searched = bool(tried) and trial.fits(tried[0])
    if is_searched:
        tried += rivals_of(tried[0], tried, strict)
    poses = [
        Pose(
            one.T_target_source,
            one.agreement.of_source,
            one.agreement.of_target,
            common.is_right(one.T_target_source, task.T_target_source, task.tolerance),
            task.gate(one.T_target_source, slack_m=0.0) is None,
        )
        for one in tried
    ]
    return Pair(task.part, task.sensor, task.is_true, task.overlap, poses, verdict, seconds, is_searched)


def _asking(share: float, config: Config) -> Config:
    return config.model_copy(update={"verify": config.verify.model_copy(update={"max_false_share": share})})


def of_drive(part: str, data: Path, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """True and false pairs of a real drive, without a prior; the courtyard is too small for false ones."""
    rng = np.random.default_rng([seed, 10])
    prepared, T_world_lidar = _drive(part, data, config)
    tolerance = TRUTH_KITTI if part == "kitti_whole" else common.RIGHT
    for is_true in (True, False):
        for source, target in drive_pairs(T_world_lidar, count, rng, near=is_true, gap=GAP):
            T_true = geometry.inverse(T_world_lidar[target]) @ T_world_lidar[source]
            yield Task(part, "real", prepared(source), prepared(target), T_true, is_true, tolerance=tolerance)


def of_towns(data: Path, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """Pairs of drives through a simulated town on two days, and through two towns, without a prior."""
    rng = np.random.default_rng([seed, 11])
    drives: dict[str, list[tuple[Callable[[int], PreparedScan], np.ndarray]]] = {}
    for folder in sorted(path for path in (data / "town").iterdir() if path.name[-2:] in DAYS):
        scans = open_dataset(folder)
        assert scans.reference is not None
        prepared = _prepared(scans, config)
        drives.setdefault(folder.name[:-2], []).append((prepared, scans.reference.T_world_lidar))
    names = sorted(drives)
    for number, name in enumerate(names):
        (here, T_here), (later, T_later) = (
            drives[name][day] for day in rng.choice(len(drives[name]), 2, replace=False)
        )
        near = np.linalg.norm(T_later[:, None, :3, 3] - T_here[:, :3, 3], axis=-1) < NEAR_M
        for source, target in common.draw_pairs(near, count, rng):
            T_true = geometry.inverse(T_here[target]) @ T_later[source]
            yield Task("town", name, later(source), here(target), T_true, True)
        other, T_other = drives[names[number - 1]][0]
        for source, target in rng.integers([len(T_other), len(T_here)], size=(count, 2)).tolist():
            yield Task("town", name, other(source), here(target), None, False)


def _drive(part: str, data: Path, config: Config) -> tuple[Callable[[int], PreparedScan], Poses]:
    """Prepared scans by their row, and their poses."""
    if part == "nclt":
        submaps = Submaps(data / "nclt", config)
        return submaps.prepared, submaps.T_world_lidar
    poses = read_poses(data / part / "poses.txt").T_a_b
    if part == "courtyard":
        return cache(lambda row: prepared_keyframe(courtyard_points(data, row), config)), poses
    return _prepared(open_dataset(data / part), config), poses


def _prepared(scans: Dataset, config: Config) -> Callable[[int], PreparedScan]:
    return cache(lambda row: prepared_keyframe(scans[row].points, config))

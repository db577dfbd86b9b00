"""Pairs of scans whose poses are known, real and simulated, each registered, verified and described."""

import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import PoseError
from segslam.core.threads import Stopwatch
from segslam.core.types import Alignment, Points, Rejected, Transform
from segslam.keyframes import downsample_keyframe
from segslam.labels import geometric_labels
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.scans import Dataset, open_dataset
from segslam.verification import register_prepared
from segslam.verification.pair import tried_poses
from segslam.verification.patches import agreement
from segslam.verification.trial import Gate, Trial, anywhere
from tools.benchmarks import common, scenes
from tools.benchmarks.registration.scans import courtyard_points
from tools.benchmarks.scene_models import SCENES
from tools.benchmarks.score.ratio import Pair, Pose
from tools.benchmarks.submaps import Submaps, poses_of

SEEN_M, APART_M, GAP = 20.0, 100.0, 40
"""Pairs of real drives: scans this near and this many later are true ones, farther than `APART_M` false ones."""
TRUTH_KITTI = 3.0, 3.0
"""m, degrees: the truth of KITTI's thinned keyframes is off by up to 0.8 m along the road, and its own revisits."""
SEARCH_SHARE = 0.99
"""Poses are searched as for this `verify.max_false_share`: also around poses that would be rejected without rivals."""
DAYS = ("_0", "_1", "_2", "_3")
"""Ends of the names of the drives through a town."""
TRUTH = common.RIGHT_M, common.RIGHT_DEG


class Task(NamedTuple):
    """Two scans of a part, and what is known about their pose."""

    part: str
    sensor: str
    source: PreparedScan
    target: PreparedScan
    T_target_source: Transform | None
    """None for scans of different worlds."""
    is_true: bool
    gate: Gate
    tolerance: tuple[float, float]


def described(task: Task, config: Config) -> Pair:
    """What the scans show at the poses that the registration tries, and its verdict."""

    def is_right(T_target_source: Transform) -> bool:
        if task.T_target_source is None:
            return False
        return PoseError.of(geometry.inverse(task.T_target_source) @ T_target_source).within(*task.tolerance)

    started = time.process_time()
    found = register_prepared(task.source, task.target, config=config, gate=task.gate)
    seconds = time.process_time() - started
    verdict = "wrong" if isinstance(found, Alignment) else found.reason.value
    if isinstance(found, Alignment) and is_right(found.fine.T_target_source):
        verdict = "right"
    searching = config.model_copy(update={"verify": config.verify.model_copy(update={"max_false_share": SEARCH_SHARE})})
    trial = Trial(task.source, task.target, searching, task.gate, Stopwatch())
    tried = tried_poses(trial)
    tried = [] if isinstance(tried, Rejected) else tried
    poses = [
        Pose(
            one.T_target_source,
            one.agreement.of_source,
            one.agreement.of_target,
            is_right(one.T_target_source),
            task.gate(one.T_target_source, slack_m=0.0) is None,
        )
        for one in tried
    ]
    overlap = 0.0
    if task.is_true and task.T_target_source is not None:
        overlap = agreement(task.source, task.target, task.T_target_source).overlap
    is_searched = bool(tried) and trial.fits(tried[0])
    return Pair(task.part, task.sensor, task.is_true, overlap, poses, verdict, seconds, is_searched)


def of_scene(name: str, sensor: str, noise_m: float, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """True and false pairs of a scene in turn, as `tools.benchmarks.scenes` draws them."""
    rng = np.random.default_rng([seed, 9])
    here, elsewhere = (
        scenes.Place(SCENES[name](other), sensor, noise_m, other, config) for other in (seed, seed + scenes.ELSEWHERE)
    )

    def visits() -> tuple[int, int]:
        return int(rng.integers(2)), int(rng.integers(2)) + 2

    for source, target in scenes.true_pairs(here.scene, count, rng):
        first, second = visits()
        T_source, T_target = here.pose(source, first), here.pose(target, second)
        T_true = geometry.inverse(T_target) @ T_source
        prior = scenes.near(scenes.prior(T_true, rng), config)
        scans = here.prepared(source, first), here.prepared(target, second)
        yield Task(name, sensor, *scans, T_true, True, prior, TRUTH)
    for number, (source, target) in enumerate(scenes.false_pairs(here.scene, count, rng)):
        place = here if number % 2 else elsewhere
        source %= len(place.scene.path)
        first, second = visits()
        T_near = scenes.beside(here.scene, source, target, rng, is_same=place is here)
        T_true = geometry.inverse(here.pose(target, second)) @ place.pose(source, first)
        scans = place.prepared(source, first), here.prepared(target, second)
        prior = scenes.near(scenes.prior(T_near, rng), config)
        yield Task(name, sensor, *scans, T_true if place is here else None, False, prior, TRUTH)


def of_drive(part: str, data: Path, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """True and false pairs of a real drive, without a prior; the courtyard is too small for false ones."""
    rng = np.random.default_rng([seed, 10])
    prepared, T_world_lidar = _drive(part, data, config)
    at = T_world_lidar[:, :3, 3]
    apart_m = np.linalg.norm(at[:, None] - at, axis=-1)
    is_later = np.arange(len(at))[:, None] - np.arange(len(at)) > GAP
    near = common.draw_pairs(is_later & (apart_m < SEEN_M), count, rng)
    far = common.draw_pairs(is_later & (apart_m > APART_M), count, rng)
    for is_true, drawn in ((True, near), (False, far)):
        for source, target in drawn:
            T_true = geometry.inverse(T_world_lidar[target]) @ T_world_lidar[source]
            tolerance = TRUTH_KITTI if part == "kitti_whole" else TRUTH
            yield Task(part, "real", prepared(source), prepared(target), T_true, is_true, anywhere, tolerance)


def of_towns(data: Path, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """Pairs of drives through a simulated town on two days, and through two towns, without a prior."""
    rng = np.random.default_rng([seed, 11])
    drives: dict[str, list[tuple[Callable[[int], PreparedScan], np.ndarray]]] = {}
    for folder in sorted(path for path in (data / "town").iterdir() if path.name[-2:] in DAYS):
        scans = open_dataset(folder)
        assert scans.reference is not None
        prepared = _preparer(partial(_points_of, scans), config)
        drives.setdefault(folder.name[:-2], []).append((prepared, scans.reference.T_world_lidar))
    names = sorted(drives)
    for number, name in enumerate(names):
        (here, T_here), (later, T_later) = (
            drives[name][day] for day in rng.choice(len(drives[name]), 2, replace=False)
        )
        near = np.linalg.norm(T_later[:, None, :3, 3] - T_here[:, :3, 3], axis=-1) < SEEN_M
        for source, target in common.draw_pairs(near, count, rng):
            T_true = geometry.inverse(T_here[target]) @ T_later[source]
            yield Task("town", name, later(source), here(target), T_true, True, anywhere, TRUTH)
        other, T_other = drives[names[number - 1]][0]
        for source, target in rng.integers([len(T_other), len(T_here)], size=(count, 2)).tolist():
            yield Task("town", name, other(source), here(target), None, False, anywhere, TRUTH)


def _points_of(scans: Dataset, row: int) -> Points:
    return scans[row].points


def _drive(part: str, data: Path, config: Config) -> tuple[Callable[[int], PreparedScan], np.ndarray]:
    """Prepared scans by their row, and their poses."""
    if part == "nclt":
        submaps = Submaps(data / "nclt", config)
        return submaps.prepared, submaps.T_world_lidar
    if part == "courtyard":
        return _preparer(partial(courtyard_points, data), config), poses_of(data / "courtyard" / "poses.txt")
    scans = open_dataset(data / part)
    return _preparer(partial(_points_of, scans), config), poses_of(data / part / "poses.txt")


def _preparer(points_of: Callable[[int], Points], config: Config) -> Callable[[int], PreparedScan]:
    def prepared(row: int) -> PreparedScan:
        points = points_of(row)
        labels = geometric_labels(points)
        classes = tuple(config.segregator.cluster_min_points)
        points, labels, _ = downsample_keyframe(points, labels, config=config.keyframes, whole_classes=classes)
        return prepare_scan(points, labels, config=config)

    return cache(prepared)

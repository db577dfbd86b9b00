"""Pairs of scans whose poses are known, real and simulated, each registered, verified and described."""

import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from segslam.bench.simulation.scenes import SCENES
from segslam.candidates.prior import far_from_prior
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import PoseError
from segslam.core.stopwatch import Stopwatch
from segslam.core.types import Alignment, LoopCandidate, Points, Rejected, Rotation, Transform
from segslam.keyframes.keyframes import downsample_keyframe
from segslam.labels import geometric_labels
from segslam.registration import refinement
from segslam.registration.hypotheses import Gate, anywhere
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.scans import open_dataset
from segslam.verification import gates, register_prepared
from segslam.verification.noise_floor import NeighbourNoise
from segslam.verification.trial import Trial
from tools.benchmarks import common, scenes
from tools.benchmarks.registration.scans import courtyard_points
from tools.benchmarks.score.evidence import Counts, evidence
from tools.benchmarks.score.poses import tried
from tools.benchmarks.score.ratio import Pair, Pose, Run
from tools.benchmarks.submaps import Submaps, poses_of

SEEN_M, APART_M, GAP = 20.0, 100.0, 40
"""Pairs of real drives: scans this near and this many later are true ones, farther than `APART_M` false ones."""
TRUTH_KITTI = 2.0, 3.0
"""m, degrees: the truth of KITTI's thinned keyframes is off by up to 0.8 m along the road, and its own revisits."""
NUM_NEIGHBOURS, NEIGHBOURS_M = 4, (2.0, 4.0, 8.0)
"""Places along a drive whose neighbours are registered, and how far these are."""
TRUTH = common.RIGHT_M, common.RIGHT_DEG


class Task(NamedTuple):
    """Two scans of a part, and what is known about their pose."""

    run: Run
    source: PreparedScan
    target: PreparedScan
    T_target_source: Transform | None
    """None for scans of different worlds."""
    is_true: bool
    gate: Gate
    floor: gates.NoiseFloor
    tolerance: tuple[float, float]


def described(task: Task, config: Config) -> Pair:
    """The verdict of the gates, and the evidence at the poses that are scored."""

    def is_right(T_target_source: Transform) -> bool:
        if task.T_target_source is None:
            return False
        return PoseError.of(geometry.inverse(task.T_target_source) @ T_target_source).within(*task.tolerance)

    started = time.process_time()
    found = register_prepared(task.source, task.target, config=config, gate=task.gate, floor=task.floor)
    seconds = time.process_time() - started
    verdict = "wrong" if isinstance(found, Alignment) else found.reason.value
    if isinstance(found, Alignment) and is_right(found.fine.T_target_source):
        verdict = "right"
    allowed = gates.limits(task.floor, config=config.verify)
    trial = Trial(task.source, task.target, config, task.gate, task.floor, allowed, Stopwatch())
    scans = task.source.observed, task.target.observed
    poses = [Pose(T, evidence(*scans, T, config=config.verify), is_right(T)) for T in tried(trial)]
    return Pair(task.run, task.is_true, poses, verdict, seconds)


def of_scene(name: str, sensor: str, noise_m: float, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """True and false pairs of a scene in turn, as `tools.benchmarks.scenes` draws them."""
    rng = np.random.default_rng([seed, 9])
    here, elsewhere = (
        scenes.Place(SCENES[name](other), sensor, noise_m, other, config) for other in (seed, seed + scenes.ELSEWHERE)
    )
    floor = here.floor()
    run = Run(
        name,
        sensor,
        _neighbours(lambda row: here.prepared(row, 0), lambda row: here.pose(row, 0), here.scene.path[:, :3], config),
    )

    def gate(T_prior: Transform, R_world_target: Rotation) -> Gate:
        candidate = LoopCandidate(1, 0, T_prior, geometry.distance(T_prior), scenes.RADIUS_M, scenes.CHAIN_M)
        return partial(far_from_prior, candidate=candidate, R_world_target=R_world_target, config=config)

    def visits() -> tuple[int, int]:
        return int(rng.integers(2)), int(rng.integers(2)) + 2

    for source, target in scenes.true_pairs(here.scene, count, rng):
        first, second = visits()
        T_source, T_target = here.pose(source, first), here.pose(target, second)
        T_true = geometry.inverse(T_target) @ T_source
        prior = gate(scenes.prior(T_true, rng), T_target[:3, :3])
        scans = here.prepared(source, first), here.prepared(target, second)
        yield Task(run, *scans, T_true, True, prior, floor, TRUTH)
    for number, (source, target) in enumerate(scenes.false_pairs(here.scene, count, rng)):
        place = here if number % 2 else elsewhere
        source %= len(place.scene.path)
        first, second = visits()
        T_near = scenes.beside(here.scene, source, target, rng, is_same=place is here)
        T_true = geometry.inverse(here.pose(target, second)) @ place.pose(source, first)
        scans = place.prepared(source, first), here.prepared(target, second)
        prior = gate(scenes.prior(T_near, rng), np.eye(3))
        yield Task(run, *scans, T_true if place is here else None, False, prior, floor, TRUTH)


def of_drive(part: str, data: Path, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """True and false pairs of a real drive, without a prior; the courtyard is too small for false ones."""
    rng = np.random.default_rng([seed, 10])
    prepared, T_world_lidar, lag = _drive(part, data, config)
    noise = NeighbourNoise(lambda row: prepared(row).observed, T_world_lidar.__getitem__, lambda _: lag, config=config)
    floor = noise.at(len(T_world_lidar) - 1)
    at = T_world_lidar[:, :3, 3]
    run = Run(part, "real", _neighbours(prepared, T_world_lidar.__getitem__, at, config))
    apart_m = np.linalg.norm(at[:, None] - at, axis=-1)
    is_later = np.arange(len(at))[:, None] - np.arange(len(at)) > GAP
    near = common.draw_pairs(is_later & (apart_m < SEEN_M), count, rng)
    far = common.draw_pairs(is_later & (apart_m > APART_M), count, rng)
    for is_true, drawn in ((True, near), (False, far)):
        for source, target in drawn:
            T_true = geometry.inverse(T_world_lidar[target]) @ T_world_lidar[source]
            tolerance = TRUTH_KITTI if part == "kitti_whole" else TRUTH
            yield Task(run, prepared(source), prepared(target), T_true, is_true, anywhere, floor, tolerance)


def _neighbours(
    prepared: Callable[[int], PreparedScan], T_world: Callable[[int], Transform], at: Points, config: Config
) -> list[Counts]:
    """What pairs along the drive show at their known poses, refined."""
    step_m = float(np.median(np.linalg.norm(np.diff(at, axis=0), axis=1)))
    found = []
    for row in np.linspace(0, len(at) - 1, NUM_NEIGHBOURS).astype(int).tolist():
        for apart_m in NEIGHBOURS_M:
            older = row - max(1, round(apart_m / step_m))
            if older < 0:
                continue
            source, target = prepared(row), prepared(older)
            T_known = geometry.inverse(T_world(older)) @ T_world(row)
            fine = refinement.refine(source.surface, target.surface, T_known, config=config.refine)
            if isinstance(fine, Rejected):
                continue
            if PoseError.of(geometry.inverse(T_known) @ fine.T_target_source).within(*TRUTH_KITTI):
                scans = source.observed, target.observed
                found.append(evidence(*scans, fine.T_target_source, config=config.verify))
    return found


def _drive(part: str, data: Path, config: Config) -> tuple[Callable[[int], PreparedScan], np.ndarray, int]:
    """Prepared scans by their row, their poses, and the rows between neighbours."""
    if part == "nclt":
        submaps = Submaps(data / "nclt", config)
        return submaps.prepared, submaps.T_world_lidar, 11
    if part == "courtyard":
        return _preparer(partial(courtyard_points, data), config), poses_of(data / "courtyard" / "poses.txt"), 1
    scans = open_dataset(data / part)
    return _preparer(lambda row: scans[row].points, config), poses_of(data / part / "poses.txt"), 1


def _preparer(points_of: Callable[[int], Points], config: Config) -> Callable[[int], PreparedScan]:
    def prepared(row: int) -> PreparedScan:
        points = points_of(row)
        labels = geometric_labels(points)
        classes = tuple(config.segregator.cluster_min_points)
        points, labels, _ = downsample_keyframe(points, labels, config=config.keyframes, whole_classes=classes)
        return prepare_scan(points, labels, config=config)

    return cache(prepared)

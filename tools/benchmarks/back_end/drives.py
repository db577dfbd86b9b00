"""Keyframes of real drives: levelled ground truth, and measured or simulated odometry."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np

from segslam.bench.simulation.tracks import level_revisits, level_world
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import trajectory_metrics
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import lidar_from_camera, travelled_m
from segslam.core.types import Alignment, GraphEstimate, LoopClosure, Registration
from segslam.graph import PoseGraph
from segslam.graph.noise import odometry_information
from segslam.keyframes import KeyframeSelector
from segslam.scans.kitti import read_calibration

CONFIG = Config()
CLOSURE_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.1), translation_m=0.05)
STEP_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.03), translation_m=0.02)
"""Noise of drifting odometry per square root of a metre."""
RATE_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.0005), translation_m=0.004)
"""Standard deviation of its slowly varying error, per metre."""
RATE_MEMORY_M = 200.0


FIGURES = ("ate_m", "height_m", "kitti_translation_percent")


@dataclass(frozen=True, eq=False)
class Drive:
    """The keyframes of a drive: true poses and odometry (n, 4, 4), travel (n,)."""

    truth: np.ndarray
    odometry: np.ndarray
    travel_m: np.ndarray

    def errors(self, poses: np.ndarray) -> dict[str, float]:
        metrics = trajectory_metrics(poses, self.truth)
        return {name: metrics[name] for name in FIGURES if name in metrics}

    def true(self, target: int, source: int) -> np.ndarray:
        """T_target_source of two keyframes."""
        return geometry.inverse(self.truth[target]) @ self.truth[source]

    def exact(self, source: int, target: int) -> LoopClosure:
        """An exact loop with the information of a noisy one."""
        return closure(source, target, self.true(target, source))

    def graph(self) -> PoseGraph:
        """The odometry alone."""
        graph = PoseGraph(CONFIG.graph)
        for keyframe_id, (T_odom_keyframe, travel_m) in enumerate(zip(self.odometry, self.travel_m, strict=True)):
            graph.add_keyframe(keyframe_id, T_odom_keyframe, float(travel_m))
        return graph

    def finished(self, closures: Iterable[LoopClosure]) -> tuple[GraphEstimate, dict[str, float], float]:
        """The result of the final optimisation with these closures, the errors after it, and its seconds."""
        graph = self.graph()
        for loop in closures:
            graph.add_closure(loop)
        started = time.perf_counter()
        estimate = graph.finish()
        seconds = time.perf_counter() - started
        return estimate, self.errors(graph.T_world_keyframes), seconds


def closure(
    source: int, target: int, T_target_source: np.ndarray, rng: np.random.Generator | None = None
) -> LoopClosure:
    """A loop, with noise according to its information if there is an `rng`."""
    if rng is not None:
        T_target_source = T_target_source @ geometry.exp(CLOSURE_SIGMAS * rng.normal(size=6))
    registration = Registration(T_target_source, 0, 0, 0.0, np.diag(CLOSURE_SIGMAS**-2.0))
    alignment = Alignment(registration, registration, 1.0, 0.0, 0.0)
    return LoopClosure(source, target, T_target_source, registration.information, alignment)


def read_drive(data: Path, sequence: str, odometry: str, rng: np.random.Generator) -> Drive:
    """`odometry`: measured (trajectories/simple_online_NN.txt), drifting, or what the graph expects or just allows."""
    T_camera_lidar = read_calibration(data / "kitti" / "sequences" / sequence / "calib.txt")
    truth = level_revisits(level_world(_lidar_poses(data / "kitti" / "poses" / f"{sequence}.txt", T_camera_lidar)))
    if odometry == "measured":
        measured = _lidar_poses(data / "trajectories" / f"simple_online_{sequence}.txt", T_camera_lidar)
        rows = _keyframe_rows(measured)
        return Drive(truth[rows], measured[rows], travelled_m(measured)[rows])
    rows = _keyframe_rows(truth)
    if odometry == "drifting":
        drifted = drifting(truth[rows], rng)
    else:
        drifted = claimed(truth[rows], rng, times=CONFIG.graph.error_allowance if odometry == "allowed" else 1.0)
    return Drive(truth[rows], drifted, travelled_m(drifted))


def drifting(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Odometry with a random error at each step and one that varies slowly along the way."""
    rate = RATE_SIGMAS * rng.normal(size=6)

    def error(T_a_b: np.ndarray) -> np.ndarray:
        nonlocal rate
        way_m = geometry.distance(T_a_b)
        kept = np.exp(-way_m / RATE_MEMORY_M)
        rate = kept * rate + np.sqrt(1.0 - kept**2) * RATE_SIGMAS * rng.normal(size=6)
        return rate * way_m + STEP_SIGMAS * np.sqrt(way_m) * rng.normal(size=6)

    return _with_errors(truth, error)


def claimed(truth: np.ndarray, rng: np.random.Generator, *, times: float) -> np.ndarray:
    """Odometry with errors of `times` the graph's noise model."""

    def error(T_a_b: np.ndarray) -> np.ndarray:
        information = odometry_information(geometry.distance(T_a_b), T_a_b, CONFIG.graph)
        return times * np.diag(information) ** -0.5 * rng.normal(size=6)

    return _with_errors(truth, error)


def _with_errors(truth: np.ndarray, error: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    motions = (geometry.inverse(T_a) @ T_b for T_a, T_b in pairwise(truth))
    steps = (T_a_b @ geometry.exp(error(T_a_b)) for T_a_b in motions)
    return np.array(list(accumulate(steps, np.matmul, initial=truth[0])))


def _lidar_poses(path: Path, T_camera_lidar: np.ndarray) -> np.ndarray:
    return lidar_from_camera(read_poses(path).T_a_b, T_camera_lidar)


def _keyframe_rows(poses: np.ndarray) -> list[int]:
    selector = KeyframeSelector(CONFIG.keyframes)
    return [row for row, T_odom_lidar in enumerate(poses) if selector.update(T_odom_lidar)]

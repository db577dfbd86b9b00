"""Keyframes of real drives: levelled ground truth, and measured or simulated odometry."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.bench.simulation.tracks import level_revisits, level_world
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import trajectory_metrics
from segslam.core.trajectory import lidar_from_camera, read_poses, travelled_m
from segslam.core.types import Alignment, LoopClosure, Registration
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


@dataclass(frozen=True, eq=False)
class Drive:
    """The keyframes of a drive."""

    truth: np.ndarray
    odometry: np.ndarray
    travel_m: np.ndarray

    def errors(self, poses: np.ndarray) -> dict[str, float]:
        metrics = trajectory_metrics(poses, self.truth)
        return {"ate_m": metrics["ate_m"], "height_m": metrics["height_m"]}

    def closure(self, source: int, target: int, rng: np.random.Generator) -> LoopClosure:
        """The true relative pose of two keyframes, with noise."""
        return closure(source, target, geometry.inverse(self.truth[target]) @ self.truth[source], rng)


def closure(source: int, target: int, T_target_source: np.ndarray, rng: np.random.Generator) -> LoopClosure:
    """A loop with noise according to its information."""
    return exact_closure(source, target, T_target_source @ geometry.exp(CLOSURE_SIGMAS * rng.normal(size=6)))


def exact_closure(source: int, target: int, T_target_source: np.ndarray) -> LoopClosure:
    """An exact loop with the information of a noisy one."""
    registration = Registration(T_target_source, 0, 0, 0.0, np.diag(CLOSURE_SIGMAS**-2.0))
    alignment = Alignment(registration, registration, 1.0, 0.0, 0.0)
    return LoopClosure(source, target, T_target_source, registration.information, alignment)


def exact(loops: Iterable[LoopClosure], truth: np.ndarray) -> list[LoopClosure]:
    """Exact loops between the same keyframes."""
    return [
        exact_closure(loop.source_id, loop.target_id, geometry.inverse(truth[loop.target_id]) @ truth[loop.source_id])
        for loop in loops
    ]


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
    poses, rate = [truth[0]], RATE_SIGMAS * rng.normal(size=6)
    for T_a, T_b in itertools.pairwise(truth):
        T_a_b = geometry.inverse(T_a) @ T_b
        way_m = geometry.distance(T_a_b)
        kept = np.exp(-way_m / RATE_MEMORY_M)
        rate = kept * rate + np.sqrt(1.0 - kept**2) * RATE_SIGMAS * rng.normal(size=6)
        error = rate * way_m + STEP_SIGMAS * np.sqrt(way_m) * rng.normal(size=6)
        poses.append(poses[-1] @ T_a_b @ geometry.exp(error))
    return np.array(poses)


def claimed(truth: np.ndarray, rng: np.random.Generator, *, times: float) -> np.ndarray:
    """Odometry with errors of `times` the graph's noise model."""
    poses = [truth[0]]
    for T_a, T_b in itertools.pairwise(truth):
        T_a_b = geometry.inverse(T_a) @ T_b
        information = odometry_information(geometry.distance(T_a_b), T_a_b, CONFIG.graph)
        poses.append(poses[-1] @ T_a_b @ geometry.exp(times * np.diag(information) ** -0.5 * rng.normal(size=6)))
    return np.array(poses)


def _lidar_poses(path: Path, T_camera_lidar: np.ndarray) -> np.ndarray:
    return lidar_from_camera(read_poses(path).T_a_b, T_camera_lidar)


def _keyframe_rows(poses: np.ndarray) -> list[int]:
    selector = KeyframeSelector(CONFIG.keyframes)
    return [row for row, T_odom_lidar in enumerate(poses) if selector.update(T_odom_lidar)]

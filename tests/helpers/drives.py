"""A short simulated drive with a drifting odometry, for tests of the whole pipeline."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from segslam.bench.simulation.files import uncorrected
from segslam.bench.simulation.sensor import Sweep, drive_sweeps
from segslam.bench.simulation.tracks import example_drive
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig
from segslam.core import geometry
from segslam.core.config import load_config
from segslam.core.pose_files import write_kitti
from segslam.core.trajectory import Poses, camera_from_lidar
from segslam.core.types import Scan, Trajectory, Vector
from segslam.labels.encodings import RAW_OF_LABEL
from segslam.odometry.sweep import GivenOdometry
from segslam.scans.kitti import read_calibration
from segslam.slam.slam import Slam

NUM_SCANS = 72
STEP_M = 2.2
RADIUS_M = 18.0  # 158 m of driving: a round of 113 m, and 45 m of it again


CONFIG = SimulationConfig(
    world=WorldConfig(moving_cars=0.0), sensor=SensorConfig(name="os1-64", sweep_rotation_sigma_deg=0.0)
)
SEED = 3


def simulate_drive(T_world_lidar: Poses, time_s: Vector, *, seed: int, config: SimulationConfig) -> Iterator[Scan]:
    """Labelled scans from level poses (n, 4, 4) at the times `time_s` (n,), ascending."""
    world = World(T_world_lidar, time_s, config=config.world, seed=seed)
    for index, one in enumerate(drive_sweeps(world, T_world_lidar, time_s, config=config.sensor, seed=seed)):
        yield Scan(one.points, round(time_s[index] * 1e9), index, one.labels)


@cache
def round_drive() -> tuple[tuple[Scan, ...], Trajectory]:
    """Scans of a drive around a block, a round and a half, with labels, and their true poses."""
    poses, time_s = _round()
    scans = tuple(simulate_drive(poses, time_s, seed=SEED, config=CONFIG))
    stamps = np.array([scan.stamp_ns for scan in scans])
    return scans, Trajectory(np.arange(NUM_SCANS), stamps, poses)


def round_sweeps(*, seed: int = SEED, only: Collection[int] | None = None) -> Iterator[Sweep]:
    """The same with intensities; with another seed, through another town."""
    poses, time_s = _round()
    world = World(poses, time_s, config=CONFIG.world, seed=seed)
    return drive_sweeps(world, poses, time_s, config=CONFIG.sensor, seed=seed, only=only)


def _round() -> tuple[Poses, np.ndarray]:
    along = STEP_M * np.arange(NUM_SCANS) / RADIUS_M
    poses = np.stack(
        [geometry.transform(geometry.yaw(a), [RADIUS_M * np.sin(a), -RADIUS_M * np.cos(a), 1.73]) for a in along]
    )
    return poses, 0.3 * np.arange(NUM_SCANS)


def drifting(truth: Trajectory, *, turn_deg: float = 0.15, climb_m: float = 0.01) -> Trajectory:
    """The same motion with a constant error in each step: some metres after a round."""
    error = geometry.exp(geometry.tangent(rotation_rad=[0, 0, np.radians(turn_deg)], translation_m=[0.01, 0, climb_m]))
    poses = [np.eye(4)]
    for before, after in zip(truth.T_world_lidar[:-1], truth.T_world_lidar[1:], strict=True):
        poses.append(poses[-1] @ geometry.inverse(before) @ after @ error)
    return replace(truth, T_world_lidar=np.stack(poses))


def intensities(points: np.ndarray) -> np.ndarray:
    """Simulated intensities: ranges in hundreds of metres, so that misaligned rows are detected."""
    return np.linalg.norm(points, axis=1) / 100


def write_kitti_sequence(root: Path, *, num_scans: int = NUM_SCANS) -> Path:
    """The drive's first scans as sequence 00 of KITTI's format; returns the folder of the scans.

    The true labels are in `true_labels`, which is not searched by default.
    """
    folder = root / "sequences" / "00"
    (folder / "velodyne").mkdir(parents=True)
    (folder / "true_labels").mkdir()
    (root / "poses").mkdir()
    scans, truth = round_drive()
    for scan in scans[:num_scans]:
        rows = np.column_stack([uncorrected(scan.points), intensities(scan.points)])
        rows.astype("<f4").tofile(folder / "velodyne" / f"{scan.index:06d}.bin")
        RAW_OF_LABEL[scan.labels].astype("<u4").tofile(folder / "true_labels" / f"{scan.index:06d}.label")
    (folder / "calib.txt").write_text(example_drive(1).calib)
    (folder / "times.txt").write_text("".join(f"{scan.stamp_ns / 1e9:.6f}\n" for scan in scans))
    write_kitti(
        root / "poses" / "00.txt", camera_from_lidar(truth.T_world_lidar, read_calibration(folder / "calib.txt"))
    )
    return folder / "velodyne"


SLAM_CONFIG = load_config(None, ["proximity.min_travel_m=60", "adjustment.max_minutes=0"])
"""Without the final adjustment, which takes longer than all else; tests/adjustment and tests/run have it."""


def drifting_slam() -> Slam:
    """The pipeline for `round_drive`, with odometry that drifts."""
    return Slam(SLAM_CONFIG, odometry=GivenOdometry(drifting(round_drive()[1]), SLAM_CONFIG.odometry))


def random_path(rng: np.random.Generator, num_poses: int) -> np.ndarray:
    """A path of small random steps, as odometry gives it."""
    T_odom_lidar = [np.eye(4)]
    for _ in range(num_poses - 1):
        step = geometry.tangent(rotation_rad=0.1 * rng.normal(size=3), translation_m=[1.0, 0.1, 0.0])
        T_odom_lidar.append(T_odom_lidar[-1] @ geometry.exp(step))
    return np.array(T_odom_lidar)

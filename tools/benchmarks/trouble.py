"""Trouble injected into a simulated drive, and thinner sensors on it: errors and loops with and without it.

Example: python -m tools.benchmarks.trouble DRIVE --sequence 06 --frames 0:300 --out trouble.json
DRIVE is a folder that `segslam simulate` made. Every row is mapped with default settings.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.evaluation import trajectory_metrics
from segslam.core.types import Scan, Trajectory
from segslam.labels.label_files import of_rows
from segslam.odometry.sweep import GivenOdometry
from segslam.output.accuracy import accuracy
from segslam.scans import open_dataset
from segslam.slam.slam import Slam
from tools.benchmarks import common

NEXT_BEAM_DEG = 180.0
"""A step back of the azimuth by more than this begins the next beam."""


@dataclass(frozen=True)
class Drive:
    """Scans with true poses (n, 4, 4), and how the odometry is made where it is given."""

    scans: Callable[[], Iterator[Scan]]
    T_world_lidar: np.ndarray
    given: np.ndarray | None = None


def without(drive: Drive, first: int, count: int) -> Drive:
    """Some scans are missing."""
    rows = [row for row in range(len(drive.T_world_lidar)) if not first <= row < first + count]

    def scans() -> Iterator[Scan]:
        return (scan for row, scan in enumerate(drive.scans()) if row in set(rows))

    return Drive(scans, drive.T_world_lidar[rows])


def turned(drive: Drive, first: int, degrees: float) -> Drive:
    """From one scan on the sensor looks another way."""
    R = geometry.yaw(np.radians(degrees))
    poses = drive.T_world_lidar.copy()
    poses[first:] = poses[first:] @ geometry.transform(R, 0.0)

    def scans() -> Iterator[Scan]:
        for row, scan in enumerate(drive.scans()):
            yield replace(scan, points=(scan.points @ R).astype(np.float32)) if row >= first else scan

    return Drive(scans, poses)


def beside_a_truck(drive: Drive, first: int, metres: float) -> Drive:
    """A wall of 14 m by 4 m drives along at the left and at the right, and hides what is behind it."""
    last = _row_after(drive, first, metres)

    def scans() -> Iterator[Scan]:
        for row, scan in enumerate(drive.scans()):
            yield _hidden(scan) if first <= row < last else scan

    return Drive(scans, drive.T_world_lidar)


def _hidden(scan: Scan) -> Scan:
    """Rays that meet the planes y = 3 m or y = -3 m between x = -7 and 7 m, below 4 m, end there."""
    points = scan.points.astype(np.float64)
    share = 3.0 / np.maximum(np.abs(points[:, 1]), 1e-9)
    hit = points * np.minimum(share, 1.0)[:, None]
    meets = (share < 1.0) & (np.abs(hit[:, 0]) < 7.0) & (hit[:, 2] < 2.3)
    return replace(scan, points=np.where(meets[:, None], hit, points).astype(np.float32))


def in_tunnel(drive: Drive, first: int, metres: float) -> Drive:
    """A smooth tube of 5 m radius around the sensor, without features along it."""
    last = _row_after(drive, first, metres)
    rng = np.random.default_rng(0)

    def scans() -> Iterator[Scan]:
        for row, scan in enumerate(drive.scans()):
            yield _in_tube(scan, rng) if first <= row < last else scan

    return Drive(scans, drive.T_world_lidar)


def _in_tube(scan: Scan, rng: np.random.Generator) -> Scan:
    """The rays of a scan end at the tube or at its floor, 1.7 m below the sensor; those beyond 60 m have no return."""
    points = scan.points.astype(np.float64)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    to_wall = 5.0 / np.maximum(np.hypot(rays[:, 1], rays[:, 2]), 1e-9)
    to_floor = np.where(rays[:, 2] < -1e-6, -1.7 / np.minimum(rays[:, 2], -1e-6), np.inf)
    ranges = np.minimum(to_wall, to_floor)
    seen = ranges < 60.0
    ranges = ranges[seen] + rng.normal(scale=0.02, size=int(seen.sum()))
    labels = np.zeros(int(seen.sum()), np.uint8)
    times = scan.times[seen] if len(scan.times) else scan.times
    return replace(
        scan, points=(rays[seen] * ranges[:, None]).astype(np.float32), labels=labels, times=times, intensities=None
    )


def with_beams(drive: Drive, every: int) -> Drive:
    """One beam of so many is kept. The simulator writes beam after beam, each in the order of its azimuths."""

    def thinned(scan: Scan) -> Scan:
        azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])) % 360.0
        beam = np.cumsum(np.diff(azimuth, prepend=azimuth[:1]) < -NEXT_BEAM_DEG)
        return _kept(scan, beam % every == 0)

    return Drive(lambda: (thinned(scan) for scan in drive.scans()), drive.T_world_lidar)


def with_view(drive: Drive, degrees: float) -> Drive:
    """The sensor sees a sector ahead only."""

    def cut(scan: Scan) -> Scan:
        azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
        return _kept(scan, np.abs(azimuth) <= degrees / 2)

    return Drive(lambda: (cut(scan) for scan in drive.scans()), drive.T_world_lidar)


def _kept(scan: Scan, kept: np.ndarray) -> Scan:
    return replace(
        scan,
        points=scan.points[kept],
        labels=of_rows(scan.labels, kept),
        times=scan.times[kept] if len(scan.times) else scan.times,
        intensities=None,
    )


def kidnapped(drive: Drive, first: int, to: int) -> Drive:
    """After one scan the sensor is lifted, and put down at a later place of the drive."""
    return without(drive, first, to - first)


def _row_after(drive: Drive, first: int, metres: float) -> int:
    steps_m = np.linalg.norm(np.diff(drive.T_world_lidar[:, :3, 3], axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    return int(np.searchsorted(along_m, along_m[first] + metres))


def with_jump(drive: Drive, first: int, metres: float) -> Drive:
    """The true poses are given as odometry, with a jump."""
    poses = drive.T_world_lidar.copy()
    poses[first:] = geometry.transform(np.eye(3), [metres, 0.0, 0.0]) @ poses[first:]
    return Drive(drive.scans, drive.T_world_lidar, given=poses)


def mapped(drive: Drive, config: Config) -> dict[str, float]:
    """Errors, and states of the motions."""
    odometry = None
    scans = list(drive.scans())
    if drive.given is not None:
        index, stamps = np.array([scan.index for scan in scans]), np.array([scan.stamp_ns for scan in scans])
        odometry = GivenOdometry(Trajectory(index, stamps, drive.given), config.odometry)
    slam = Slam(config, odometry=odometry)
    for scan in scans:
        slam.process(scan)
    result = slam.finish()
    found = accuracy(result, replace(result.trajectory, T_world_lidar=drive.T_world_lidar))
    states = [str(motion.state) for motion in result.motions]
    return {
        "ate_m": trajectory_metrics(result.trajectory.T_world_lidar, drive.T_world_lidar)["ate_m"],
        "odometry_ate_m": trajectory_metrics(result.odometry.T_world_lidar, drive.T_world_lidar)["ate_m"],
        "num_motions_rejected": len(result.estimate.motion_weights),
        **{name: value for name, value in found.items() if "loop" in name},
    } | {name: states.count(name) for name in ("repaired", "rejoined", "broken")}


def main() -> None:
    parser = common.parser(__doc__, "trouble")
    parser.add_argument("drive", type=Path)
    parser.add_argument("--sequence", default="06")
    parser.add_argument("--frames")
    parser.add_argument("--at", type=int, default=150, help="row where the disturbance begins")
    parser.add_argument("--put-down", type=int, default=850, help="row where a kidnapped sensor is put down")
    parser.add_argument("--only", nargs="*", help="rows by name")
    common.add_settings(parser)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.drive, sequence=arguments.sequence, frames=arguments.frames)
    config = load_config(None, arguments.set)
    if dataset.reference is None:
        parser.error("the drive has no true poses")
    plain = Drive(lambda: (dataset[row] for row in range(len(dataset))), dataset.reference.T_world_lidar)
    at = arguments.at
    troubles: dict[str, Callable[[], Drive]] = {
        "none": lambda: plain,
        "1 s missing": lambda: without(plain, at, 10),
        "2 s missing": lambda: without(plain, at, 20),
        "5 s missing": lambda: without(plain, at, 50),
        "turn of 40 degrees": lambda: turned(plain, at, 40.0),
        "truck for 50 m": lambda: beside_a_truck(plain, at, 50.0),
        "tunnel of 100 m": lambda: in_tunnel(plain, at, 100.0),
        "16 beams": lambda: with_beams(plain, 4),
        "40 degrees of view": lambda: with_view(plain, 40.0),
        "kidnapped": lambda: kidnapped(plain, at, arguments.put_down),
        "given odometry, no jump": lambda: with_jump(plain, at, 0.0),
        "given odometry, jump of 3 m": lambda: with_jump(plain, at, 3.0),
    }
    rows = {}
    for name, make in troubles.items():
        if arguments.only is None or name in arguments.only:
            rows[name] = mapped(make(), config)
            print(name, json.dumps(rows[name]), flush=True)
    if arguments.out:
        common.write_report(arguments.out, {"rows": rows})


if __name__ == "__main__":
    main()

"""Trouble injected into a simulated drive, and thinner sensors on it: errors and loops with and without it.

Example: python -m tools.benchmarks.trouble DRIVE --sequence 06 --frames 0:300 --out trouble.json
DRIVE is a folder that `segslam simulate` made. Every row is mapped with default settings.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.trajectory import Poses, travelled_m
from segslam.core.types import Scan, Trajectory
from segslam.labels.label_files import of_rows
from segslam.odometry.sweep import GivenOdometry
from segslam.output.accuracy import accuracy
from segslam.scans import open_dataset
from segslam.slam.slam import Slam
from tools.benchmarks import common

NEXT_BEAM_DEG = 180.0
"""A step back of the azimuth by more than this begins the next beam."""


class Drive(NamedTuple):
    """Scans with true poses, and the odometry where it is given."""

    scans: Callable[[], Iterable[Scan]]
    T_world_lidar: Poses
    given: Poses | None = None


def changed(drive: Drive, change: Callable[[Scan], Scan], rows: range | None = None) -> Drive:
    """Some scans are changed, by default all."""

    def scans() -> Iterator[Scan]:
        return (change(scan) if rows is None or row in rows else scan for row, scan in enumerate(drive.scans()))

    return drive._replace(scans=scans)


def without(drive: Drive, first: int, count: int) -> Drive:
    """Some scans are missing."""
    kept = np.ones(len(drive.T_world_lidar), bool)
    kept[first : first + count] = False
    return Drive(lambda: compress(drive.scans(), kept), drive.T_world_lidar[kept])


def turned(drive: Drive, first: int, degrees: float) -> Drive:
    """From one scan on the sensor looks another way."""
    R = geometry.yaw(np.radians(degrees))
    poses = drive.T_world_lidar.copy()
    poses[first:] = poses[first:] @ geometry.transform(R, 0.0)
    rows = range(first, len(poses))
    return changed(drive, lambda scan: replace(scan, points=(scan.points @ R).astype(np.float32)), rows)._replace(
        T_world_lidar=poses
    )


def beside_a_truck(scan: Scan) -> Scan:
    """A wall of 14 m by 4 m at the left and at the right hides what is behind it.

    Rays that meet the planes y = 3 m or y = -3 m between x = -7 and 7 m, below 4 m, end there.
    """
    points = scan.points.astype(np.float64)
    share = 3.0 / np.maximum(np.abs(points[:, 1]), 1e-9)
    hit = points * np.minimum(share, 1.0)[:, None]
    meets = (share < 1.0) & (np.abs(hit[:, 0]) < 7.0) & (hit[:, 2] < 2.3)
    return replace(scan, points=np.where(meets[:, None], hit, points).astype(np.float32))


def in_tunnel(scan: Scan, rng: np.random.Generator) -> Scan:
    """A smooth tube of 5 m radius around the sensor, without features along it.

    The rays end at the tube or at its floor, 1.7 m below the sensor; those beyond 60 m have no return.
    """
    points = scan.points.astype(np.float64)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    to_wall = 5.0 / np.maximum(np.hypot(rays[:, 1], rays[:, 2]), 1e-9)
    to_floor = np.where(rays[:, 2] < -1e-6, -1.7 / np.minimum(rays[:, 2], -1e-6), np.inf)
    ranges = np.minimum(to_wall, to_floor)
    seen = ranges < 60.0
    ranges = ranges[seen] + rng.normal(scale=0.02, size=int(seen.sum()))
    points = (rays[seen] * ranges[:, None]).astype(np.float32)
    return replace(_kept(scan, seen), points=points, labels=np.zeros(len(points), np.uint8))


def with_beams(scan: Scan, every: int) -> Scan:
    """One beam of so many is kept. The simulator writes beam after beam, each in the order of its azimuths."""
    beam = np.cumsum(np.diff(_azimuth_deg(scan) % 360.0, prepend=0.0) < -NEXT_BEAM_DEG)
    return _kept(scan, beam % every == 0)


def with_view(scan: Scan, degrees: float) -> Scan:
    """The sensor sees a sector ahead only."""
    return _kept(scan, np.abs(_azimuth_deg(scan)) <= degrees / 2)


def _azimuth_deg(scan: Scan) -> np.ndarray:
    return np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))


def _kept(scan: Scan, kept: np.ndarray) -> Scan:
    return replace(
        scan,
        points=scan.points[kept],
        labels=of_rows(scan.labels, kept),
        times=scan.times[kept] if len(scan.times) else scan.times,
        intensities=None,
    )


def _along(drive: Drive, first: int, metres: float) -> range:
    """The rows from one on, for some metres."""
    along_m = travelled_m(drive.T_world_lidar)
    return range(first, int(np.searchsorted(along_m, along_m[first] + metres)))


def with_jump(drive: Drive, first: int, metres: float) -> Drive:
    """The true poses are given as odometry, with a jump."""
    poses = drive.T_world_lidar.copy()
    poses[first:] = geometry.transform(np.eye(3), [metres, 0.0, 0.0]) @ poses[first:]
    return drive._replace(given=poses)


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
        **{name: found[name] for name in ("ate_m", "odometry_ate_m")},
        "num_motions_rejected": len(result.estimate.motion_weights),
        **{name: value for name, value in found.items() if "loop" in name},
        **{name: states.count(name) for name in ("repaired", "rejoined", "broken")},
    }


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
    at, rng = arguments.at, np.random.default_rng(0)
    troubles: dict[str, Callable[[], Drive]] = {
        "none": lambda: plain,
        "1 s missing": lambda: without(plain, at, 10),
        "2 s missing": lambda: without(plain, at, 20),
        "5 s missing": lambda: without(plain, at, 50),
        "turn of 40 degrees": lambda: turned(plain, at, 40.0),
        "truck for 50 m": lambda: changed(plain, beside_a_truck, _along(plain, at, 50.0)),
        "tunnel of 100 m": lambda: changed(plain, partial(in_tunnel, rng=rng), _along(plain, at, 100.0)),
        "16 beams": lambda: changed(plain, partial(with_beams, every=4)),
        "40 degrees of view": lambda: changed(plain, partial(with_view, degrees=40.0)),
        "kidnapped": lambda: without(plain, at, arguments.put_down - at),
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

"""Real drives, altered, with default settings: driven backwards, thinned, with fewer beams, cut, turned, with noise.

    python -m tools.benchmarks.altered SCANS [ALTERATION ...] [--poses POSES.txt] [--frames 0:560] [--out altered.json]
    python -m tools.benchmarks.altered SCANS view-40 view-70 --pairs 3 6

SCANS is a folder of scans (and of `poses.txt`, LiDAR to world, in KITTI format; `times.txt`). Each row is a run of
`segslam map` on a copy with the alteration; all alterations by default. With `--pairs`, each scan is registered alone
with those so many scans before, without an initial guess. `--noise-m 0.001 --seed 1` moves all points a little, to see
how much runs differ.
"""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import Poses
from segslam.core.types import Points, Vector
from segslam.output.finished import read_run
from segslam.scans import open_dataset
from segslam.verification import register
from tools.benchmarks import common
from tools.benchmarks.real import within_covariance

Rows = list[int]
FIGURES = (
    *("odometry_ate_m", "ate_m", "num_motions_repaired", "num_motions_broken"),
    *("num_loops_accepted", "num_loops_false", "loop_recall"),
)


def _view(degrees: int) -> Callable[[Points, int], Points]:
    half = np.radians(degrees / 2)
    return lambda points, _: points[np.abs(np.arctan2(points[:, 1], points[:, 0])) <= half]


def _beams(apart_deg: float) -> Callable[[Points, int], Points]:
    """Points of beams so far apart, each 0.4 degrees wide."""

    def kept(points: Points, _: int) -> Points:
        elevation_deg = np.degrees(np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=1)))
        return points[np.abs((elevation_deg + apart_deg / 2) % apart_deg - apart_deg / 2) < 0.2]

    return kept


def _noise(points: Points, row: int) -> Points:
    near = points[np.linalg.norm(points, axis=1) < 30.0]
    return near + np.random.default_rng(row).normal(scale=0.03, size=near.shape)


def _rain(points: Points, row: int) -> Points:
    """A tenth of the rays end at drops, most of them near the sensor."""
    random = np.random.default_rng(row)
    ranges = np.linalg.norm(points, axis=1)
    drops = np.minimum(random.exponential(4.0, len(points)), ranges)
    shares = np.where(random.random(len(points)) < 0.1, drops / np.maximum(ranges, 1e-9), 1.0)
    return points * shares[:, None]


def _vehicle(points: Points, row: int) -> Points:
    """The sensor sees its own vehicle: a wall as wide as a cabin, 3 m behind it, with 2 cm of noise."""
    shares = 3.0 / np.where(points[:, 0] < 0.0, -points[:, 0], np.nan)
    hits = (shares < 1.0) & (np.abs(points[:, 1] * shares) < 1.25) & (points[:, 2] * shares < 1.0)
    noisy = shares + np.random.default_rng(row).normal(scale=0.02 / 3.0, size=len(points))
    return np.where(hits[:, None], points * noisy[:, None], points)


class Alteration(NamedTuple):
    """Which rows, in order; what becomes of their points; and the axes of the altered sensor."""

    rows: Callable[[Rows], Rows] = lambda rows: rows
    points: Callable[[Points, int], Points] = lambda points, _: points
    axes: np.ndarray = np.eye(3)

    def true_poses(self, T_world_lidar: Poses) -> Poses:
        """Poses of the sensor as it was altered; a mirrored sensor is in a mirrored world."""
        axes = np.eye(4)
        axes[:3, :3] = self.axes
        poses = T_world_lidar @ axes.T
        return poses if np.linalg.det(self.axes) > 0 else axes @ poses


ALTERATIONS = {
    "none": Alteration(),
    "backwards": Alteration(lambda rows: rows[::-1]),
    "every-third": Alteration(lambda rows: rows[::3]),
    "every-second": Alteration(lambda rows: rows[::2]),
    "removed-30-percent": Alteration(lambda rows: [row for row in rows if np.random.default_rng(row).random() > 0.3]),
    "there-and-back": Alteration(lambda rows: rows[::2] + rows[1::2][::-1]),
    "gap-30": Alteration(lambda rows: rows[: int(0.45 * len(rows))] + rows[int(0.45 * len(rows)) + 30 :]),
    "noise-3-cm-30-m": Alteration(points=_noise),
    "rain": Alteration(points=_rain),
    "own-vehicle": Alteration(points=_vehicle),
    "tilted": Alteration(axes=ScipyRotation.from_euler("XY", [10.0, 30.0], degrees=True).as_matrix()),
    "upside-down": Alteration(axes=np.diag([1.0, -1.0, -1.0])),
    "mirrored": Alteration(axes=np.diag([1.0, -1.0, 1.0])),
    "beams-2-degrees": Alteration(points=_beams(2.0)),
    "within-20-m": Alteration(points=lambda points, _: points[np.linalg.norm(points, axis=1) < 20.0]),
    **{f"view-{degrees}": Alteration(points=_view(degrees)) for degrees in (180, 90, 70, 40)},
}


class Altered(NamedTuple):
    """An altered drive."""

    points_of: Callable[[int], Points]
    stamps_s: Vector
    T_world_lidar: Poses


def altered(scans: Path, poses: Path, frames: str | None, alteration: str, noise_m: float, seed: int) -> Altered:
    """The drive with the alteration, and normal noise of `noise_m` added to its points."""
    data = open_dataset(scans)
    change = ALTERATIONS[alteration]
    first, last = (int(part) for part in frames.split(":")) if frames else (0, len(data))
    rows = change.rows(list(range(first, min(last, len(data)))))
    times = scans / "times.txt"
    stamps_s = np.sort(np.loadtxt(times)[rows]) if times.exists() else np.arange(len(rows)) / 10.0
    if alteration == "backwards" and times.exists():
        stamps_s = (np.loadtxt(times)[rows[0]] - np.loadtxt(times)[rows]).round(6)

    def points_of(number: int) -> Points:
        points = change.points(data[rows[number]].points.astype(np.float64), rows[number]) @ change.axes.T
        return (points + np.random.default_rng([seed, number]).normal(0.0, noise_m, points.shape)).astype(np.float32)

    return Altered(points_of, stamps_s, change.true_poses(read_poses(poses).T_a_b)[rows])


def mapped(drive: Altered) -> common.Row:
    """The figures of a run on the drive."""
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "drive"
        copy.mkdir()
        for number in range(len(drive.stamps_s)):
            points = drive.points_of(number)
            np.column_stack([points, np.zeros(len(points), np.float32)]).tofile(copy / f"{number:06d}.bin")
        np.savetxt(copy / "times.txt", drive.stamps_s, fmt="%.6f")
        np.savetxt(copy / "poses.txt", drive.T_world_lidar[:, :3].reshape(-1, 12), fmt="%.9g")
        common.segslam("map", copy, "--out", f"{folder}/run")
        run = read_run(Path(folder) / "run")
        return {name: run.metrics.get(name) for name in FIGURES} | within_covariance(run)


def registered(drive: Altered, steps: Sequence[int]) -> common.Row:
    """How many pairs of scans, each alone, so many scans apart, are registered rightly and wrongly."""
    counts = Counter[str]()
    for source in range(max(steps), len(drive.stamps_s)):
        for target in (source - step for step in steps):
            found = register(drive.points_of(source), drive.points_of(target))
            T_true = geometry.inverse(drive.T_world_lidar[target]) @ drive.T_world_lidar[source]
            counts[common.verdict(found, T_true)] += 1
    total, right, wrong = counts.total(), counts["right"], counts["wrong"]
    return {"pairs": total, "right": right, "wrong": wrong, "rejected": total - right - wrong}


def run_benchmark() -> None:
    """Print a row for each alteration, and write all to a file."""
    options = common.parser(__doc__, "altered")
    options.add_argument("scans", type=Path)
    options.add_argument("alterations", nargs="*", metavar="ALTERATION", help=", ".join(ALTERATIONS))
    options.add_argument("--poses", type=Path)
    options.add_argument("--frames")
    options.add_argument("--noise-m", type=float, default=0.0)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--pairs", type=int, nargs="+", metavar="SCANS_APART")
    options.add_argument("--out", type=Path, default=Path("altered.json"))
    given = options.parse_args()
    rows = []
    for alteration in given.alterations or ALTERATIONS:
        poses = given.poses or given.scans / "poses.txt"
        drive = altered(given.scans, poses, given.frames, alteration, given.noise_m, given.seed)
        found = registered(drive, given.pairs) if given.pairs else mapped(drive)
        rows.append({"drive": given.scans.name, "alteration": alteration, "scans": len(drive.stamps_s), **found})
        print(json.dumps(rows[-1]), flush=True)
    common.write_report(given.out, {"rows": rows})


if __name__ == "__main__":
    run_benchmark()

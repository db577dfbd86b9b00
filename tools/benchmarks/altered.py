"""Real drives, altered, with default settings: driven backwards, thinned, cut, turned, with noise.

    python -m tools.benchmarks.altered SCANS [ALTERATION ...] [--poses POSES.txt] [--frames 0:560] [--out altered.json]

SCANS is a folder of scans (and of `poses.txt`, LiDAR to world, in KITTI format; `times.txt`). Each row is a run of
`segslam map` on a copy with the alteration; all alterations by default.
"""

import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from segslam.core import geometry
from segslam.core.trajectory import read_poses
from segslam.core.types import Points, Rotation
from segslam.output.finished import read_metrics
from segslam.scans import open_dataset
from tools.benchmarks import common

Rows = list[int]
FIGURES = ("odometry_ate_m", "ate_m", "num_motions_repaired", "num_motions_broken", "num_loops_accepted")
LOOPS = ("num_loops_false", "loop_recall")


def _turned(roll_deg: float, pitch_deg: float) -> Rotation:
    roll, pitch = np.radians(roll_deg), np.radians(pitch_deg)
    return (
        geometry.exp(np.array([roll, 0.0, 0.0, 0.0, 0.0, 0.0]))[:3, :3]
        @ (geometry.exp(np.array([0.0, pitch, 0.0, 0.0, 0.0, 0.0]))[:3, :3])
    )


def _view(degrees: float) -> Callable[[Points, int], Points]:
    half = np.radians(degrees / 2)
    return lambda points, _: points[np.abs(np.arctan2(points[:, 1], points[:, 0])) <= half]


def _noise(points: Points, row: int) -> Points:
    near = points[np.linalg.norm(points, axis=1) < 30.0]
    return near + np.random.default_rng(row).normal(scale=0.03, size=near.shape)


def _missing(first: float, count: int) -> Callable[[Rows], Rows]:
    return lambda rows: rows[: int(first * len(rows))] + rows[int(first * len(rows)) + count :]


def _same(rows: Rows) -> Rows:
    return rows


def _all(points: Points, _: int) -> Points:
    return points


ALTERATIONS: dict[str, tuple[Callable[[Rows], Rows], Callable[[Points, int], Points]]] = {
    "none": (_same, _all),
    "backwards": (lambda rows: rows[::-1], _all),
    "every-third": (lambda rows: rows[::3], _all),
    "every-second": (lambda rows: rows[::2], _all),
    "removed-30-percent": (lambda rows: [row for row in rows if np.random.default_rng(row).random() > 0.3], _all),
    "there-and-back": (lambda rows: rows[::2] + rows[1::2][::-1], _all),
    "gap-30": (_missing(0.45, 30), _all),
    "noise-3-cm-30-m": (_same, _noise),
    "tilted": (_same, lambda points, _: points @ _turned(10.0, 30.0).T),
    "upside-down": (_same, lambda points, _: points * [1.0, -1.0, -1.0]),
    "mirrored": (_same, lambda points, _: points * [1.0, -1.0, 1.0]),
    "view-180": (_same, _view(180.0)),
    "view-90": (_same, _view(90.0)),
    "view-70": (_same, _view(70.0)),
    "view-40": (_same, _view(40.0)),
}
"""Name -> which rows, in order; what becomes of their points."""


def _true_poses(alteration: str, T_world_lidar: np.ndarray) -> np.ndarray:
    """Poses of the sensor as it was altered."""
    change = {"tilted": _turned(10.0, 30.0), "upside-down": np.diag([1.0, -1.0, -1.0])}.get(alteration)
    poses = T_world_lidar.copy()
    if change is not None:
        poses[:, :3, :3] = poses[:, :3, :3] @ change.T
    if alteration == "mirrored":
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        poses = mirror @ poses @ mirror
    return poses


def row(scans: Path, poses: Path, frames: str | None, alteration: str) -> common.Row:
    """The figures of a run on the altered drive."""
    data = open_dataset(scans)
    choose, alter = ALTERATIONS[alteration]
    first, last = (int(part) for part in frames.split(":")) if frames else (0, len(data))
    rows = choose(list(range(first, min(last, len(data)))))
    T_world_lidar = _true_poses(alteration, read_poses(poses).T_a_b)[rows]
    times = scans / "times.txt"
    stamps = np.sort(np.loadtxt(times)[rows]) if times.exists() else np.arange(len(rows)) / 10.0
    if alteration == "backwards" and times.exists():
        stamps = (np.loadtxt(times)[rows[0]] - np.loadtxt(times)[rows]).round(6)
    with TemporaryDirectory() as folder:
        altered = Path(folder) / "drive"
        altered.mkdir()
        for number, original in enumerate(rows):
            points = alter(data[original].points.astype(np.float64), original).astype(np.float32)
            np.column_stack([points, np.zeros(len(points), np.float32)]).tofile(altered / f"{number:06d}.bin")
        np.savetxt(altered / "times.txt", stamps, fmt="%.6f")
        np.savetxt(altered / "poses.txt", T_world_lidar[:, :3].reshape(-1, 12), fmt="%.9g")
        common.segslam("map", altered, "--out", f"{folder}/run")
        metrics = read_metrics(Path(folder) / "run")
    found = {name: metrics.get(name) for name in (*FIGURES, *LOOPS)}
    return {"drive": scans.name, "alteration": alteration, "scans": len(rows), **found}


def run_benchmark() -> None:
    """Print a row for each alteration, and write all to a file."""
    options = common.parser(__doc__, "altered")
    options.add_argument("scans", type=Path)
    options.add_argument("alterations", nargs="*", metavar="ALTERATION", help=", ".join(ALTERATIONS))
    options.add_argument("--poses", type=Path)
    options.add_argument("--frames")
    options.add_argument("--out", type=Path, default=Path("altered.json"))
    given = options.parse_args()
    rows = []
    for alteration in given.alterations or ALTERATIONS:
        rows.append(row(given.scans, given.poses or given.scans / "poses.txt", given.frames, alteration))
        print(json.dumps(rows[-1]), flush=True)
    common.write_report(given.out, {"rows": rows})


if __name__ == "__main__":
    run_benchmark()

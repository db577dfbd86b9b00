"""Finished runs of real drives in one table: KISS-ICP alone, before loops, the result; and the picture of the README.

    python -m tools.benchmarks.real NAME=RUN[,RUN,...] ... --out docs/real_drives.json [--picture NAME=FILE.png]

Runs of `segslam map` with default settings, several of one drive separated by commas: medians over them. KISS-ICP alone
is that of the first run. The covariances of its motions are compared with their errors: the share within the ellipsoid
of 99 %, and the median of chi-square divided by the expected one. Surfaces that both keyframes of a loop see are thin
where the poses are right: their thickness by the poses of the run, and by the true poses, shows how true these are.
"""

import json
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from segslam.core import geometry
from segslam.core.evaluation import align_positions
from segslam.core.trajectory import rows_of_same_scan
from segslam.core.types import Information, Points, Trajectory, Transform
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import LOG
from segslam.output.log import read_log
from segslam.slam.adjustment.thickness import map_thickness_m, median_m
from tools.benchmarks import common

EXACT = ("num_loops_accepted", "num_loops_false", "num_motions_repaired", "num_motions_broken")
METRES = ("odometry_ate_m", "ate_m", "height_m", "map_thickness_before_m", "map_thickness_m")
OTHERS = ("loop_recall", "vertical_correction_deg", "seconds_total", "peak_rss_mb")
POINTS_EACH, REACH_M, LOW_M, HIGH_M = 150, 25.0, -1.0, 2.5
"""Of each keyframe in the picture: number of points, their range, and their height above the sensor."""


def row(name: str, runs: list[FinishedRun]) -> common.Row:
    """Medians over the runs of a drive; the range of errors beside them."""
    first, reference = runs[0], runs[0].reference
    if reference is None:
        raise SystemExit(f"{name}: the run has no true poses; map a folder with poses.txt")
    found: dict[str, Any] = {"drive": name, "scans": len(first.result.trajectory), "runs": len(runs)}
    rows = rows_of_same_scan(first.result.trajectory.scan_index, reference.scan_index)
    truth = reference.T_world_lidar[rows[:, 1]]
    found["length_m"] = round(float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()))
    if "kiss_icp_ate_m" in first.metrics:
        found["kiss_icp_ate_m"] = round(first.metrics["kiss_icp_ate_m"], 3)
    for key in (*METRES, *EXACT, *OTHERS):
        values = [run.metrics[key] for run in runs if key in run.metrics]
        if values:
            found[key] = round(median(values), 4 if key in METRES else 3)
    found |= within_covariance(first) | thickness_at_loops(first)
    for key in ("odometry_ate_m", "ate_m"):
        found[f"{key}_all"] = sorted(round(run.metrics[key], 3) for run in runs)
    return found


class ComparedMotion(NamedTuple):
    """A motion of a run, with its covariance, and the true one."""

    scans: tuple[int, int]
    """Indices of the two scans."""
    T_found: Transform
    T_true: Transform
    covariance: Information

    def off(self, T_one: Transform, T_other: Transform) -> float:
        """Chi-square of the difference between two measurements of it."""
        error = geometry.log(geometry.inverse(T_one) @ T_other)
        return float(error @ np.linalg.solve(self.covariance, error))


def compared_motions(run: FinishedRun) -> list[ComparedMotion]:
    """The motions of a run that have a covariance of their own, between scans of which the true poses are known."""
    assert run.reference is not None
    rows = rows_of_same_scan(run.result.trajectory.scan_index, run.reference.scan_index)
    true_row = dict(rows.tolist())
    found = []
    for row, (last, step) in enumerate(pairwise(read_log(run.folder / LOG).steps()), start=1):
        covariance = None if step.motion is None else step.motion.covariance
        if covariance is not None and row in true_row and row - 1 in true_row:
            T_a, T_b = (run.reference.T_world_lidar[true_row[k]] for k in (row - 1, row))
            T_true, T_found = (geometry.inverse(a) @ b for a, b in ((T_a, T_b), (last.T_odom_lidar, step.T_odom_lidar)))
            found.append(ComparedMotion((last.scan_index, step.scan_index), T_found, T_true, covariance))
    return found


def within_covariance(run: FinishedRun) -> common.Row:
    """How true the covariances of the motions are: compared with their errors by the true poses."""
    squares = [motion.off(motion.T_true, motion.T_found) for motion in compared_motions(run)]
    if not squares:
        return {}
    return {
        "motions_within_99_percent": round(float(np.mean(np.array(squares) < chi2.ppf(0.99, 6))), 3),
        "chi_square_of_motions": round(float(np.median(squares) / chi2.median(6)), 2),
    }


def thickness_at_loops(run: FinishedRun) -> common.Row:
    """Median thickness of the surfaces that both keyframes of a loop see (m), by the poses of the run and true ones.

    Of the clouds as they are. Empty if there are too few such surfaces.
    """
    assert run.reference is not None
    numbers = run.result.keyframe_rows
    rows = rows_of_same_scan(run.result.trajectory.scan_index[numbers], run.reference.scan_index)
    T_true = np.full((len(numbers), 4, 4), np.nan)
    T_true[rows[:, 0]] = run.reference.T_world_lidar[rows[:, 1]]
    loops = np.array([(one.target_id, one.source_id) for one in run.result.closures()], np.int64).reshape(-1, 2)
    loops = loops[np.isfinite(T_true[loops]).all(axis=(1, 2, 3))]
    keyframes = (step.keyframe for step in read_log(run.folder / LOG).steps())
    points = {one.id: one.points for one in keyframes if one is not None and one.id in loops}
    found = {}
    for name, T_world in (("", run.result.trajectory.T_world_lidar[numbers]), ("_true", T_true)):
        thickness_m = median_m(map_thickness_m(points.__getitem__, T_world, loops))
        if thickness_m is not None:
            found[f"thickness_at_loops{name}_m"] = round(thickness_m, 4)
    return found


def draw(run: FinishedRun, alone: Trajectory, file: Path) -> None:
    """The map by KISS-ICP alone and by the run, seen from above in one scale, with the true path."""
    from matplotlib.figure import Figure

    assert run.reference is not None
    rows = rows_of_same_scan(run.result.trajectory.scan_index, run.reference.scan_index)
    truth = run.reference.T_world_lidar[rows[:, 1], :3, 3]
    figure = Figure(figsize=(11.8, 6.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    steps = [step for step in read_log(run.folder / LOG).steps() if step.keyframe is not None]
    for axes, poses, title in (
        (left, alone.T_world_lidar, "KISS-ICP alone"),
        (right, run.result.trajectory.T_world_lidar, "segslam"),
    ):
        T_true_world = align_positions(poses[rows[:, 0], :3, 3], truth)
        off_m = np.linalg.norm(geometry.apply(T_true_world, poses[rows[:, 0], :3, 3]) - truth, axis=1)
        clouds = [
            geometry.apply(T_true_world @ poses[number], _standing(step.keyframe.points, number))
            for number, step in zip(run.result.keyframe_rows, steps, strict=True)
            if step.keyframe is not None
        ]
        points = np.vstack(clouds)
        axes.scatter(points[:, 0], points[:, 1], s=0.1, c="#404040", alpha=0.35, linewidths=0, rasterized=True)
        axes.plot(truth[:, 0], truth[:, 1], color="#0072B2", linewidth=1.0, label="true path")
        axes.set_title(f"{title}: error {np.sqrt(np.mean(off_m**2)):.2f} m", fontsize=13)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=11)
        axes.set_xlabel("m", fontsize=11)
    left.legend(loc="lower left", fontsize=11, frameon=False)
    figure.savefig(file, dpi=150)


def _standing(points: Points, seed: int) -> Points:
    """Some points above the ground and below bridges."""
    near = (np.linalg.norm(points, axis=1) < REACH_M) & (points[:, 2] > LOW_M) & (points[:, 2] < HIGH_M)
    chosen = np.random.default_rng(seed).permutation(np.flatnonzero(near))[:POINTS_EACH]
    return points[chosen].astype(np.float64)


def main() -> None:
    """Write the table."""
    parser = common.parser(__doc__, "real")
    parser.add_argument("drives", nargs="+", metavar="NAME=RUN,...")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--picture", metavar="NAME=FILE.png")
    options = parser.parse_args()
    pictured, _, picture = (options.picture or "").partition("=")
    rows = []
    for drive in options.drives:
        name, _, folders = drive.partition("=")
        runs = [read_run(folder) for folder in folders.split(",")]
        rows.append(row(name, runs))
        print(json.dumps(rows[-1]), flush=True)
        if name == pictured and (alone := runs[0].result.alone) is not None:
            draw(runs[0], alone, Path(picture))
    common.write_report(options.out, {"drives": rows})


if __name__ == "__main__":
    main()

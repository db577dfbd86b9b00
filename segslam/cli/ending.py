"""End of a run that a command makes: results, report, and the figures in words."""

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from segslam.cli.console import Terminal
from segslam.core.errors import counted

if TYPE_CHECKING:
    from segslam.run.run import Run
    from segslam.slam.slam_result import SlamResult

TROUBLE = (
    ("num_scans_skipped", "scan", "{} skipped (unreadable, empty, late or without a pose); see the warning above"),
    (
        "num_scans_late",
        "scan",
        "of these, {} skipped: a scan before has the same stamp or a later one; correct the stamps, or a clock that "
        "was set back",
    ),
    ("num_motions_repaired", "motion", "odometry: {} repaired by registration with earlier scans"),
    ("num_motions_broken", "break", "odometry: {}, i.e. motions not supported by the scans; see the report"),
    (
        "num_motions_rejected",
        "motion",
        "odometry: {} rejected by the optimiser: loops contradict the odometry there; see the report",
    ),
)
"""Counts that are reported unless they are 0: key, noun, text."""
NOTES = {
    "kiss_icp_ate_m": "the same error of KISS-ICP alone: {kiss_icp_ate_m:.3f} m",
    "localised_percent": "localised in the old map: {localised_percent:.1f} % of the scans; see localised.csv",
    "num_loops_between": "loops between sessions: {num_loops_between}, "
    "{num_loops_between_switched_off} rejected by the optimiser",
    "num_scans_resumed": "{num_scans_resumed} of the scans were resumed from the log; the rate is that of the others",
}
"""Lines about figures that some runs have: key, text."""


def is_interrupted(items: Iterable[object]) -> bool:
    """Run through the items; True if Ctrl-C ended it before the last one."""
    with suppress(KeyboardInterrupt):
        for _ in items:
            pass
        return False
    return True


def finish(
    run: "Run",
    terminal: Terminal,
    *,
    map_files: Sequence[Path] = (),
    more: "Callable[[SlamResult], Mapping[str, Any]]" = lambda result: {},
    search_s: float = math.inf,
    stopped: bool = False,
    place: Callable[[Path], str] | None = None,
) -> dict[str, Any]:
    """Complete a run, and show and return its figures; arguments as for `Run.complete`.

    `stopped`: Ctrl-C or SIGTERM ended the run, before the last scan if there is one.
    """
    from segslam.slam.adjustment.vertical_angle import vertical_angle_advice

    terminal.say(f"{'stopped' if stopped else 'all scans read'}; final optimisation ...")
    metrics, placed = run.complete(
        more=more, place=place, map_files=map_files, search_s=search_s, progress=terminal.progress
    )
    written = map_summary(metrics, map_files) if "map_seconds" in metrics else ""
    notes = vertical_angle_advice(metrics, run.config.sensor), placed, written
    terminal.answer(metrics, summary(metrics, run.folder, notes=notes))
    return metrics


def map_summary(figures: dict[str, Any], files: Sequence[Path]) -> str:
    """Summary of the map."""
    written = f"map in {', '.join(str(file) for file in files)}"
    if "num_map_points" not in figures:
        return written
    removed = figures["num_map_moving_points"], figures["num_map_voxels_seen_through"]
    return (
        f"map of {figures['num_map_points']} points in {figures['map_seconds']:.1f} s; removed as moving: "
        f"{counted(removed[0], 'point')} by class, {counted(removed[1], 'voxel')} that other scans see through\n"
        f"{written}"
    )


def summary(metrics: dict[str, Any], folder: Path, *, notes: Iterable[str] = ()) -> str:
    """The summary printed at the end of a run; `notes`: texts above the lines that name the results."""
    length_m, seconds = metrics["length_m"], round(metrics["duration_s"])
    length = f"{length_m:.0f} m" if length_m < 10_000 else f"{length_m / 1000:.1f} km"
    lines = [
        f"{counted(metrics['num_scans'], 'scan')} in {metrics['seconds_total']:.1f} s "
        f"({metrics['scans_per_second']:.1f}/s), "
        f"{counted(metrics['num_keyframes'], 'keyframe')}, {counted(metrics['num_loops_accepted'], 'loop')} of "
        f"{counted(metrics['num_candidates'], 'candidate')}",
        f"drive: {length} in " + (f"{seconds} s" if seconds < 600 else f"{seconds // 60} min {seconds % 60} s"),
    ]
    lines += [text.format(counted(metrics[key], thing)) for key, thing, text in TROUBLE if metrics.get(key)]
    if "adjustment_moved_m" in metrics:
        lines.append(_adjustment(metrics))
    if "ate_m" in metrics:
        repaired = "after repairs" if metrics.get("num_motions_repaired") else "only"
        false = f"; false loops: {metrics['num_loops_false']}" if "num_loops_false" in metrics else ""
        odometry = f"odometry {repaired}: {metrics['odometry_ate_m']:.3f} m"
        lines.append(f"error after alignment: {metrics['ate_m']:.3f} m, {odometry}{false}")
    lines += [text.format_map(metrics) for key, text in NOTES.items() if metrics.get(key) is not None]
    if "num_loops_won" in metrics:
        before = f"; error of the logged run: {metrics['recorded_ate_m']:.3f} m" if "recorded_ate_m" in metrics else ""
        lines.append(
            f"against the logged run: {counted(metrics['num_loops_won'], 'loop')} more, "
            f"{metrics['num_loops_lost']} fewer{before}"
        )
    where, map_file = shlex.quote(str(folder)), folder / "map.ply"
    follows = f"segslam locate {where} SCAN"
    if not map_file.exists():
        follows = f"segslam export {where} {shlex.quote(str(map_file))}"
    if "ate_m" not in metrics:
        follows = f"segslam eval {where} --reference POSES.txt"
    lines += [
        *filter(None, notes),
        f"results in {folder}",
        f"report: {folder / 'report.html'} (open it in a browser)",
        f"next: {follows}; all commands: segslam --help",
    ]
    return "\n".join(lines)


def _adjustment(metrics: dict[str, Any]) -> str:
    line = (
        f"whole map adjusted by {counted(metrics['num_submap_pairs'], 'pair')} of submaps: keyframes moved by "
        f"{metrics['adjustment_moved_m']:.2f} m (rms)"
    )
    if "map_thickness_m" in metrics and "map_thickness_before_m" in metrics:
        before, after = metrics["map_thickness_before_m"], metrics["map_thickness_m"]
        line += f"; thickness of surfaces {1000 * before:.0f} mm before, {1000 * after:.0f} mm after"
    if "vertical_correction_deg" in metrics:
        line += f"; points raised by {metrics['vertical_correction_deg']:.2f} degrees, the measured vertical angle"
    if "sweep_s" in metrics:
        milliseconds = round(1e3 * abs(metrics["sweep_s"]))
        line += f"; points corrected for the motion within sweeps of {milliseconds} ms, as measured"
    return line

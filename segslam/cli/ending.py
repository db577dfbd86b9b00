"""End of a mapped or replayed run: results, report, figures."""

import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from segslam.cli.console import print_json, progress, say
from segslam.cli.export import map_summary, write_maps

if TYPE_CHECKING:
    from segslam.core.types import Trajectory
    from segslam.run.run import Run
    from segslam.slam.slam_result import SlamResult


def finish(
    run: "Run",
    reference: "Trajectory | None",
    *,
    map_files: Sequence[Path] = (),
    json: bool,
    quiet: bool,
    more: Callable[["SlamResult"], Mapping[str, Any]] = lambda result: {},
    search_s: float = math.inf,
    stopped: bool = False,
    place: Callable[[Path], str] | None = None,
) -> dict[str, Any]:
    """Finish a run: write its results, and the map if files are given; show and return its figures.

    `more` adds figures computed from the result. `search_s` limits the last search for loops, as in `Slam.finish`.
    `stopped`: Ctrl-C ended the run, before the last scan if there is one. `place` georeferences the run before its maps
    are written, and returns what it found.
    """
    from segslam.core.memory import peak_mb
    from segslam.odometry.calibration import vertical_angle_advice
    from segslam.output.accuracy import accuracy
    from segslam.output.finished import read_metrics
    from segslam.output.folder import LOG, room_for, write_metrics
    from segslam.output.log import read_log
    from segslam.output.report import write_report

    read = "Ctrl-C: stopped" if stopped else "all scans read"
    say(f"{read}; final optimisation ...", quiet=quiet)
    result, metrics = run.finish(search_s=search_s, progress=partial(_shown, quiet=quiet))
    if reference is not None:
        metrics |= accuracy(result, reference)
    metrics |= more(result)
    write_metrics(run.folder, metrics)
    try:
        placed = ""
        if place is not None:
            placed = place(run.folder)
            metrics = read_metrics(run.folder)
        if map_files:
            log = read_log(run.folder / LOG)
            metrics |= write_maps(log, map_files, config=log.config.map, quiet=quiet)
            metrics["peak_rss_mb"] = peak_mb()
            write_metrics(run.folder, metrics)
    finally:
        with room_for(run.folder):
            write_report(run.folder)  # before the map: its failure must not prevent the report
    if json:
        print_json(metrics)
    else:
        say(summary(metrics, run.folder), quiet=quiet)
        if advice := vertical_angle_advice(metrics, run.config.sensor):
            say(advice, quiet=quiet)
        if placed:
            say(placed, quiet=quiet)
        if map_files:
            say(map_summary(metrics, map_files), quiet=quiet)
    return metrics


def _shown(items: Iterable[Any], total: int, title: str, *, quiet: bool) -> Iterator[Any]:
    return progress(items, total=total, title=title, quiet=quiet)


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' * (number != 1)}"


def _adjustment(metrics: dict[str, Any]) -> str:
    """A line about the adjustment of the whole map."""
    line = (
        f"whole map adjusted by {_counted(metrics['num_submap_pairs'], 'pair')} of submaps: keyframes moved by "
        f"{metrics['adjustment_moved_m']:.2f} m (rms)"
    )
    if "map_thickness_m" in metrics and "map_thickness_before_m" in metrics:
        before, after = (1000 * metrics[key] for key in ("map_thickness_before_m", "map_thickness_m"))
        line += f"; thickness of surfaces {before:.0f} mm before, {after:.0f} mm after"
    if "vertical_correction_deg" in metrics:
        line += f"; points raised by {metrics['vertical_correction_deg']:.2f} degrees, the measured vertical angle"
    return line


def _errors(metrics: dict[str, Any]) -> list[str]:
    """Lines about the error by stage: KISS-ICP alone, after repairs of its motions, with loops."""
    if "ate_m" not in metrics:
        return []
    repaired = "after repairs" if metrics.get("num_motions_repaired") else "only"
    false = f"; false loops: {metrics['num_loops_false']}" if "num_loops_false" in metrics else ""
    odometry = f"odometry {repaired}: {metrics['odometry_ate_m']:.3f} m"
    line = f"error after alignment: {metrics['ate_m']:.3f} m, {odometry}{false}"
    alone = metrics.get("kiss_icp_ate_m")
    return [line] if alone is None else [line, f"the same error of KISS-ICP alone: {alone:.3f} m"]


def _length(metrics: dict[str, Any]) -> list[str]:
    """A line about the length and duration of the drive."""
    if "length_m" not in metrics or "duration_s" not in metrics:
        return []
    length_m = metrics["length_m"]
    length = f"{length_m:.0f} m" if length_m < 10_000 else f"{length_m / 1000:.1f} km"
    seconds = round(metrics["duration_s"])
    return [f"drive: {length} in " + (f"{seconds} s" if seconds < 600 else f"{seconds // 60} min {seconds % 60} s")]


def _ends(metrics: dict[str, Any], folder: Path) -> list[str]:
    """Lines about the results, and the command that comes next."""
    where = shlex.quote(str(folder))
    map_file = folder / "map.ply"
    follows = f"segslam locate {where} SCAN"
    if not map_file.exists():
        follows = f"segslam export {where} {shlex.quote(str(map_file))}"
    if "ate_m" not in metrics:
        follows = f"segslam eval {where} --reference POSES.txt"
    return [
        f"results in {folder}",
        f"report: {folder / 'report.html'} (open it in a browser)",
        f"next: {follows}; all commands: segslam --help",
    ]


def summary(metrics: dict[str, Any], folder: Path) -> str:
    """The summary printed at the end of a run."""
    lines = [
        f"{_counted(metrics['num_scans'], 'scan')} in {metrics['seconds_total']:.1f} s "
        f"({metrics['scans_per_second']:.1f}/s), "
        f"{_counted(metrics['num_keyframes'], 'keyframe')}, {_counted(metrics['num_loops_accepted'], 'loop')} of "
        f"{_counted(metrics['num_candidates'], 'candidate')}",
        *_length(metrics),
    ]
    if skipped := metrics["num_scans_skipped"]:
        lines.append(f"{skipped} scan{'s' * (skipped != 1)} skipped (unreadable or empty); see the warning above")
    if repaired := metrics.get("num_motions_repaired"):
        lines.append(f"odometry: {repaired} motion{'s' * (repaired != 1)} repaired by registration with earlier scans")
    if broken := metrics.get("num_motions_broken"):
        lines.append(
            f"odometry: {broken} break{'s' * (broken != 1)}, i.e. motions not supported by the scans; see the report"
        )
    if rejected_motions := metrics.get("num_motions_rejected"):
        lines.append(
            f"odometry: {rejected_motions} motion{'s' * (rejected_motions != 1)} rejected by the optimiser: "
            "loops contradict the odometry there; see the report"
        )
    if "adjustment_moved_m" in metrics:
        lines.append(_adjustment(metrics))
    lines += _errors(metrics)
    if "localised_percent" in metrics:
        lines.append(f"localised in the old map: {metrics['localised_percent']:.1f} % of the scans; see localised.csv")
    if "num_loops_between" in metrics:
        rejected = metrics["num_loops_between_switched_off"]
        lines.append(f"loops between sessions: {metrics['num_loops_between']}, {rejected} rejected by the optimiser")
    if "num_scans_resumed" in metrics:
        lines.append(
            f"{metrics['num_scans_resumed']} of the scans were resumed from the log; the rate is that of the others"
        )
    if "num_loops_won" in metrics:
        before = f"; error of the logged run: {metrics['recorded_ate_m']:.3f} m" if "recorded_ate_m" in metrics else ""
        lines.append(
            f"against the logged run: {metrics['num_loops_won']} loops more, {metrics['num_loops_lost']} fewer{before}"
        )
    return "\n".join([*lines, *_ends(metrics, folder)])

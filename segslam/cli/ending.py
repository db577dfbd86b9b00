"""How a run ends, mapped or replayed: its results, its report, its figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from segslam.cli.console import print_json, say
from segslam.cli.export import map_summary, write_maps

if TYPE_CHECKING:
    from segslam.runs import Run
    from segslam.types import AngleSamples, Trajectory


def finish(
    run: "Run",
    reference: "Trajectory | None",
    *,
    angles: "AngleSamples | None" = None,
    map_files: Sequence[Path] = (),
    json: bool,
    quiet: bool,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """End a run: write its results, with a map where files for it are named, and show its figures.

    `angles` as in `Slam.finish`; `more` is among the figures, which are returned.
    """
    from segslam.log import read_log
    from segslam.report import write_report
    from segslam.run_files import LOG, write_metrics
    from segslam.runs import accuracy, peak_rss_mb

    say("all scans are in; one more look at them, and the last optimisation", quiet=quiet)
    result, metrics = run.finish(angles)
    if reference is not None:
        metrics |= accuracy(result, reference)
    metrics |= more
    write_metrics(run.folder, metrics)
    try:
        if map_files:
            log = read_log(run.folder / LOG)
            metrics |= write_maps(log, map_files, config=log.config.map, quiet=quiet)
            metrics["peak_rss_mb"] = peak_rss_mb()
            write_metrics(run.folder, metrics)
    finally:
        write_report(run.folder)  # a map that cannot be made costs nothing else
    if json:
        print_json(metrics)
    else:
        say(summary(metrics, run.folder), quiet=quiet)
        if map_files:
            say(map_summary(metrics, map_files), quiet=quiet)
    return metrics


def summary(metrics: dict[str, Any], folder: Path) -> str:
    """What a person wants to know of a run at a glance."""
    lines = [
        f"{metrics['num_scans']} scans in {metrics['seconds_total']:.1f} s ({metrics['scans_per_second']:.1f}/s), "
        f"{metrics['num_keyframes']} keyframes, {metrics['num_loops_accepted']} loops of "
        f"{metrics['num_candidates']} candidates"
    ]
    if skipped := metrics["num_scans_skipped"]:
        lines.append(f"{skipped} bad scans were skipped")
    if "ate_m" in metrics:
        lines.append(
            f"error after alignment: {metrics['ate_m']:.3f} m, odometry alone {metrics['odometry_ate_m']:.3f} m; "
            f"false loops: {metrics['num_loops_false']}"
        )
    if drift := metrics.get("systematic_drift"):
        lines.append(drift_summary(drift))
    if "num_scans_resumed" in metrics:
        lines.append(f"of these scans, {metrics['num_scans_resumed']} are from the log")
    if "num_loops_won" in metrics:
        before = f", error {metrics['recorded_ate_m']:.3f} m before" if "recorded_ate_m" in metrics else ""
        lines.append(f"replayed: {metrics['num_loops_won']} loops won, {metrics['num_loops_lost']} lost{before}")
    return "\n".join([*lines, f"results in {folder}"])


def drift_summary(drift: dict[str, Any]) -> str:
    """What was found of a systematic drift, and what was done."""
    if drift["vertical_deg"] is None:
        return f"no word on leftover angles: {drift['reason']}"
    done = "turned back" if drift["chosen"] else "left alone"
    held_out = f"held-out chi-square {drift['chi2_before']:.0f} -> {drift['chi2_after']:.0f}"
    angles = ", ".join(
        f"{name} {drift[f'{name}_deg']:.2f} +- {drift[f'{name}_change_deg']:.2f}" for name in ("vertical", "azimuth")
    )
    return f"leftover angles (degrees) {angles}, {done}: {drift['reason']} ({held_out})"

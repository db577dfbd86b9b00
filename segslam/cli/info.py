"""`segslam info`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, print_out
from segslam.cli.tables import figure

if TYPE_CHECKING:
    from segslam.output.log import RunLog

METRICS = "metrics.json"
SHOWN = (
    *("num_scans", "num_keyframes", "length_m", "duration_s", "num_candidates", "num_loops_accepted"),
    *("num_motions_repaired", "ate_m", "odometry_ate_m", "kiss_icp_ate_m", "map_thickness_m"),
)
"""Figures of the run that are shown, if known."""


def info(
    run: Annotated[Path, typer.Argument(help="Run folder, or its log.mcap, finished or not.")],
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show what a run contains: its data, state, figures, changed settings and files.

    Example: segslam info runs/00
    """
    check_exists(run, "give a run folder, or its log.mcap")
    announce(f"info: reading {run}", quiet=quiet)
    from segslam.output.folder import log_of
    from segslam.output.log import read_log

    found = found_in(read_log(log_of(run)))
    if json:
        print_json(found)
    elif not quiet:
        print_out(lines(found))


def found_in(log: "RunLog") -> dict[str, Any]:
    """Data, state, figures, options, changed settings and files (bytes) of a run."""
    from segslam.core.config import Config, changed_settings
    from segslam.output.finished import read_metrics
    from segslam.output.log import is_being_written

    folder = log.path.parent
    state = "in progress" if is_being_written(log.path) else "finished" if log.result() else "interrupted"
    metrics = read_metrics(folder) if (folder / METRICS).is_file() else {}
    figures = {key: metrics[key] for key in SHOWN if key in metrics}
    return {
        "run": str(folder),
        "data": log.run.get("dataset", ""),
        "state": state,
        "num_steps": log.num_steps(),
        "figures": figures,
        "options": {key: value for key, value in log.options.items() if value not in ("", "[]")},
        "changed_settings": {key: str(now) for key, _, now in changed_settings(Config(), log.config)},
        "files": {file.name: file.stat().st_size for file in sorted(folder.iterdir()) if file.is_file()},
    }


def lines(found: dict[str, Any]) -> str:
    """The content as text, for 80 columns."""
    from segslam.output.finished import FIGURES

    then = f"; continue with: segslam resume {found['run']}" if found["state"] == "interrupted" else ""
    text = [f"{found['run']}: {found['data']}, {found['state']}, {found['num_steps']} scans in the log{then}"]
    text += [f"{figure(value):>10}  {FIGURES[key]}" for key, value in found["figures"].items()]
    for title, values in (("options", found["options"]), ("settings changed", found["changed_settings"])):
        text += [f"{title}: {'none' if not values else ''}".rstrip()]
        text += [f"  {key}={value}" for key, value in values.items()]
    text += ["files:", *(f"{_size(size):>10}  {name}" for name, size in found["files"].items())]
    return "\n".join(text)


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e3:.1f} kB" if num_bytes < 1_000_000 else f"{num_bytes / 1e6:.1f} MB"

"""`segslam info`, `view` and `report`: what a run contains."""

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from segslam.cli.checks import check_free, check_links, check_run, why_not_resumed
from segslam.cli.console import Terminal
from segslam.cli.options import LogArgument, OverwriteOption
from segslam.cli.tables import with_meanings
from segslam.cli.viewers import check_display, scene_in
from segslam.core.errors import SegslamError, counted

if TYPE_CHECKING:
    from segslam.output.log import RunLog

SHOWN = (
    *("num_scans", "num_scans_skipped", "num_scans_left", "num_keyframes", "length_m", "duration_s"),
    *("num_candidates", "num_loops_accepted"),
    *("num_motions_repaired", "num_motions_broken", "ate_m", "odometry_ate_m", "kiss_icp_ate_m", "map_thickness_m"),
)
"""Figures of the run that are shown, if known."""


def info(run: LogArgument, *, terminal: Terminal) -> None:
    """Show what a run contains: its data, state, figures, changed settings and files.

    Example: segslam info runs/00
    """
    check_run(run)
    terminal.announce(f"info: reading {run}")
    from segslam.output.log import read_log

    found = _found_in(read_log(run))
    terminal.table(found, _lines(found))


def view(
    run: Annotated[Path, "Run folder, finished or not."],
    *,
    save: Annotated[Path | None, "Write a .rrd file for Rerun instead of opening the viewer."] = None,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Open a run in the Rerun viewer: trajectory, clouds and loops, step by step.

    Example: segslam view runs/00
    """
    if save is None:
        check_display()
    elif save.suffix.lower() not in ("", ".rrd"):
        raise SegslamError(f"--save {save}: Rerun's files end in .rrd; for other formats of the map: segslam export")
    check_free([save], overwrite=overwrite)
    terminal.announce(f"view: reading {run}")
    from segslam.core.whole_files import whole_file
    from segslam.output.log import read_log

    log = read_log(run)
    with nullcontext() if save is None else whole_file(save) as part, scene_in(part, named=save) as scene:
        num_steps = 0
        for step in terminal.progress(log.steps(), log.num_steps(), "view"):
            scene.add(step)
            num_steps += 1
    figures = {"num_steps": num_steps, "file": str(save) if save else None}
    terminal.answer(figures, f"written to {save}" if save else "all steps are in the viewer")


def report(run: Annotated[Path, "Run folder; report.html is written there."], *, terminal: Terminal) -> None:
    """Write the report of a run again: one HTML page with the map, plots and tables.

    Example: segslam report runs/00
    """
    terminal.announce(f"report: reading {run}")
    from segslam.output.folder import folder_of
    from segslam.output.report import write_report

    check_links(folder_of(run))
    page = write_report(folder_of(run))
    terminal.answer({"report": str(page)}, f"report written to {page}")


def _found_in(log: "RunLog") -> dict[str, Any]:
    """Data, state, figures, options, changed settings and files (bytes) of a run."""
    from segslam.core.config import changed_settings
    from segslam.output.finished import read_metrics
    from segslam.output.log import is_being_written
    from segslam.scans.presets import defaults_in_effect

    folder = log.path.parent
    state = "in progress" if is_being_written(log.path) else "finished" if log.result() else "interrupted"
    metrics = read_metrics(folder) if (folder / "metrics.json").is_file() else {}
    if state == "finished" and metrics.get("num_scans_left"):
        state = "interrupted"
    default = defaults_in_effect(log.config, log.T_camera_lidar)
    return {
        "run": str(folder),
        "data": log.run.get("dataset", ""),
        "state": state,
        "num_steps": log.num_steps(),
        "figures": {key: metrics[key] for key in SHOWN if key in metrics},
        "options": {key: value for key, value in log.options.items() if value not in ("", "[]")},
        "changed_settings": {key: str(now) for key, _, now in changed_settings(default, log.config)},
        "files": {file.name: file.stat().st_size for file in sorted(folder.iterdir()) if file.is_file()},
    }


def _lines(found: dict[str, Any]) -> str:
    """The content as text, for 80 columns."""
    from segslam.output.words import FIGURES

    num_steps = counted(found["num_steps"], "scan")
    is_replay = "num_scans_left" in found["figures"] and "data" not in found["options"]
    is_refused = is_replay or why_not_resumed(found["options"], Path(found["run"]))
    is_resumable = found["state"] == "interrupted" and not is_refused
    then = f"; continue with: segslam resume {shlex.quote(found['run'])}" if is_resumable else ""
    text = [f"{found['run']}: {found['data']}, {found['state']}, {num_steps} in the log{then}"]
    text += with_meanings([found["figures"]], {key: FIGURES[key] for key in found["figures"]}).splitlines()
    changed = found["changed_settings"]
    for title, values in (("options", found["options"]), ("settings other than the defaults", changed)):
        text += [f"{title}: {'none' if not values else ''}".rstrip()]
        text += [f"  {key}={value}" for key, value in values.items()]
    text += ["files:", *(f"{_size(size):>10}  {name}" for name, size in found["files"].items())]
    return "\n".join(text)


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e3:.1f} kB" if num_bytes < 1_000_000 else f"{num_bytes / 1e6:.1f} MB"

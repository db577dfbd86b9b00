"""`segslam resume`."""

import json as json_text
from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli.checks import check_exists, log_to_resume
from segslam.cli.console import JsonOption, QuietOption, announce
from segslam.cli.map import map_data
from segslam.cli.run_options import OutputOptions, RunOptions, ViewOption
from segslam.errors import SegslamError


def resume(
    run: Annotated[Path, typer.Argument(help="Folder of the interrupted run.")],
    view: ViewOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Continue an interrupted run with its original data and options, which are read from its log.

    Example: segslam resume runs/00
    """
    check_exists(run, "give a run folder")
    announce(f"resume: reading {run}", quiet=quiet)
    recorded = log_to_resume(run)
    chosen: dict[str, Any] = dict(recorded.options)
    if chosen.get("live"):
        raise SegslamError(
            f"{recorded.path}: a live run cannot be resumed, because its scans were not stored; to make its results: "
            f"segslam replay {run} --out NEW"
        )
    if not chosen.get("data"):
        raise SegslamError(
            f"{recorded.path}: has no path of the data; resume with: segslam map DATA --out {run} --resume"
        )
    check_exists(
        Path(chosen["data"]),
        f"{recorded.path} was started with it. Restore it, or: segslam map DATA --out {run} --resume",
    )
    options = RunOptions(
        dataset=chosen["dataset"] or None,
        sequence=chosen["sequence"],
        frames=chosen["frames"] or None,
        topic=chosen["topic"],
        labels=chosen["labels"],
        encoding=chosen["encoding"] or None,
        odometry=Path(chosen["odometry"]) if chosen["odometry"] else None,
        resume=True,
    )
    map_files = [Path(name) for name in json_text.loads(chosen["map_files"])]
    output = OutputOptions(map_file=map_files, view=view, json=json, quiet=quiet)
    in_map = Path(chosen["in_map"]) if chosen.get("in_map") else None
    map_data(Path(chosen["data"]), run, options, output, in_map=in_map)

"""`segslam resume`."""

import json as json_text
from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli.checks import check_exists, log_to_resume
from segslam.cli.console import JsonOption, QuietOption, announce, say
from segslam.cli.gnss_options import GnssOptions
from segslam.cli.map import map_data
from segslam.cli.run_options import OutputOptions, RunOptions, ViewOption
from segslam.core.errors import SegslamError


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
    if chosen.get("python"):
        raise SegslamError(
            f"{recorded.path}: made from Python with its own {chosen['python']}; map the data again from there"
        )
    options = RunOptions(
        dataset=chosen.get("dataset") or None,
        sequence=chosen.get("sequence") or "00",
        frames=chosen.get("frames") or None,
        topic=chosen.get("topic", ""),
        labels=chosen.get("labels", "auto"),
        encoding=_encoding(chosen.get("encoding", ""), recorded.path),
        odometry=Path(chosen["odometry"]) if chosen.get("odometry") else None,
        resume=True,
    )
    map_files = _map_files(chosen.get("map_files", "[]"), run, recorded.path, quiet=quiet)
    output = OutputOptions(map_file=map_files, view=view, json=json, quiet=quiet)
    in_map = Path(chosen["in_map"]) if chosen.get("in_map") else None
    map_data(Path(chosen["data"]), run, options, output, GnssOptions.of(chosen), in_map=in_map)


def _encoding(name: str, log: Path) -> Any:
    """The numbering of the label files that a log names. Raises SegslamError for an unknown one."""
    from segslam.labels.encodings import ENCODINGS

    if name and name not in ENCODINGS:
        raise SegslamError(f"{log}: --encoding {name}: unknown; resume with: segslam map DATA --out RUN --resume")
    return name or None


def _map_files(names: str, run: Path, log: Path, *, quiet: bool) -> list[Path]:
    """The map files that a log names, without those outside of the run folder: the log may come from another person."""
    try:
        files = [Path(str(name)) for name in json_text.loads(names)]
    except (ValueError, TypeError) as error:
        raise SegslamError(
            f"{log}: damaged list of map files ({names[:80]}); resume with: segslam map DATA --out {run} --resume"
        ) from error
    folder = run.resolve()
    outside = [file for file in files if folder not in (run / file).resolve().parents]
    for file in outside:
        say(
            f"{file}: not written, because it is outside of {run}; after this: segslam export {run} {file}", quiet=quiet
        )
    return [file for file in files if file not in outside]

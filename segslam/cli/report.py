"""`segslam report`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_links
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, say


def report(
    run: Annotated[Path, typer.Argument(help="Run folder; report.html is written there.")],
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write the report of a run again: one HTML page with the map, plots and tables.

    Example: segslam report runs/00
    """
    announce(f"report: reading {run}", quiet=quiet)
    from segslam.output.folder import folder_of
    from segslam.output.report import write_report

    check_links(folder_of(run))
    page = write_report(folder_of(run))
    if json:
        print_json({"report": str(page)})
    else:
        say(f"report written to {page}", quiet=quiet)

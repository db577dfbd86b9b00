"""`segslam report`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, print_json, say


def report(
    run: Annotated[Path, typer.Argument(help="Run folder; report.html is written there.")],
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Draw a run: one HTML page with plots and tables.

    Example: segslam report runs/00
    """
    from segslam.report import write_report

    page = write_report(run)
    if json:
        print_json({"report": str(page)})
    else:
        say(f"report in {page}", quiet=quiet)

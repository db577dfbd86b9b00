"""`segslam report`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import QuietOption, say


def report(
    run: Annotated[Path, typer.Argument(help="Run folder; report.html is written there.")], quiet: QuietOption = False
) -> None:
    """Draw a run: one HTML page with plots and tables.

    Example: segslam report runs/00
    """
    from segslam.report import write_report

    say(f"report in {write_report(run)}", quiet=quiet)

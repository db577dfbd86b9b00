"""Which file holds which command."""

import typer

from segslam.cli import simulate


def register(app: typer.Typer) -> None:
    """Add every command to the application."""
    app.command("simulate")(simulate.simulate)

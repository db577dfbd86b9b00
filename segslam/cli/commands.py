"""Which file holds which command."""

import typer

from segslam.cli import map, register, simulate


def add_all(app: typer.Typer) -> None:
    """Add every command to the application."""
    app.command("map")(map.map_command)
    app.command("register", cls=register.LabelsCommand)(register.register)
    app.command("simulate")(simulate.simulate)

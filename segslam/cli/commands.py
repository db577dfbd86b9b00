"""Which file holds which command."""

import typer

from segslam.cli import bench, demo, evaluate, export, map, optimize, register, replay, report, simulate, view, warm_up


def add_all(app: typer.Typer) -> None:
    """Add every command to the application."""
    app.command("eval")(evaluate.evaluate)
    app.add_typer(bench.app, name="bench")
    app.command("demo")(demo.demo)
    app.command("export")(export.export)
    app.command("map")(map.map_command)
    app.command("optimize")(optimize.optimize)
    app.command("register", cls=register.LabelsCommand)(register.register)
    app.command("replay")(replay.replay)
    app.command("report")(report.report)
    app.command("simulate")(simulate.simulate)
    app.command("view")(view.view)
    app.command("warm-up")(warm_up.warm_up)

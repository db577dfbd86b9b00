"""All commands, with the modules that implement them."""

import typer

from segslam.cli import (
    bench,
    calibrate,
    compare,
    demo,
    doctor,
    evaluate,
    export,
    fleet,
    georeference,
    label,
    live,
    localise,
    locate,
    map,
    merge,
    optimize,
    refine,
    register,
    replay,
    report,
    resume,
    simulate,
    view,
    warm_up,
)


def add_all(app: typer.Typer) -> None:
    """Add every command to the application, unless it has them: twice the commands take twice the time to build."""
    if app.registered_commands:
        return
    app.command("eval")(evaluate.evaluate)
    app.add_typer(bench.app, name="bench")
    app.command("calibrate")(calibrate.calibrate)
    app.command("compare")(compare.compare)
    app.command("demo")(demo.demo)
    app.command("doctor")(doctor.doctor)
    app.command("export")(export.export)
    app.command("label")(label.label)
    app.command("live")(live.live)
    app.command("localise")(localise.localise)
    app.command("locate")(locate.locate)
    app.command("map")(map.map_command)
    app.command("merge")(merge.merge)
    app.command("fleet")(fleet.fleet)
    app.command("georeference")(georeference.georeference)
    app.command("optimize")(optimize.optimize)
    app.command("refine")(refine.refine)
    app.command("register", cls=register.LabelsCommand)(register.register)
    app.command("replay")(replay.replay)
    app.command("report")(report.report)
    app.command("resume")(resume.resume)
    app.command("simulate")(simulate.simulate)
    app.command("view")(view.view)
    app.command("warm-up")(warm_up.warm_up)

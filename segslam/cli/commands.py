"""All commands, with the modules that implement them."""

from typing import Any

import typer

from segslam.cli import (
    bench,
    calibrate,
    compare,
    convert,
    demo,
    doctor,
    edit,
    evaluate,
    export,
    fleet,
    georeference,
    info,
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
    sweep,
    view,
    warm_up,
)

GROUPS: dict[str, dict[str, tuple[Any, str]]] = {
    "Map": {
        "map": (map.map_command, "Map scans: trajectory, loops, log, report, error."),
        "live": (live.live, "Map scans while they arrive."),
        "resume": (resume.resume, "Continue an interrupted run."),
        "replay": (replay.replay, "Repeat loop closing with other settings."),
        "edit": (edit.edit, "Forbid or add loops by hand, and replay."),
        "refine": (refine.refine, "Adjust the whole map of a run."),
        "fleet": (fleet.fleet, "Map many drives, and join those that share places."),
    },
    "Use a map": {
        "locate": (locate.locate, "Find the poses of single scans in a map."),
        "localise": (localise.localise, "Localise a drive in the map of an earlier run."),
        "merge": (merge.merge, "Merge runs that share places into one run."),
        "georeference": (georeference.georeference, "Place a run on the globe by position fixes."),
        "export": (export.export, "Write the map: cloud, top view, occupancy grid."),
    },
    "Look": {
        "info": (info.info, "Show what a run contains."),
        "view": (view.view, "Open a run in the Rerun viewer."),
        "report": (report.report, "Write the report of a run again."),
    },
    "Evaluate": {
        "eval": (evaluate.evaluate, "Measure the error against ground truth."),
        "sweep": (sweep.sweep, "Replay a grid of settings, and table the results."),
        "convert": (convert.convert, "Convert trajectories: KITTI, TUM, CSV, frames."),
        "compare": (compare.compare, "Compare runs in one table and one figure."),
    },
    "Data and machine": {
        "demo": (demo.demo, "Simulate a street drive and map it."),
        "simulate": (simulate.simulate, "Simulate a labelled drive in KITTI's format."),
        "label": (label.label, "Label scans, and measure the labels."),
        "calibrate": (calibrate.calibrate, "Measure the error of the sensor's vertical angles."),
        "doctor": (doctor.doctor, "Show versions, libraries and processor."),
        "warm-up": (warm_up.warm_up, "Compile all numba kernels now."),
    },
    "Paper": {
        "register": (register.register, "Find the pose of one scan in another."),
        "optimize": (optimize.optimize, "Optimise a pose graph."),
    },
}
"""Group -> command -> function and line of the list of commands, which must fit 80 columns."""
BENCH = "Repeat the experiments of the Segregator paper."
CLASSES = {"register": register.LabelsCommand}


def add_all(app: typer.Typer) -> None:
    """Add every command to the application, unless it has them: twice the commands take twice the time to build."""
    if app.registered_commands:
        return
    for title, group in GROUPS.items():
        for name, (command, about) in group.items():
            app.command(name, short_help=about, rich_help_panel=title, cls=CLASSES.get(name))(command)
    app.add_typer(bench.app, name="bench", short_help=BENCH, rich_help_panel="Paper")

"""All commands in groups, and their help: aliases, and names of arguments without Python's types."""

from collections import defaultdict
from collections.abc import Sequence
from importlib import import_module
from types import MappingProxyType
from typing import Any

import typer
from typer.core import TyperGroup

from segslam.cli.options import with_options

GROUPS: dict[str, dict[str, tuple[str, str]]] = {
    "Map": {
        "map": ("map.map_command", "Map scans: trajectory, loops, log, report, error."),
        "live": ("live.live", "Map scans while they arrive."),
        "resume": ("map.resume", "Continue an interrupted run."),
        "replay": ("replay.replay", "Repeat loop closing with other settings."),
        "edit": ("replay.edit", "Forbid or add loops by hand, and replay."),
        "refine": ("replay.refine", "Adjust the whole map of a run."),
        "fleet": ("merge.fleet", "Map many drives, and join those that share places."),
    },
    "Use a map": {
        "locate": ("locate.locate", "Find the poses of single scans in a map."),
        "localise": ("map.localise", "Localise a drive in the map of an earlier run."),
        "merge": ("merge.merge", "Merge runs that share places into one run."),
        "georeference": ("export.georeference", "Place a run on the globe by position fixes."),
        "export": ("export.export", "Write the map: cloud, top view, occupancy grid."),
    },
    "Look": {
        "info": ("look.info", "Show what a run contains."),
        "view": ("look.view", "Open a run in the Rerun viewer."),
        "report": ("look.report", "Write the report of a run again."),
    },
    "Evaluate": {
        "eval": ("evaluate.evaluate", "Measure the error against ground truth."),
        "sweep": ("compare.sweep", "Replay a grid of settings, and table the results."),
        "convert": ("export.convert", "Convert trajectories: KITTI, TUM, CSV, frames."),
        "compare": ("compare.compare", "Compare runs in one table and one figure."),
    },
    "Data and machine": {
        "demo": ("simulate.demo", "Simulate a street drive and map it."),
        "simulate": ("simulate.simulate", "Simulate a labelled drive in KITTI's format."),
        "label": ("scans.label", "Label scans, and measure the labels."),
        "calibrate": ("scans.calibrate", "Measure the error of the sensor's vertical angles."),
        "doctor": ("doctor.doctor", "Show versions, libraries and processor."),
        "warm-up": ("doctor.warm_up", "Compile all numba kernels now."),
    },
    "Paper": {
        "register": ("locate.register", "Find the pose of one scan in another."),
        "optimize": ("optimize.optimize", "Optimise a pose graph."),
    },
}
"""Group -> command -> module and function, and line of the list of commands, which must fit 80 columns."""
CLASSES = {"register": "locate.LabelsCommand"}
ALIASES = MappingProxyType({"localize": "localise", "optimise": "optimize"})
"""Other spellings of commands; the help does not list them."""


def add(app: typer.Typer, words: Sequence[str] = ()) -> None:
    """Add the command that begins these words of a command line; all commands if there is none, as for the help."""
    called = ALIASES.get(words[0], words[0]) if words else ""
    known = {name: (title, *entry) for title, group in GROUPS.items() for name, entry in group.items()}
    present = {command.name for command in app.registered_commands}
    for name in [called] if called in known else known:
        if name not in present:  # twice the commands take twice the time to build
            title, place, about = known[name]
            kind = _imported(CLASSES[name]) if name in CLASSES else None
            app.command(name, short_help=about, rich_help_panel=title, cls=kind)(with_options(_imported(place)))
    app.registered_commands.sort(key=lambda command: list(known).index(command.name or ""))
    if called not in known and not app.registered_groups:
        app.add_typer(
            _imported("bench.app"),
            name="bench",
            short_help="Repeat the experiments of the Segregator paper.",
            rich_help_panel="Paper",
        )


def _imported(place: str) -> Any:
    """What a module of this package has under a name."""
    module, name = place.split(".")
    return getattr(import_module(f"segslam.cli.{module}"), name)


class GroupedCommands(TyperGroup):
    """Commands under the heading `rich_help_panel` in the help, in the order in which they were added."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name or alias; its help shows an argument as NAME, several as NAME..., without types."""
        command: Any = super().get_command(ctx, ALIASES.get(cmd_name, cmd_name))
        for argument in command.params if command else ():
            if argument.param_type_name == "argument":
                argument.metavar = argument.metavar or f"{argument.name.upper()}{'...' * (argument.nargs == -1)}"
                argument.display_type = lambda ctx: ""
                shown = argument.metavar if argument.required else f"[{argument.metavar}]"
                argument.get_usage_pieces = lambda ctx, shown=shown: [shown]
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group."""
        width = max(map(len, self.commands))
        groups: dict[str, list[tuple[str, str]]] = defaultdict(list)
        for name in self.list_commands(ctx):
            command: Any = self.commands[name]
            about = command.get_short_help_str(formatter.width - 6 - width)
            groups[command.rich_help_panel or "Commands"].append((f"{name:{width}}", about))
        for title, rows in groups.items():
            with formatter.section(title):
                formatter.write_dl(rows)

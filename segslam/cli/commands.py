"""All commands in groups, and their help: aliases, and names of values instead of Python's types."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

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
VALUE_NAMES: Mapping[type, str] = MappingProxyType({Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"})


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
        """The command of a name or alias."""
        command = super().get_command(ctx, ALIASES.get(cmd_name, cmd_name))
        if command is not None:
            _name_values(command)
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group."""
        width = max(map(len, self.commands))
        groups: dict[str, list[tuple[str, str]]] = defaultdict(list)
        for name in self.list_commands(ctx):
            command: Any = self.commands[name]
            about = command.get_short_help_str(formatter.width - 6 - width)
            groups[command.rich_help_panel].append((f"{name:{width}}", about))
        for title, rows in groups.items():
            with formatter.section(title):
                formatter.write_dl(rows)


def _name_values(command: Any) -> None:
    """Set the names of values in the help of a command where it has none, also for subcommands."""
    for child in getattr(command, "commands", {}).values():
        _name_values(child)
    hints = get_type_hints(command.callback) if command.callback else {}
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            _name_argument(parameter)
        elif parameter.metavar is None:
            parameter.metavar = _value_name(hints.get(parameter.name))


def _name_argument(argument: Any) -> None:
    """An argument is shown as NAME, several as NAME..., optional ones as [NAME]; without their types."""
    argument.metavar = argument.metavar or f"{argument.name.upper()}{'...' * (argument.nargs == -1)}"
    shown = argument.metavar if argument.required else f"[{argument.metavar}]"
    argument.display_type = lambda ctx: ""
    argument.get_usage_pieces = lambda ctx: [shown]


def _value_name(hint: Any) -> str | None:
    """PATH, TEXT, N or NUMBER, also for lists and optional values; None for flags and choices."""
    if hint in VALUE_NAMES:
        return VALUE_NAMES[hint]
    names = [_value_name(one) for one in get_args(hint) if isinstance(one, type) or get_args(one)]
    return next((name for name in names if name), None)

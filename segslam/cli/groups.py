"""Help of the command line: commands in groups, aliases, and names of values instead of Python's types."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

from typer.core import TyperGroup

ALIASES = MappingProxyType({"localize": "localise", "optimise": "optimize"})
"""Other spellings of commands; the help does not list them."""
VALUE_NAMES: Mapping[type, str] = MappingProxyType({Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"})


class GroupedCommands(TyperGroup):
    """Commands under the heading `rich_help_panel` in the help, in the order in which they were added."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names for help and completion, in order; the bench, which typer adds last, stays last."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name or alias."""
        command = super().get_command(ctx, ALIASES.get(cmd_name, cmd_name))
        if command is not None:
            _name_values(command)
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group."""
        width = max(map(len, self.commands))
        for title, rows in self._groups(ctx, formatter.width - 6 - width):
            with formatter.section(title):
                formatter.write_dl([(f"{name:{width}}", about) for name, about in rows])

    def _groups(self, ctx: Any, limit: int) -> Iterator[tuple[str, list[tuple[str, str]]]]:
        groups: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.commands[name]
            rows = groups.setdefault(getattr(command, "rich_help_panel", None) or "Commands", [])
            rows.append((name, command.get_short_help_str(limit)))
        yield from groups.items()


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

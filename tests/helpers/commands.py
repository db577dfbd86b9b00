"""Commands as a user types them, in this process."""

import pytest

from segslam import cli


def run(*arguments: object) -> int:
    """Exit status of a command line."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def all_commands(command: object, name: str = "") -> list[tuple[str, object]]:
    """Each command by its full name."""
    children = getattr(command, "commands", {})
    if not children:
        return [(name, command)]
    return [found for key, child in children.items() for found in all_commands(child, f"{name} {key}".strip())]

"""Writes docs/commands.md and docs/api.md from the commands and the public names of the package, for the site.

python tools/reference_pages.py    # writes docs/glossary.md, which the checkout has
"""

import inspect
from pathlib import Path
from typing import Any

from typer.main import get_command

import segslam
from segslam import cli
from segslam.cli import commands
from segslam.output.words import REASONS, WORDS

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples" / "api.py"
BENCH_GROUP = "Paper"
RECORDS = "segslam.core.types"
INTRODUCTION = """# Python

`import segslam` gives these names. Each has an example; together they are
one program, [api.py](examples/api.py), in which later examples use the
results of earlier ones. It is run by a test.
"""
CONFIG = """All settings, by section, frozen: `segslam.Config()` has the defaults,
`segslam.load_config(path, overrides)` changes some of them. [Every setting](options.md) has a page of its own."""


def write(docs: Path) -> None:
    """Write both pages into a folder."""
    (docs / "commands.md").write_text(commands_page(), encoding="utf-8")
    (docs / "api.md").write_text(api_page(), encoding="utf-8")


def glossary_page() -> str:
    """The words of reports and of `loops.csv`."""
    words = "\n".join(f"| {word} | {meaning} |" for word, meaning in WORDS.items())
    reasons = "\n".join(f"| `{reason}` | {meaning} |" for reason, meaning in REASONS.items())
    return (
        "# Glossary\n\nThe words of reports, messages and `loops.csv` that are not everyday words of the field. "
        "Written by `python tools/reference_pages.py`.\n\n"
        f"| word | meaning |\n|---|---|\n{words}\n\n"
        "## Why a loop candidate was rejected\n\nThe column `outcome` of `loops.csv`; `detail` has the figures.\n\n"
        f"| outcome | meaning |\n|---|---|\n{reasons}\n"
    )


def commands_page() -> str:
    """Every command with its arguments and options."""
    commands.add(cli.app)
    parts = ["# Commands\n\nGenerated from the program; `segslam COMMAND --help` shows the same.\n"]
    group = ""
    for name, command in _leaves(get_command(cli.app)):
        title = getattr(command, "rich_help_panel", None) or BENCH_GROUP
        if title != group:
            group = title
            parts.append(f"**{group}**\n")
        about, _, example = inspect.cleandoc(command.help or "").partition("Example:")
        parts.append(f"## segslam {name}\n\n{about.strip()}\n")
        if example:
            parts.append(f"```\n{example.strip()}\n```\n")
        rows = [_row(parameter) for parameter in command.params if not getattr(parameter, "hidden", False)]
        parts.append("| argument or option | default | meaning |\n|---|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def api_page() -> str:
    """Public functions and classes, and the records of `segslam.core.types`."""
    parts = [INTRODUCTION]
    examples = api_examples()
    for name in examples:
        made = getattr(segslam, name)
        if not hasattr(made, "__doc__") or not callable(made):
            continue
        if name == "Config":
            parts.append(f"## Config\n\n{CONFIG}\n\n{examples[name]}\n")
            continue
        kind = "autoclass" if inspect.isclass(made) else "autofunction"
        target = f"{made.__module__}.{made.__qualname__}"
        members = "\n   :members:" if kind == "autoclass" else ""
        reference = f"```{{eval-rst}}\n.. {kind}:: {target}{members}\n```"
        parts.append(f"## {name}\n\n{reference}\n\n{examples[name]}\n")
    parts.append("## Records\n\nStages exchange these frozen records.\n")
    parts.append(f"```{{eval-rst}}\n.. automodule:: {RECORDS}\n   :members:\n   :noindex:\n```\n")
    return "\n".join(parts)


def api_examples() -> dict[str, str]:
    """Name -> its example as a code block, in the order of `docs/examples/api.py`."""
    _, *sections = EXAMPLES.read_text(encoding="utf-8").split("\n# %% ")
    named = [section.partition("\n") for section in sections]
    return {name: f"```python\n{code.strip()}\n```" for name, _, code in named}


def _row(parameter: Any) -> str:
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    name = f"`{parameter.name.upper()}`" if parameter.param_type_name == "argument" else names
    default = parameter.default
    shown = "" if callable(default) or default is None or default is False or default == "" else f"`{default}`"
    if parameter.required:
        shown = "required"
    meaning = (getattr(parameter, "help", "") or "").replace("|", "\\|").replace("<", "&lt;")
    return f"| {name} | {shown} | {meaning} |"


def _leaves(command: Any, name: str = "") -> list[tuple[str, Any]]:
    children = getattr(command, "commands", {})
    if not children:
        return [(name, command)]
    return [leaf for key, child in children.items() for leaf in _leaves(child, f"{name} {key}".strip())]


if __name__ == "__main__":
    (EXAMPLES.parents[1] / "glossary.md").write_text(glossary_page(), encoding="utf-8")

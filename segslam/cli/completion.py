"""Values offered by the shell, which typer filters by what is typed; modules that know them are imported only then."""

import os
from pathlib import Path
from typing import Any, Literal, get_args, get_origin


def labels_or_files(incomplete: str) -> list[str]:
    """Sources of labels, and the paths that begin so: a completion of its own replaces the shell's file names."""
    folder = incomplete[: incomplete.rfind("/") + 1]
    try:
        paths = sorted(Path(os.path.expanduser(folder)).iterdir())
        names = [f"{folder}{path.name}{'/' if path.is_dir() else ''}" for path in paths]
    except OSError:
        names = []
    return ["auto", "none", "geometric", "network:", *names]


def presets() -> list[str]:
    """Names of the presets."""
    from segslam.scans.presets import SETTINGS

    return ["auto", *SETTINGS]


def datasets() -> list[str]:
    """Kinds of data."""
    from segslam.scans.recordings import known_kinds

    return known_kinds()


def settings(incomplete: str) -> list[str]:
    """Keys `section.key=`; after the equals sign the values, if the setting has a fixed list of them."""
    from segslam.core.config import Config

    return _settings(Config, incomplete)


def simulation_settings(incomplete: str) -> list[str]:
    """As `settings`, of the simulation."""
    from segslam.bench.simulation.world_settings import SimulationConfig

    return _settings(SimulationConfig, incomplete)


def _settings(config: Any, incomplete: str) -> list[str]:
    fields = {
        f"{section}.{key}=": field.annotation
        for section, of_section in config.model_fields.items()
        for key, field in of_section.annotation.model_fields.items()
    }
    key, equals, _ = incomplete.partition("=")
    if not equals:
        return list(fields)
    hint = fields.get(f"{key}=")
    values = ("true", "false") if hint is bool else get_args(hint) if get_origin(hint) is Literal else ()
    return [f"{key}={value}" for value in values]

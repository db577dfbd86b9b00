"""Choice of the settings for an environment."""

from typing import TYPE_CHECKING, cast

from segslam.cli.console import Terminal
from segslam.cli.options import Settings
from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.scans import Dataset
    from segslam.scans.presets import Preset


def check_preset(name: str, *, resumes: bool) -> None:
    """Raises SegslamError for an unknown preset, and for any preset if a run is resumed."""
    if name == "auto":
        return
    from segslam.scans.presets import SETTINGS

    if name not in SETTINGS:
        raise SegslamError(f"--preset {name}: unknown preset; known: auto, {', '.join(SETTINGS)}")
    if resumes:
        raise SegslamError(f"--preset {name}: a resumed run keeps its settings; omit the option")


def preset_config(name: str, scans: "Dataset", terminal: Terminal) -> "Config":
    """The settings of a preset; with `auto`, of the preset that fits the scans, with a message."""
    from segslam.scans.presets import extent_m, preset, preset_for

    if name != "auto":
        return preset(cast("Preset", name))
    extent = extent_m(scans)
    show_preset(preset_for(extent), extent, terminal)
    return preset(preset_for(extent))


def live_configs(name: str, output: Settings) -> "dict[Preset, Config]":
    """The settings for each preset that may fit the first scan: all the same unless `name` is `auto`."""
    check_preset(name, resumes=False)
    from segslam.scans.presets import SETTINGS, preset

    return {one: output.load(base=preset(one if name == "auto" else cast("Preset", name))) for one in SETTINGS}


def show_preset(chosen: "Preset", extent_m: float | None, terminal: Terminal) -> None:
    """Print the preset that fits the scans, unless it is the default."""
    if chosen != "driving":
        terminal.say(f"surfaces are near (median range {extent_m:.0f} m): using --preset {chosen}")

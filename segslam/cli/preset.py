"""Choice of the settings for an environment."""

from pathlib import Path
from typing import TYPE_CHECKING, cast

from segslam.cli.console import Terminal
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
    from segslam.scans.presets import extent_m, preset

    return preset(cast("Preset", name)) if name != "auto" else _fitting(extent_m(scans), terminal)


def live_config(name: str, folder: Path | None, topic: str | None, terminal: Terminal) -> "Config":
    """As `preset_config`; `auto` looks at the scans already in the folder, or at the first cloud of the topic."""
    check_preset(name, resumes=False)
    from segslam.scans.presets import preset

    if name != "auto":
        return preset(cast("Preset", name))
    from segslam.run.live.waiting import extent_in_folder, extent_of_topic

    extent = extent_in_folder(folder) if folder is not None else extent_of_topic(topic or "")
    if extent is None:
        terminal.say("no scan yet: using --preset driving; others: campus, indoor")
    return _fitting(extent, terminal)


def _fitting(extent_m: float | None, terminal: Terminal) -> "Config":
    from segslam.scans.presets import preset, preset_for

    chosen = preset_for(extent_m)
    if chosen != "driving":
        terminal.say(f"surfaces are near (median range {extent_m:.0f} m): using --preset {chosen}")
    return preset(chosen)

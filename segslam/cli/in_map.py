"""The pipeline of a run that is localised in the map of an old one."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from segslam.run.map_folder import SlamOf


def pipeline(in_map: Path | None) -> "SlamOf | None":
    """The pipeline that localises in the map of an old run; None, for `Slam`, without one. It reads the run."""
    if in_map is None:
        return None
    from functools import partial

    from segslam.run.locator import Locator
    from segslam.sessions.localiser import Localiser

    return partial(Localiser, Locator.from_run(in_map))

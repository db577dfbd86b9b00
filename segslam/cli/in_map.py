"""The pipeline of a run that is localised in the map of an earlier run."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from segslam.run.map_folder import SlamOf


def pipeline(in_map: Path | None) -> "SlamOf | None":
    """A factory of pipelines that localise in the map of a run, which is read now; None, for `Slam`, without a run."""
    if in_map is None:
        return None
    from functools import partial

    from segslam.run.locator import Locator
    from segslam.sessions.localiser import Localiser

    return partial(Localiser, Locator.from_run(in_map))

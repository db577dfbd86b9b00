"""The pipeline of a run that is localised in the map of an earlier run, and its place on the globe."""

from collections.abc import Callable
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
    from segslam.run.sessions.localiser import Localiser

    return partial(Localiser, Locator.from_run(in_map))


def placing_in(in_map: Path | None) -> Callable[[Path], str] | None:
    """Function that gives the place of a georeferenced map to a run localised in it; None without a map."""
    if in_map is None:
        return None
    from segslam.output.georeferenced import GEODETIC, take_over

    return lambda folder: f"place on the globe: that of the map, see {GEODETIC}" if take_over(folder, in_map) else ""

"""From an old run and new data to the folder of a run in the old one's frame."""

from functools import partial
from pathlib import Path
from typing import Any

from segslam.run.finished import FinishedRun
from segslam.run.locator import Locator
from segslam.run.map_folder import map_folder
from segslam.sessions.localiser import Localiser


def localise(run: str | Path, data: str | Path, out: str | Path, **options: Any) -> FinishedRun:
    """Localise a folder of scans or a recording in the map of a finished run, as `segslam localise` does.

    The new folder `out` holds a run as `map_folder` makes it, whose world is that of the old run. Options are those of
    `map_folder`. Raises SegslamError as `map_folder`, and if the old run did not finish or is damaged.
    """
    locator = Locator.from_run(run)
    return map_folder(
        data,
        out,
        slam_of=partial(Localiser, locator),
        options={"in_map": str(Path(run).expanduser().resolve())},
        **options,
    )

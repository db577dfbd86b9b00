"""Localisation of new data in a finished run; writes a run folder in the frame of that run."""

from functools import partial
from pathlib import Path
from typing import Any

from segslam.output.finished import FinishedRun
from segslam.output.georeferenced import take_over
from segslam.run.locator import Locator
from segslam.run.map_folder import map_folder
from segslam.run.sessions.localiser import Localiser


def localise(run: str | Path, data: str | Path, out: str | Path, **options: Any) -> FinishedRun:
    """Localise a folder of scans or a recording in the map of a finished run, like `segslam localise`.

    The new folder `out` has the files of `map_folder`; its world frame, and its place on the globe, is that
    of the finished run. Options are those of `map_folder`. Raises SegslamError as `map_folder`, and if the run did not
    finish or is damaged.
    """
    locator = Locator.from_run(run)
    made = map_folder(
        data,
        out,
        slam_of=partial(Localiser, locator),
        options={"in_map": str(Path(run).expanduser().resolve())},
        **options,
    )
    take_over(made.folder, run)
    return made

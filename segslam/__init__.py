"""LiDAR pose-graph SLAM: KISS-ICP odometry, Segregator loop closing, GTSAM, MCAP logs.

run = segslam.map_folder("scans", "runs/first")         # map a folder of scans, or a recording
found = segslam.register(source_points, target_points)  # pose of one scan in another, without initial guess

`Slam` maps scan by scan; `open_dataset` and `Scan` provide scans; `read_run` reads the folder of a run.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from segslam.candidates import Places
    from segslam.core.config import Config, load_config
    from segslam.core.memory import keep_freed_memory
    from segslam.core.types import Alignment, BadScan, Rejected, Scan, SegslamError
    from segslam.output.export import export
    from segslam.output.finished import read_run
    from segslam.output.georeferenced import georeference
    from segslam.output.report import write_report as report
    from segslam.run.evaluate import evaluate
    from segslam.run.fleets.orchestrate import fleet
    from segslam.run.locator import Located, Locator, locate
    from segslam.run.map_folder import map_folder
    from segslam.run.replay import replay
    from segslam.run.sessions.localiser import localise
    from segslam.run.sessions.merge import merge
    from segslam.scans import open_dataset
    from segslam.slam.slam import Slam
    from segslam.verification import register

    __version__: str

__all__ = [
    "Alignment",
    "BadScan",
    "Config",
    "Located",
    "Locator",
    "Places",
    "Rejected",
    "Scan",
    "SegslamError",
    "Slam",
    "evaluate",
    "export",
    "fleet",
    "georeference",
    "keep_freed_memory",
    "load_config",
    "localise",
    "locate",
    "map_folder",
    "merge",
    "open_dataset",
    "read_run",
    "register",
    "replay",
    "report",
]

_HOMES = {
    "Alignment": "core.types",
    "BadScan": "core.errors",
    "Config": "core.config",
    "Located": "run.locator",
    "Locator": "run.locator",
    "Places": "candidates",
    "Rejected": "core.types",
    "Scan": "core.types",
    "SegslamError": "core.errors",
    "Slam": "slam.slam",
    "evaluate": "run.evaluate",
    "export": "output.export",
    "fleet": "run.fleets.orchestrate",
    "georeference": "output.georeferenced",
    "keep_freed_memory": "core.memory",
    "load_config": "core.config",
    "locate": "run.locator",
    "localise": "run.sessions.localiser",
    "map_folder": "run.map_folder",
    "merge": "run.sessions.merge",
    "open_dataset": "scans",
    "read_run": "output.finished",
    "register": "verification",
    "replay": "run.replay",
    "report": "output.report",
}

_NAMES = {"report": "write_report"}
"""Names that differ in their modules."""


def __getattr__(name: str) -> Any:
    """Import a public name on first access; `segslam --help` needs none of them."""
    if name in _HOMES:
        return getattr(import_module(f"segslam.{_HOMES[name]}"), _NAMES.get(name, name))
    if name == "__version__":
        from importlib.metadata import version

        return version("segslam")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names for `help` and completion."""
    return [*__all__, "__version__", "__doc__", "__all__", "__name__", "__file__", "__path__"]

"""LiDAR pose-graph SLAM: KISS-ICP odometry, Segregator loop closing, GTSAM, MCAP logs.

run = segslam.map_folder("scans", "runs/first")         # map a folder of scans, or a recording
found = segslam.register(source_points, target_points)  # pose of one scan in another, without initial guess

`Slam` maps scan by scan; `open_dataset` and `Scan` provide scans; `read_run` reads the folder of a run.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from segslam.config import Config, load_config
    from segslam.datasets import open_dataset
    from segslam.fleets import fleet
    from segslam.registration import register
    from segslam.retrieval import Places
    from segslam.run.evaluate import evaluate
    from segslam.run.export import export
    from segslam.run.finished import read_run
    from segslam.run.georeferenced import georeference
    from segslam.run.locator import Located, Locator, locate
    from segslam.run.map_folder import map_folder
    from segslam.run.replay import replay
    from segslam.run.report import write_report as report
    from segslam.sessions.localise import localise
    from segslam.sessions.merge import merge
    from segslam.slam import Slam
    from segslam.system.memory import keep_freed_memory
    from segslam.types import Alignment, BadScan, Rejected, Scan, SegslamError

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
    "Alignment": "types",
    "BadScan": "errors",
    "Config": "config",
    "Located": "run.locator",
    "Locator": "run.locator",
    "Places": "retrieval",
    "Rejected": "types",
    "Scan": "types",
    "SegslamError": "errors",
    "Slam": "slam",
    "evaluate": "run.evaluate",
    "export": "run.export",
    "fleet": "fleets",
    "georeference": "run.georeferenced",
    "keep_freed_memory": "system.memory",
    "load_config": "config",
    "locate": "run.locator",
    "localise": "sessions.localise",
    "map_folder": "run.map_folder",
    "merge": "sessions.merge",
    "open_dataset": "datasets",
    "read_run": "run.finished",
    "register": "registration",
    "replay": "run.replay",
    "report": "run.report",
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

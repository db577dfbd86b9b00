"""LiDAR pose-graph SLAM: KISS-ICP odometry, Segregator loop closing, GTSAM, MCAP logs."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from segslam.alignment import register
    from segslam.allocator import keep_freed_memory
    from segslam.config import Config, load_config
    from segslam.datasets import open_dataset
    from segslam.slam import Slam

__all__ = ["Config", "Slam", "keep_freed_memory", "load_config", "open_dataset", "register"]

_HOMES = {
    "Config": "config",
    "Slam": "slam",
    "keep_freed_memory": "allocator",
    "load_config": "config",
    "open_dataset": "datasets",
    "register": "alignment",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: `segslam --help` needs none of them."""
    if name in _HOMES:
        return getattr(import_module(f"segslam.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

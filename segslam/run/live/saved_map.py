"""The map so far, written to a file during the run."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from segslam.core.config import MapConfig
from segslam.core.types import Keyframe, SegslamError, Transform
from segslam.output.log.drawing import CloudOf
from segslam.output.map import MapSummary, write_map


def save_map(T_world_keyframe: Mapping[int, Transform], cloud: CloudOf, file: Path, *, config: MapConfig) -> MapSummary:
    """Write the map of these keyframes, as `segslam export` does at the end of a run.

    The log keeps intensities for the end of the run only, so `map.color=intensity` gives way to classes here.
    Raises SegslamError if there is no keyframe, and OSError where the disk is full.
    """
    if not T_world_keyframe:
        raise SegslamError("there is no keyframe yet")
    if config.color == "intensity":
        config = config.model_copy(update={"color": "class"})
    return write_map(_keyframes(T_world_keyframe, cloud), [file], config=config)


def _keyframes(T_world_keyframe: Mapping[int, Transform], cloud: CloudOf) -> Iterator[tuple[Keyframe, Transform]]:
    for number, T_world in T_world_keyframe.items():
        points, labels = cloud(number)
        yield Keyframe(number, 0, 0, np.eye(4), 0.0, points, labels), T_world

"""The map so far: drawn by a separate thread when it has changed, or written to a file."""

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Condition, Thread
from time import monotonic
from typing import NamedTuple

import numpy as np

from segslam.core.config import MapConfig
from segslam.core.types import CloudOf, Keyframe, Labels, Points, SegslamError, Transform
from segslam.output.log.drawing import map_points
from segslam.output.map.write import write_map

logger = logging.getLogger(__name__)

GROWTH = 1.05
"""Chosen: without a correction, the map is drawn again when the number of keyframes has grown by this factor."""
LEAST_S, SHARE = 2.0, 0.15
"""Chosen: the map is drawn at most every 2 s, and for at most this share of the time."""


class DrawnMap(NamedTuple):
    """A map in the world frame."""

    points: Points
    labels: Labels
    T_world_keyframe: dict[int, Transform]
    stamp_ns: int
    """Stamp of its last keyframe."""


Show = Callable[[DrawnMap], None]


class LiveMap:
    """Draws the newest requested map and skips older requests; a context manager."""

    def __init__(self, shows: Sequence[Show]) -> None:
        self._shows = shows
        self._changed = Condition()
        self._wanted: tuple[dict[int, Transform], CloudOf, int] | None = None
        self._num_drawn = 0
        self._is_closed = False
        self._thread = Thread(target=self._draw_all, name="map", daemon=True)

    def __enter__(self) -> "LiveMap":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join()

    def note(
        self, T_world_keyframe: dict[int, Transform], cloud: CloudOf, *, stamp_ns: int, is_corrected: bool
    ) -> None:
        """Note a new keyframe. Does not wait for a map that is being drawn."""
        with self._changed:
            if self._shows and (is_corrected or self._wanted or len(T_world_keyframe) >= GROWTH * self._num_drawn):
                self._wanted = T_world_keyframe, cloud, stamp_ns
                self._changed.notify()

    def _draw_all(self) -> None:
        rest_s = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed, rest_s)
                self._changed.wait_for(lambda: self._is_closed or self._wanted)
                wanted, self._wanted = self._wanted, None
                if self._is_closed or wanted is None:
                    return
                T_world_keyframe, cloud, stamp_ns = wanted
                self._num_drawn = len(T_world_keyframe)
            started = monotonic()
            try:
                points, labels = map_points(T_world_keyframe, cloud)
                for show in self._shows:
                    show(DrawnMap(points, labels, T_world_keyframe, stamp_ns))
            except (SegslamError, OSError) as error:
                logger.warning("the map is not shown: %s", error)
                return
            rest_s = max(LEAST_S, (monotonic() - started) * (1 / SHARE - 1))


def save_map(T_world_keyframe: Mapping[int, Transform], cloud: CloudOf, file: Path, *, config: MapConfig) -> int:
    """Write the map of these keyframes, as `segslam export` does at the end of a run; returns its number of points.

    The log keeps intensities for the end of the run only, so `map.color=intensity` gives way to classes here.
    Raises SegslamError if there is no keyframe, and OSError where the disk is full.
    """
    if not T_world_keyframe:
        raise SegslamError("there is no keyframe yet")
    if config.color == "intensity":
        config = config.model_copy(update={"color": "class"})
    keyframes = (
        (Keyframe(number, 0, 0, np.eye(4), 0.0, *cloud(number)), T_world)
        for number, T_world in T_world_keyframe.items()
    )
    return write_map(keyframes, [file], config=config)["num_map_points"]

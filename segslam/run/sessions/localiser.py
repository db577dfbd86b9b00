"""Localisation of a drive in the map of a finished run: scan by scan, or a whole recording."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.config import Config
from segslam.core.processes import Progress, no_progress
from segslam.core.threads import Stopwatch
from segslam.core.trajectory import nearest_rows, travelled_m
from segslam.core.types import REJECTED_WEIGHT, GraphEstimate, LoopAttempt, Placement, Rejected, Step, Vector
from segslam.core.whole_files import expanded
from segslam.graph import AnchoredGraph
from segslam.odometry.sweep import Odometry
from segslam.output.finished import FinishedRun
from segslam.output.georeferenced import take_over
from segslam.registration.prepared import Labeller
from segslam.run.locator import Locator
from segslam.run.map_folder import SlamOf, map_folder
from segslam.run.sessions.placer import Placer
from segslam.slam.slam import Slam, SlamResult


def localiser_in(run: str | Path) -> SlamOf:
    """What makes pipelines that localise in the map of a finished run, which is read now."""
    return partial(Localiser, Locator.from_run(run))


class Localiser(Slam):
    """Odometry, keyframes, and their placements in an existing map, which is fixed. `process` each scan, then `finish`.

    A Step contains the keyframes placed in it (`placements`), or the reason why its own was not (`not_placed`). The
    trajectory is in the map's frame where `SlamResult.localised` is True; loops within the drive are not searched.
    """

    def __init__(
        self,
        locator: Locator,
        config: Config | None = None,
        *,
        odometry: Odometry | None = None,
        labeller: Labeller | None = None,
    ) -> None:
        """`locator` belongs to the existing map, where `config` is used, too; other arguments as for `Slam`."""
        super().__init__(config, odometry=odometry, labeller=labeller)
        if locator.config != self.config:
            locator = Locator(locator.session, self.config)
        self._placer = Placer(self.config, locator, self._anchored, self._loops.submaps)
        self._placed: tuple[tuple[Placement, ...], Rejected | None] = (), None

    def _new_graph(self) -> AnchoredGraph:
        self._anchored = AnchoredGraph(self.config.graph)
        return self._anchored

    def _advance(self, step: Step, watch: Stopwatch, *_: Any, **__: Any) -> Step:
        self._placed = (), None
        step = super()._advance(step, watch, self._place)
        placements, why = self._placed
        return replace(step, placements=placements, not_placed=why)

    def _place(self, keyframe_id: int, watch: Stopwatch) -> tuple[LoopAttempt, ...]:
        self._placed = self._placer.place(keyframe_id, watch)
        return ()

    def _settle(self, end_s: float) -> tuple[GraphEstimate, list[LoopAttempt]]:
        return self.graph.finish(), []

    def finish(self, *, search_s: float = math.inf, progress: Progress = no_progress) -> SlamResult:
        """As `Slam.finish`, in the map's frame; `from_map_m` determines which scans are localised."""
        return replace(super().finish(search_s=search_s, progress=progress), from_map_m=self._from_map_m())

    def _from_map_m(self) -> Vector:
        """(n,) travel from each scan to the nearest keyframe whose placement was kept; infinite across a break."""
        travel_m = travelled_m(self._odometry().T_world_lidar)
        segment = np.cumsum([motion.is_break for motion in self._motions])
        distance_m = np.full(len(travel_m), np.inf)
        kept = [number for number, weight in self._anchored.weights.items() if weight >= REJECTED_WEIGHT]
        placed = np.array([self._keyframe_rows[number] for number in sorted(kept)], dtype=int)
        for number in np.unique(segment[placed]):
            rows, own_m = np.flatnonzero(segment == number), travel_m[placed[segment[placed] == number]]
            distance_m[rows] = np.abs(travel_m[rows] - own_m[nearest_rows(own_m, travel_m[rows])])
        return distance_m


def localise(run: str | Path, data: str | Path, out: str | Path, **options: Any) -> FinishedRun:
    """Localise a folder of scans or a recording in the map of a finished run, like `segslam localise`.

    Options, files and errors are those of `map_folder`; its world frame, and its place on the globe, is that of the
    finished run. Raises SegslamError also if that did not finish or is damaged.
    """
    in_map = {"in_map": str(expanded(run).resolve())}
    made = map_folder(data, out, slam_of=localiser_in(run), options=in_map, **options)
    take_over(made.folder, run)
    return made

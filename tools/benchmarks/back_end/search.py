"""Proposals during the drive, with true closures within reach; and the gain of another search at the end."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from segslam.candidates.proximity import ProximityDetector
from segslam.core import geometry
from segslam.core.evaluation import FOUND_WITHIN_M, REVISIT_MIN_TRAVEL_M
from segslam.core.types import LoopClosure
from segslam.graph import PoseGraph
from tools.benchmarks.back_end.drives import CONFIG, Drive, closure

REACH_M = 8.0
"""Distance up to which two keyframes are always registered."""
MAX_ROUNDS = 3


class Search:
    """Search for loops in a drive."""

    def __init__(self, drive: Drive, rng: np.random.Generator) -> None:
        self._drive, self._rng = drive, rng
        self.graph, self.detector = PoseGraph(CONFIG.graph), ProximityDetector(CONFIG.proximity)
        self.closures: list[LoopClosure] = []
        self._tried: set[tuple[int, int]] = set()

    def look(self, keyframe_id: int) -> int:
        """Try new candidates of one keyframe; returns the number of closures found."""
        found = []
        graph = self.graph
        for candidate in self.detector.candidates(
            keyframe_id, graph.T_world_keyframes, graph.travel_m, graph.covariances
        ):
            pair = (keyframe_id, candidate.target_id)
            if pair in self._tried:
                continue
            self._tried.add(pair)
            T_target_source = self._drive.true(candidate.target_id, keyframe_id)
            if geometry.distance(T_target_source) <= REACH_M:
                found.append(closure(*pair, T_target_source, self._rng))
        for loop in found:
            graph.add_closure(loop)
            self.detector.note_closure(loop)
        self.closures += found
        return len(found)

    def figures(self) -> dict[str, Any]:
        return {
            "tried": len(self._tried),
            "closures": len(self.closures),
            "recall_4m": self._recall(4.0),
            "recall_10m": self._recall(10.0),
            **self._drive.errors(self.graph.T_world_keyframes),
        }

    def _recall(self, within_m: float) -> float | None:
        """Share of the keyframes this near to an old one that have a closure within 10 m of travel."""
        wanted = self._drive.travel_m[list(_revisits(self._drive, within_m))]
        closed = self._drive.travel_m[[loop.source_id for loop in self.closures]]
        away_m = np.abs(wanted[:, None] - closed).min(axis=1, initial=np.inf)
        return float((away_m <= FOUND_WITHIN_M).mean()) if len(wanted) else None


def _revisits(drive: Drive, within_m: float) -> Iterator[int]:
    positions = drive.truth[:, :3, 3]
    for row, position in enumerate(positions):
        old = positions[:row][drive.travel_m[:row] <= drive.travel_m[row] - REVISIT_MIN_TRAVEL_M]
        if len(old) and np.linalg.norm(old - position, axis=1).min() <= within_m:
            yield row


def search(drive: Drive, rng: np.random.Generator) -> tuple[list[LoopClosure], dict[str, Any]]:
    """The closures found while driving; recall, tries, errors; and the same after each search with corrected poses."""
    looking, seconds = Search(drive, rng), []
    for keyframe_id, (T_odom_keyframe, travel) in enumerate(zip(drive.odometry, drive.travel_m, strict=True)):
        looking.graph.add_keyframe(keyframe_id, T_odom_keyframe, float(travel))
        if looking.look(keyframe_id):
            started = time.perf_counter()
            estimate = looking.graph.optimize()
            looking.detector.note_estimate(estimate.closure_weights)
            seconds.append(time.perf_counter() - started)
    last = np.array(seconds[-max(1, len(seconds) // 10) :] or [np.nan])
    looking.graph.finish()
    closures, figures = list(looking.closures), looking.figures()
    figures["optimize_ms_last_tenth"] = {"median": 1e3 * np.median(last), "p95": 1e3 * np.percentile(last, 95)}
    figures["odometry_ate_m"] = drive.errors(drive.odometry)["ate_m"]
    figures["again"] = []
    while len(figures["again"]) < MAX_ROUNDS:
        if not sum(looking.look(keyframe_id) for keyframe_id in range(len(drive.truth))):
            break
        looking.graph.finish()
        figures["again"].append(looking.figures())
    return closures, figures

"""Loop candidates by distance: older keyframes that are probably near the newest one, but far in travel.

The poses of the graph and their covariance show how probable that is. Where that is little, after much drift or
across a break of the odometry, similar places are searched instead (`places`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr

from segslam.candidates.places import SAME_PLACE_M
from segslam.core import geometry
from segslam.core.config import ProximityConfig
from segslam.core.probabilities import INLIER_PROBABILITY, sigmas_beyond
from segslam.core.types import REJECTED_WEIGHT, IndexPairs, Indices, LoopCandidate, LoopClosure, Vector

LEAST_PROBABILITY = 1.0 - INLIER_PROBABILITY
"""Two keyframes that are near each other with a smaller probability are no candidate."""
FARTHEST = sigmas_beyond(LEAST_PROBABILITY)
"""An error of more standard deviations has a smaller probability than that."""
HEIGHT_M = 1.0
"""Chosen: storeys are 3 m apart: largest height difference of two visits of a place (m)."""
MAX_CANDIDATES = 2
"""Chosen: number of candidates per keyframe."""
GAP_M = 2.0 * SAME_PLACE_M
"""Chosen: travel between two loops, and between two candidates of a keyframe: every second place."""

Covariances = Callable[[int, Indices], Float[np.ndarray, "_ 6 6"]]
"""Covariance of the pose of a keyframe in each of others, as a tangent of the keyframe (`graph.covariances`)."""


class ProximityDetector:
    """Proposes loop candidates, and stores the accepted loops.

    A search compares all keyframes with the new one by position; all other computations are for near keyframes only.
    """

    def __init__(self, config: ProximityConfig) -> None:
        self._config = config
        self._closures: IndexPairs = np.empty((0, 2), dtype=np.int64)
        self._kept = np.empty(0, dtype=bool)

    def note_closure(self, closure: LoopClosure) -> None:
        """Exclude the surroundings of this loop from the following searches."""
        self._closures = np.vstack([self._closures, [[closure.source_id, closure.target_id]]])
        self._kept = np.append(self._kept, True)

    def note_estimate(self, closure_weights: Mapping[tuple[int, int], float]) -> None:
        """Note the weights of a `GraphEstimate`: the surroundings of a closure that it rejected are searched again."""
        weights = [closure_weights.get((source, target), 1.0) for source, target in self._closures.tolist()]
        self._kept = np.array(weights) >= REJECTED_WEIGHT

    def candidates(
        self,
        source_id: int,
        T_world_keyframes: Float[np.ndarray, "n 4 4"],
        travel_m: Float[np.ndarray, " n"],
        covariances: Covariances,
        *,
        below: int | None = None,
    ) -> tuple[LoopCandidate, ...]:
        """At most `MAX_CANDIDATES` older keyframes near one, sorted by distance, `GAP_M` of travel apart.

        Row i of the arrays is keyframe i, by the current estimate. Distances are horizontal, because the height of
        LiDAR odometry drifts most; heights separate the storeys of a building. If `below` is given, only smaller ids
        are proposed.
        """
        num_far = int(np.searchsorted(travel_m, travel_m[source_id] - self._config.min_travel_m, side="right"))
        older = np.arange(min(num_far, source_id, source_id if below is None else below))
        near = nearness(source_id, older, T_world_keyframes, covariances, radius_m=self._config.base_radius_m)
        is_open = near.probability >= LEAST_PROBABILITY
        is_open[is_open] &= ~self._is_closed(source_id, older[is_open], travel_m, near.reach_m[is_open])
        nearest_first = np.flatnonzero(is_open)[np.argsort(near.distance_m[is_open], kind="stable")]
        chosen: list[int] = []
        for row in nearest_first.tolist():
            if len(chosen) < MAX_CANDIDATES and all(abs(travel_m[row] - travel_m[k]) >= GAP_M for k in chosen):
                chosen.append(row)
        return tuple(near.candidate(row) for row in chosen)

    def _is_closed(self, source_id: int, ids: Indices, travel_m: Vector, reach_m: Vector) -> Bool[np.ndarray, " k"]:
        """True for targets near a loop closed within the last `GAP_M`: closer to its target, in travel, than
        `GAP_M` plus the reach of the search."""
        sources, targets = self._closures[self._kept].T
        recent = targets[np.abs(travel_m[sources] - travel_m[source_id]) < GAP_M]
        apart_m = np.abs(travel_m[ids, None] - travel_m[recent])
        return (apart_m < GAP_M + reach_m[:, None]).any(axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Nearness:
    """How near one keyframe is to others (k), by the current estimate."""

    source_id: int
    ids: Indices
    T_world_keyframes: Float[np.ndarray, "n 4 4"]
    covariances: Float[np.ndarray, "k 6 6"]
    distance_m: Vector
    """Horizontal distance."""
    same_height: Vector
    """Probability that the heights differ by an error of the estimate: 1 up to `HEIGHT_M`, little on another storey."""
    probability: Vector
    """Probability that the two are within the radius, and not on different storeys."""
    reach_m: Vector
    """Largest distance that is probably within the radius."""

    def candidate(self, row: int) -> LoopCandidate:
        """The loop with one of the others."""
        target_id = int(self.ids[row])
        T_target_source = geometry.inverse(self.T_world_keyframes[target_id]) @ self.T_world_keyframes[self.source_id]
        return LoopCandidate(
            self.source_id,
            target_id,
            T_target_source,
            geometry.distance(T_target_source),
            self.covariances[row].copy(),  # a view would keep those of all others
            float(self.probability[row]),
        )


def nearness(
    source_id: int,
    ids: Indices,
    T_world_keyframes: Float[np.ndarray, "n 4 4"],
    covariances: Covariances,
    *,
    radius_m: float,
) -> Nearness:
    """How near a keyframe is to others, with `radius_m` as the distance from which two scans see the same place."""
    found = covariances(source_id, ids)
    R_world_source = T_world_keyframes[source_id, :3, :3]
    spread = np.einsum("kij,lj->kil", np.einsum("ij,kjl->kil", R_world_source, found[:, 3:, 3:]), R_world_source)
    offset = T_world_keyframes[source_id, :3, 3] - T_world_keyframes[ids, :3, 3]
    distance_m = np.hypot(offset[:, 0], offset[:, 1])
    ahead = offset[:, :2] / np.maximum(distance_m, 1e-9)[:, None]
    ahead[distance_m < 1e-9] = (1.0, 0.0)
    aside = ahead[:, ::-1] * (-1.0, 1.0)
    along_m, across_m = (
        np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", way, spread[:, :2, :2], way), 1e-12)) for way in (ahead, aside)
    )
    height_m = np.sqrt(np.maximum(spread[:, 2, 2], 1e-12))
    probability = ndtr((radius_m - distance_m) / along_m) - ndtr((-radius_m - distance_m) / along_m)
    probability *= 2.0 * ndtr(radius_m / across_m) - 1.0
    same_height = np.minimum(1.0, 2.0 * ndtr((HEIGHT_M - np.abs(offset[:, 2])) / height_m))
    probability *= same_height
    reach_m = radius_m + FARTHEST * np.maximum(along_m, across_m)
    return Nearness(source_id, ids, T_world_keyframes, found, distance_m, same_height, probability, reach_m)

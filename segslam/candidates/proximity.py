"""Loop candidates by distance: older keyframes near the newest one by the graph's estimate, but far in travel.

Odometry drifts with the distance travelled, so the error between two keyframes is bounded by the length of the shortest
chain of odometry and loops between them. The search radius of each target grows with that chain. This approximates the
bound by a covariance, and costs one run of Dijkstra's algorithm over the keyframes with loops.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from segslam.candidates.prior import height_bounds_m
from segslam.core import geometry
from segslam.core.config import ProximityConfig
from segslam.core.types import REJECTED_WEIGHT, IndexPairs, Indices, LoopCandidate, LoopClosure, Vector

BREAK_RADIUS_M = 60.0
"""Chosen: search radius across a break of the odometry (m)."""
MAX_CANDIDATES = 2
"""Chosen: number of candidates per keyframe."""
SPREAD_M = 8.0
"""Chosen: smallest distance travelled between two candidates of one keyframe (m)."""
MIN_GAP_M = 8.0
"""Chosen: distance travelled after an accepted loop before the next search (m)."""

BREAK_TRAVEL_M = 1e5
"""Travel assigned to a break of the odometry, because the relative pose across it is unknown."""
NO_CLOSURES: IndexPairs = np.empty((0, 2), dtype=np.int64)


class ProximityDetector:
    """Proposes loop candidates, and stores the accepted loops.

    A search compares all keyframes with the new one by position; all other computations are for near keyframes only.
    """

    def __init__(self, config: ProximityConfig) -> None:
        self._config = config
        self._closures = NO_CLOSURES
        self._kept = np.empty(0, dtype=bool)
        self._chains = Chains(NO_CLOSURES)

    def note_closure(self, closure: LoopClosure) -> None:
        """Exclude the surroundings of this loop from the following searches."""
        self._closures = np.vstack([self._closures, [[closure.source_id, closure.target_id]]])
        self._kept = np.append(self._kept, True)

    def note_estimate(self, closure_weights: Mapping[tuple[int, int], float]) -> None:
        """Use the closures noted so far in the chains, with the weights of a `GraphEstimate`.

        A closure that the optimiser rejected shortens no chain, and its surroundings are searched again.
        """
        weights = [closure_weights.get((source, target), 1.0) for source, target in self._closures.tolist()]
        self._kept = np.array(weights) >= REJECTED_WEIGHT
        self._chains = Chains(self._closures[self._kept])

    def candidates(
        self,
        source_id: int,
        T_world_keyframes: Float[np.ndarray, "n 4 4"],
        travel_m: Float[np.ndarray, " n"],
        *,
        below: int | None = None,
    ) -> tuple[LoopCandidate, ...]:
        """At most `max_candidates` older keyframes near one, sorted by distance, `spread_m` of travel apart.

        Row i of the arrays is keyframe i, by the current estimate. Distances are horizontal, because the height of
        LiDAR odometry drifts most. Heights may differ by `prior.height_bounds_m`, which separates the storeys of a
        building. If `below` is given, only smaller ids are proposed.
        """
        config = self._config
        within_reach = self._within_reach(source_id, T_world_keyframes, travel_m)
        within_reach = within_reach if below is None else within_reach[within_reach < below]
        chain_m = self._chains.lengths_m(source_id, within_reach, travel_m)
        radius_m = search_radius_m(chain_m, config=config)
        offset = T_world_keyframes[within_reach, :3, 3] - T_world_keyframes[source_id, :3, 3]
        distance_m = np.hypot(offset[:, 0], offset[:, 1])
        eligible = (
            (distance_m <= radius_m)
            & (np.abs(offset[:, 2]) <= height_bounds_m(chain_m))
            & ~self._is_closed(source_id, within_reach, travel_m, radius_m)
        )
        nearest_first = np.flatnonzero(eligible)[np.argsort(distance_m[eligible], kind="stable")]
        rows = _spread_out(nearest_first, travel_m[within_reach], SPREAD_M, MAX_CANDIDATES)
        T_source_world = geometry.inverse(T_world_keyframes[source_id])
        return tuple(
            LoopCandidate(
                source_id=source_id,
                target_id=int(within_reach[row]),
                T_target_source_prior=geometry.inverse(T_source_world @ T_world_keyframes[within_reach[row]]),
                distance_m=float(np.linalg.norm(offset[row])),
                search_radius_m=float(radius_m[row]),
                chain_m=float(chain_m[row]),
            )
            for row in rows
        )

    def _within_reach(self, source_id: int, T_world_keyframes: np.ndarray, travel_m: Vector) -> Indices:
        """Older keyframes far enough in travel and within the largest radius."""
        config = self._config
        num_far = np.searchsorted(travel_m, travel_m[source_id] - config.min_travel_m, side="right")
        x, y = T_world_keyframes[: min(num_far, source_id), :2, 3].T - T_world_keyframes[source_id, :2, 3, None]
        largest_m = max(config.max_radius_m, BREAK_RADIUS_M) if _has_break(travel_m) else config.max_radius_m
        return np.flatnonzero(np.hypot(x, y) <= largest_m)

    def _is_closed(self, source_id: int, ids: Indices, travel_m: Vector, radius_m: Vector) -> Bool[np.ndarray, " k"]:
        """True for targets near a loop closed within the last `min_gap_m`: closer to its target, in travel, than
        `min_gap_m` plus the search radius."""
        sources, targets = self._closures[self._kept].T
        recent = targets[np.abs(travel_m[sources] - travel_m[source_id]) < MIN_GAP_M]
        apart_m = np.abs(travel_m[ids, None] - travel_m[recent])
        return (apart_m < MIN_GAP_M + radius_m[:, None]).any(axis=1)


class Chains:
    """Shortest chains between keyframes along odometry, with its length, and closures, with length 0.

    Chains branch at the ends of closures only, so the searched graph has no other vertices.
    """

    def __init__(self, closures: IndexPairs) -> None:
        """`closures` (k, 2): the two keyframes of each."""
        self._pairs = np.unique(closures, axis=0)  # the sparse format would add up duplicates
        self._ends = np.unique(self._pairs)
        self._found: dict[int, Vector] = {}

    def lengths_m(self, source_id: int, ids: Indices, travel_m: Vector) -> Vector:
        """(k,) lengths of the chains from one keyframe to others."""
        straight_m = np.abs(travel_m[ids] - travel_m[source_id])
        if not len(self._ends):
            return straight_m
        ends_m = travel_m[self._ends]
        source_ends = [int(end[0]) for end in self._beside(np.array([source_id]))]
        turning_m = np.min(
            [self._from(end, ends_m) + abs(ends_m[end] - travel_m[source_id]) for end in source_ends], axis=0
        )
        by_ends_m = [turning_m[end] + np.abs(ends_m[end] - travel_m[ids]) for end in self._beside(ids)]
        return np.minimum(straight_m, np.min(by_ends_m, axis=0))

    def _beside(self, ids: Indices) -> tuple[Indices, Indices]:
        """Rows of the closure ends before and after each keyframe in travel; the same row twice at the margins."""
        after = np.searchsorted(self._ends, ids)
        return np.maximum(after - 1, 0), np.minimum(after, len(self._ends) - 1)

    def _from(self, end: int, ends_m: Vector) -> Vector:
        """Lengths from one end to all ends, cached: successive keyframes mostly start at the same end."""
        if end not in self._found:
            rows = np.arange(len(self._ends) - 1)
            sources, targets = np.searchsorted(self._ends, self._pairs).T
            lengths = np.concatenate([np.diff(ends_m), np.zeros(len(self._pairs))])
            places = np.concatenate([rows, sources]), np.concatenate([rows + 1, targets])
            graph = coo_array((lengths, places), shape=(len(self._ends), len(self._ends)))
            self._found[end] = dijkstra(graph, directed=False, indices=np.array(end))
        return self._found[end]


def search_radius_m(chain_m: Vector, *, config: ProximityConfig) -> Vector:
    """Largest error of each keyframe's position relative to another, from the length of the chain between them (m).

    A chain across a break of the odometry is longer than any drive (`BREAK_TRAVEL_M`).
    """
    radius_m = np.minimum(config.base_radius_m + config.drift_ratio * chain_m, config.max_radius_m)
    return np.where(chain_m >= BREAK_TRAVEL_M, max(BREAK_RADIUS_M, config.max_radius_m), radius_m)


def _has_break(travel_m: Vector) -> bool:
    return len(travel_m) > 0 and bool(travel_m[-1] - travel_m[0] >= BREAK_TRAVEL_M)


def _spread_out(ranked: Indices, travel_m: Vector, spread_m: float, most: int) -> list[int]:
    """At most `most` rows by rank, skipping rows within `spread_m` of travel of a better one."""
    chosen: list[int] = []
    for keyframe_id in ranked:
        if len(chosen) == most:
            break
        if all(abs(travel_m[keyframe_id] - travel_m[other]) >= spread_m for other in chosen):
            chosen.append(int(keyframe_id))
    return chosen

"""Which old keyframes may show what the new one sees: near in space by the graph's estimate, far in travel.

Odometry drifts with the way travelled, so two keyframes can be as wrong about each other as the shortest chain between
them is long, and an accepted loop is a short cut. The search radius grows with that chain, target by target: the bound
that a covariance would give, at the price of one Dijkstra run over the ends of loops.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from segslam import geometry
from segslam.config import ProximityConfig
from segslam.types import IndexPairs, Indices, LoopCandidate, LoopClosure, Vector

NO_CLOSURES: IndexPairs = np.empty((0, 2), dtype=np.int64)


class ProximityDetector:
    """Proposes loops, and remembers those accepted.

    A proposal compares the place of each keyframe with the new one's; all else that it costs is for those near.
    """

    def __init__(self, config: ProximityConfig) -> None:
        self._config = config
        self._closures = NO_CLOSURES
        self._chains = Chains(NO_CLOSURES)

    def note_closure(self, closure: LoopClosure) -> None:
        """From now on the surroundings of this loop are not searched again."""
        self._closures = np.vstack([self._closures, [[closure.source_id, closure.target_id]]])

    def note_estimate(self) -> None:
        """From now on poses are such that all closures noted so far tie their two ends together."""
        self._chains = Chains(self._closures)

    def candidates(
        self, source_id: int, T_world_keyframes: Float[np.ndarray, "n 4 4"], travel_m: Float[np.ndarray, " n"]
    ) -> tuple[LoopCandidate, ...]:
        """At most `max_candidates` older keyframes for one, the nearest first, `spread_m` of travel apart.

        Row i of the arrays is the keyframe of id i, as the graph estimates it now. Distance is horizontal, for the
        height of LiDAR odometry drifts most and a road's height differs little between two passes; the heights may
        differ by `height_factor` radii.
        """
        config = self._config
        within_reach = self._within_reach(source_id, T_world_keyframes, travel_m)
        chain_m = self._chains.lengths_m(source_id, within_reach, travel_m)
        radius_m = search_radius_m(chain_m, config=config)
        offset = T_world_keyframes[within_reach, :3, 3] - T_world_keyframes[source_id, :3, 3]
        distance_m = np.hypot(offset[:, 0], offset[:, 1])
        eligible = (
            (distance_m <= radius_m)
            & (np.abs(offset[:, 2]) <= config.height_factor * radius_m)
            & ~self._is_closed(source_id, within_reach, travel_m, radius_m)
        )
        nearest_first = np.flatnonzero(eligible)[np.argsort(distance_m[eligible], kind="stable")]
        rows = _spread_out(nearest_first, travel_m[within_reach], config.spread_m, config.max_candidates)
        T_source_world = geometry.inverse(T_world_keyframes[source_id])
        return tuple(
            LoopCandidate(
                source_id=source_id,
                target_id=int(within_reach[row]),
                T_target_source_prior=geometry.inverse(T_source_world @ T_world_keyframes[within_reach[row]]),
                distance_m=float(np.linalg.norm(offset[row])),
                search_radius_m=float(radius_m[row]),
            )
            for row in rows
        )

    def _within_reach(self, source_id: int, T_world_keyframes: np.ndarray, travel_m: Vector) -> Indices:
        """Older keyframes far enough in travel and, whatever their radius, near enough; travel grows with the id."""
        config = self._config
        num_far = np.searchsorted(travel_m, travel_m[source_id] - config.min_travel_m, side="right")
        x, y = T_world_keyframes[: min(num_far, source_id), :2, 3].T - T_world_keyframes[source_id, :2, 3, None]
        return np.flatnonzero(np.hypot(x, y) <= config.max_radius_m)

    def _is_closed(self, source_id: int, ids: Indices, travel_m: Vector, radius_m: Vector) -> Bool[np.ndarray, " k"]:
        """Which targets lie where a loop has just been closed: within `min_gap_m` of it on the side of the source, and
        on that of the target not so much farther that another place could be meant."""
        sources, targets = self._closures.T
        recent = targets[np.abs(travel_m[sources] - travel_m[source_id]) < self._config.min_gap_m]
        apart_m = np.abs(travel_m[ids, None] - travel_m[recent])
        return (apart_m < self._config.min_gap_m + radius_m[:, None]).any(axis=1)


class Chains:
    """The shortest ways between keyframes along odometry, which is as long as it is, and closures, of no length.

    They turn off at ends of closures only, so the graph that is searched has no other vertices.
    """

    def __init__(self, closures: IndexPairs) -> None:
        """`closures` (k, 2): the two keyframes of each."""
        self._pairs = np.unique(closures, axis=0)  # the sparse format would add up what stands there twice
        self._ends = np.unique(self._pairs)
        self._found: dict[int, Vector] = {}

    def lengths_m(self, source_id: int, ids: Indices, travel_m: Vector) -> Vector:
        """(k,) from one keyframe to each of some others."""
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
        """Rows of the ends next to some keyframes, before and after them in travel; twice the same at the margins."""
        after = np.searchsorted(self._ends, ids)
        return np.maximum(after - 1, 0), np.minimum(after, len(self._ends) - 1)

    def _from(self, end: int, ends_m: Vector) -> Vector:
        """From one end to all ends; kept, for a new keyframe mostly asks from where the last one did."""
        if end not in self._found:
            rows = np.arange(len(self._ends) - 1)
            sources, targets = np.searchsorted(self._ends, self._pairs).T
            lengths = np.concatenate([np.diff(ends_m), np.zeros(len(self._pairs))])
            places = np.concatenate([rows, sources]), np.concatenate([rows + 1, targets])
            graph = coo_array((lengths, places), shape=(len(self._ends), len(self._ends)))
            self._found[end] = dijkstra(graph, directed=False, indices=np.array(end))
        return self._found[end]


def search_radius_m(chain_m: Vector, *, config: ProximityConfig) -> Vector:
    """How far the estimate of each keyframe may be off as seen from one, in metres, by the chain to it."""
    return np.minimum(config.base_radius_m + config.drift_ratio * chain_m, config.max_radius_m)


def _spread_out(ranked: Indices, travel_m: Vector, spread_m: float, most: int) -> list[int]:
    """The best ranked, without those nearer in travel than `spread_m` to a better one; at most `most`."""
    chosen: list[int] = []
    for keyframe_id in ranked:
        if len(chosen) == most:
            break
        if all(abs(travel_m[keyframe_id] - travel_m[other]) >= spread_m for other in chosen):
            chosen.append(int(keyframe_id))
    return chosen

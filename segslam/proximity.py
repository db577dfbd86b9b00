"""Which old keyframes may show what the new one sees: near in space by the graph's estimate, far in travel.

Odometry drifts with the way travelled, so two keyframes can be as wrong about each other as the shortest chain between
them is long, and an accepted loop is a short cut. The search radius grows with that chain, target by target: the bound
that a covariance would give, at the price of one Dijkstra run.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from segslam import geometry
from segslam.config import ProximityConfig
from segslam.types import IndexPairs, Indices, LoopCandidate, LoopClosure, Vector


class ProximityDetector:
    """Proposes loops, and remembers those accepted."""

    def __init__(self, config: ProximityConfig) -> None:
        self._config = config
        self._closures = np.empty((0, 2), dtype=np.int64)

    def note_closure(self, closure: LoopClosure) -> None:
        """From now on this loop ties its two ends together, and its surroundings are not searched again."""
        self._closures = np.vstack([self._closures, [[closure.source_id, closure.target_id]]])

    def candidates(
        self, source_id: int, T_world_keyframes: Float[np.ndarray, "n 4 4"], travel_m: Float[np.ndarray, " n"]
    ) -> tuple[LoopCandidate, ...]:
        """At most `max_candidates` older keyframes for one, the nearest first, `spread_m` of travel apart.

        Row i of the arrays is the keyframe of id i, as the graph estimates it now. Distance is horizontal, for the
        height of LiDAR odometry drifts most and a road's height differs little between two passes; the heights may
        differ by `height_factor` radii.
        """
        config = self._config
        radius_m = search_radius_m(source_id, travel_m, self._closures, config=config)
        offset = T_world_keyframes[:, :3, 3] - T_world_keyframes[source_id, :3, 3]
        distance_m = np.hypot(offset[:, 0], offset[:, 1])
        eligible = (
            (np.arange(len(travel_m)) < source_id)
            & (travel_m[source_id] - travel_m >= config.min_travel_m)
            & (distance_m <= radius_m)
            & (np.abs(offset[:, 2]) <= config.height_factor * radius_m)
            & ~self._is_closed(source_id, travel_m, radius_m)
        )
        nearest_first = np.flatnonzero(eligible)[np.argsort(distance_m[eligible], kind="stable")]
        targets = _spread_out(nearest_first, travel_m, config.spread_m, config.max_candidates)
        T_source_world = geometry.inverse(T_world_keyframes[source_id])
        return tuple(
            LoopCandidate(
                source_id=source_id,
                target_id=target_id,
                T_target_source_prior=geometry.inverse(T_source_world @ T_world_keyframes[target_id]),
                distance_m=float(np.linalg.norm(offset[target_id])),
                search_radius_m=float(radius_m[target_id]),
            )
            for target_id in targets
        )

    def _is_closed(self, source_id: int, travel_m: Vector, radius_m: Vector) -> Bool[np.ndarray, " n"]:
        """Which targets lie where a loop has just been closed: within `min_gap_m` of it on the side of the source, and
        on that of the target not so much farther that another place could be meant."""
        sources, targets = self._closures.T
        recent = targets[np.abs(travel_m[sources] - travel_m[source_id]) < self._config.min_gap_m]
        apart_m = np.abs(travel_m[:, None] - travel_m[recent])
        return (apart_m < self._config.min_gap_m + radius_m[:, None]).any(axis=1)


def search_radius_m(source_id: int, travel_m: Vector, closures: IndexPairs, *, config: ProximityConfig) -> Vector:
    """How far the estimate of each keyframe may be off as seen from one, in metres.

    `closures` holds (source id, target id); the chain to a keyframe is the shortest along odometry and closures.
    """
    chain_m = dijkstra(_chains(travel_m, closures), directed=False, indices=np.array(source_id))
    return np.minimum(config.base_radius_m + config.drift_ratio * chain_m, config.max_radius_m)


def _chains(travel_m: Vector, closures: IndexPairs) -> coo_array:
    """The graph whose edges are odometry, as long as the way, and closures, of no length."""
    ids = np.arange(len(travel_m) - 1)
    pairs = np.unique(closures, axis=0)  # the sparse format would add up what stands there twice
    lengths = np.concatenate([np.diff(travel_m), np.zeros(len(pairs))])
    rows, columns = np.concatenate([ids, pairs[:, 0]]), np.concatenate([ids + 1, pairs[:, 1]])
    return coo_array((lengths, (rows, columns)), shape=(len(travel_m), len(travel_m)))


def _spread_out(ranked: Indices, travel_m: Vector, spread_m: float, most: int) -> list[int]:
    """The best ranked, without those nearer in travel than `spread_m` to a better one; at most `most`."""
    chosen: list[int] = []
    for keyframe_id in ranked:
        if len(chosen) == most:
            break
        if all(abs(travel_m[keyframe_id] - travel_m[other]) >= spread_m for other in chosen):
            chosen.append(int(keyframe_id))
    return chosen

"""How uncertain the pose of one keyframe in another is, by the motions and loops between the two.

The covariance of the shortest chain of motions and loops bounds that of the whole graph from above, at the cost of one
run of Dijkstra's algorithm over the keyframes with loops. Each link of a chain moves all that comes after it as a rigid
body, so in the world frame the covariances of its links add up, and those of a stretch of odometry are a difference of
two sums.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from segslam.core import geometry
from segslam.core.config import Config, GraphConfig
from segslam.core.trajectory import Poses, Rows
from segslam.core.types import Indices, Information, LoopCandidate, Rejected, RejectReason, Transform, Vector
from segslam.graph import noise
from segslam.graph.closure_pairs import Matrices, adjoints, carried
from segslam.graph.edges import Edge
from segslam.verification.trial import Gate

Link = tuple[float, Information]
"""Length of a link, and its covariance in the world frame."""


class Chains:
    """Shortest chains between keyframes along motions and closures; a length is the variance of a link.

    Chains branch at the ends of closures only, so the searched graph has no other vertices.
    """

    def __init__(self, T_world: Poses, odometry: Sequence[Edge], closures: Sequence[Edge]) -> None:
        """`odometry` leads from each vertex 0, 1, 2, ... to the next; `T_world` (n, 4, 4): their poses."""
        self._T_world = Rows(T_world)
        summed, length = np.zeros((len(T_world), 6, 6)), np.zeros(len(T_world))
        summed[1:] = np.cumsum(carried(T_world[1:], odometry), axis=0)
        length[1:] = np.cumsum([_length(edge) for edge in odometry])
        self._summed, self._length = Rows(summed), Rows(length)
        self._ends = np.unique(np.array([(edge.a, edge.b) for edge in closures], dtype=np.int64))
        self._links = self._linked(closures)
        pairs = np.array(list(self._links), dtype=np.int64).reshape(-1, 2)
        lengths = [length for length, _ in self._links.values()]
        self._graph = coo_array((lengths, tuple(pairs.T)), shape=(len(self._ends), len(self._ends))).tocsr()
        self._trees: dict[int, _Tree] = {}
        """Those of the last keyframe; the next one starts at the same ends, or at one of them."""

    def add(self, T_world: Transform, motion: Edge) -> None:
        """Add the next vertex."""
        self._T_world.append(T_world)
        self._summed.append(self._summed.all()[-1] + carried(T_world[None], [motion])[0])
        self._length.append(self._length.all()[-1] + _length(motion))

    def covariances(self, source_id: int, ids: Indices) -> Matrices:
        """(k, 6, 6) covariance of the pose of one keyframe in each of others, as a tangent of `source_id`."""
        length, summed = self._odometry(source_id, ids)
        if len(self._ends):
            starts = sorted({int(row[0]) for row in self._beside(np.array([source_id]))})
            self._trees = {start: self._trees.get(start) or _Tree(self._graph, start) for start in starts}
            for row in self._beside(ids):
                along, between = self._odometry(self._ends[row], ids)
                for start, tree in self._trees.items():
                    way, own = self._odometry(source_id, self._ends[[start]])
                    lengths, covariances = tree.lengths, tree.covariances(row, self._links)
                    total = way + lengths[row] + along
                    shorter = total < length
                    length = np.where(shorter, total, length)
                    summed[shorter] = (own + covariances + between)[shorter]
        (turn,) = adjoints(geometry.inverse(self._T_world.all()[source_id])[None])
        return np.einsum("kij,lj->kil", np.einsum("ij,kjl->kil", turn, summed), turn)  # uses one thread

    def _odometry(self, a: int | Indices, b: Indices) -> tuple[Vector, Matrices]:
        """Lengths and covariances along the odometry alone."""
        later, earlier = np.maximum(a, b), np.minimum(a, b)
        length, summed = self._length.all(), self._summed.all()
        return length[later] - length[earlier], summed[later] - summed[earlier]

    def _beside(self, ids: Indices) -> tuple[Indices, Indices]:
        """Rows of the closure ends before and after each keyframe; the same row twice at the margins."""
        after = np.searchsorted(self._ends, ids)
        return np.maximum(after - 1, 0), np.minimum(after, len(self._ends) - 1)

    def _linked(self, closures: Sequence[Edge]) -> dict[tuple[int, int], Link]:
        """The shortest link between each two neighbouring rows of ends."""
        between = zip(*self._odometry(self._ends[:-1], self._ends[1:]), strict=True)
        links: dict[tuple[int, int], Link] = {(row, row + 1): link for row, link in enumerate(between)}
        own = carried(self._T_world.all()[[edge.b for edge in closures]], closures)
        for edge, covariance in zip(closures, own, strict=True):
            first, last = np.searchsorted(self._ends, sorted((edge.a, edge.b))).tolist()
            length = _length(edge)
            if (first, last) not in links or length < links[first, last][0]:
                links[first, last] = length, covariance
        return links


class _Tree:
    """The shortest chains from one of the ends to all others."""

    def __init__(self, graph: csr_array, start: int) -> None:
        self.lengths, self._before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        self._covariances = np.zeros((len(self.lengths), 6, 6))
        self._is_known = np.arange(len(self.lengths)) == start

    def covariances(self, ends: Indices, links: Mapping[tuple[int, int], Link]) -> Matrices:
        """(k, 6, 6) covariances of the chains to some ends, in the world frame."""
        for end in np.unique(ends[~self._is_known[ends]]).tolist():
            chain = []
            while not self._is_known[end]:
                chain.append(end)
                end = int(self._before[end])
            for row in reversed(chain):
                self._covariances[row] = self._covariances[end] + links[min(row, end), max(row, end)][1]
                self._is_known[row] = True
                end = row
        return self._covariances[ends]


def _length(edge: Edge) -> float:
    """Variance of an edge; a radian counts as `noise.TURN_M` metres."""
    variances = np.diag(np.linalg.inv(edge.information))
    return float(noise.TURN_M**2 * variances[:3].sum() + variances[3:].sum())


def far_from_prior(
    T_target_source: Transform, candidate: LoopCandidate, config: GraphConfig, *, slack_m: float = 0.0
) -> Rejected | None:
    """Rejects with FAR_FROM_PRIOR a pose that contradicts the motions and loops between two keyframes; None otherwise.

    It is the test that a loop has to pass in the graph (`noise.inlier_bound`). `slack_m`: distance by which refinement
    may still move the pose; a radian counts as `noise.TURN_M` metres.
    """
    bound = noise.inlier_bound(error_allowance=config.error_allowance)
    slack = geometry.tangent(rotation_rad=slack_m / noise.TURN_M, translation_m=slack_m) ** 2 / bound
    off = geometry.log(geometry.inverse(candidate.T_target_source_prior) @ T_target_source)
    covariance = candidate.covariance + (noise.CLOSURE_NOISE + np.diag(slack))
    chi2 = float(off @ np.linalg.solve(covariance, off))
    if chi2 <= bound:
        return None
    away = f"{np.linalg.norm(off[3:]):.1f} m and {np.degrees(np.linalg.norm(off[:3])):.0f} degrees"
    return Rejected(RejectReason.FAR_FROM_PRIOR, f"{away} from the predicted pose, chi-square {chi2:.0f} > {bound:.0f}")


def prior_gate(candidate: LoopCandidate, config: Config) -> Gate:
    """Excludes poses that even a drift far beyond the noise of the odometry cannot explain."""
    return lambda T_target_source, *, slack_m: far_from_prior(
        T_target_source, candidate, config.graph, slack_m=config.proximity.base_radius_m + slack_m
    )

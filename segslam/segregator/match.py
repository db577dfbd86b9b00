"""Two descriptions in, the pose of one scan in the other out.

Yin et al., "Segregator", ICRA 2023, figure 2: correspondences, consistency graph, maximum clique, pose.
"""

import numpy as np

from segslam.config import SegregatorConfig
from segslam.segregator.clique import maximum_cliques
from segslam.segregator.consistency import ConsistencyGraph, consistency_graph
from segslam.segregator.correspondences import (
    Correspondences,
    cluster_correspondences,
    concatenate,
    feature_correspondences,
)
from segslam.segregator.solver import PoseFit, solve_pose
from segslam.types import Description, Indices, Information, Points, Registration, Rejected, RejectReason


def match(source: Description, target: Description, *, config: SegregatorConfig) -> Registration | Rejected:
    """The pose of the source in the target that most correspondences agree with, without an initial guess.

    Returns `Rejected` with TOO_FEW_CORRESPONDENCES, SMALL_CLIQUE or DEGENERATE where there is none to be had.
    """
    ranked = hypotheses(source, target, config=config)
    return ranked if isinstance(ranked, Rejected) else ranked[0]


def hypotheses(source: Description, target: Description, *, config: SegregatorConfig) -> list[Registration] | Rejected:
    """One pose for each maximum clique, the one with most inliers first, and of equals the one with least rms.

    `Rejected` as `match` returns it.
    """
    correspondences = putative(source, target, config=config)
    if len(correspondences) < config.min_clique:
        return Rejected(RejectReason.TOO_FEW_CORRESPONDENCES, f"{len(correspondences)} correspondences")
    graph = consistency_graph(correspondences, config=config)
    search = maximum_cliques(graph.adjacency, max_cliques=config.max_cliques, max_nodes=config.clique_max_nodes)
    if len(search.cliques[0]) < config.min_clique:
        return Rejected(RejectReason.SMALL_CLIQUE, f"{len(search.cliques[0])} correspondences agree")
    outcomes = [register(correspondences, graph, clique, config=config) for clique in search.cliques]
    registrations = [outcome for outcome in outcomes if isinstance(outcome, Registration)]
    if not registrations:
        return next(outcome for outcome in outcomes if isinstance(outcome, Rejected))
    return sorted(registrations, key=lambda registration: (-registration.num_inliers, registration.rms_m))


def putative(source: Description, target: Description, *, config: SegregatorConfig) -> Correspondences:
    """Correspondences of clusters, and of features where the configuration wants them and both scans hold any."""
    clusters = cluster_correspondences(source, target)
    if config.features == "never":
        return clusters
    features = feature_correspondences(
        source,
        target,
        similarity=config.tuple_similarity,
        trials_per_pair=config.tuple_trials_per_pair,
        seed=config.tuple_seed,
    )
    return concatenate(clusters, features)


def register(
    correspondences: Correspondences, graph: ConsistencyGraph, clique: Indices, *, config: SegregatorConfig
) -> Registration | Rejected:
    """The pose that the members of one clique agree on. Returns `Rejected(DEGENERATE)` where they fix none."""
    source, target = correspondences.source[clique], correspondences.target[clique]
    fit = solve_pose(source, target, config=config)
    if isinstance(fit, Rejected):
        return fit
    return Registration(
        T_target_source=fit.T_target_source,
        num_correspondences=len(correspondences),
        num_inliers=int(fit.inliers.sum()),
        rms_m=fit.rms_m,
        information=point_information(source[fit.inliers], sigma_m=_axis_sigma(fit, config)),
        num_edges=len(graph.edges),
    )


def point_information(source: Points, *, sigma_m: float) -> Information:
    """Inverse covariance of a pose fitted to matched points, each off by independent noise of `sigma_m` in each axis.

    For T exp(xi) the point a moves to R (a + phi x a + rho) + t, whose derivative is R [-[a]x, I]; R drops out.
    It claims no more than that noise model: what all points share, such as a bias of the labels, is not in it.
    """
    cross = np.cross(np.eye(3)[None, :, :], source[:, None, :])  # row k of each: e_k x a, so that -[a]x = its transpose
    jacobians = np.concatenate([np.swapaxes(cross, 1, 2), np.broadcast_to(np.eye(3), cross.shape)], axis=2)
    return np.einsum("nki,nkj->ij", jacobians, jacobians) / sigma_m**2


def _axis_sigma(fit: PoseFit, config: SegregatorConfig) -> float:
    """Noise of one coordinate of an inlier, from the residuals that the pose's six degrees of freedom left.

    Not below a third of the noise bound, which few inliers may fall under by luck.
    """
    num_inliers = int(fit.inliers.sum())
    freedom = max(3 * num_inliers - 6, 1)
    return max(fit.rms_m * (num_inliers / freedom) ** 0.5, config.noise_bound_m / 3)

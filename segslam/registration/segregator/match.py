"""Matching of two descriptions: the pose of one scan in the other.

Yin et al., "Segregator", ICRA 2023, figure 2: correspondences, consistency graph, maximum clique, pose.
Differs from the paper: while the pose is uncertain, all maximum cliques are tried, then wider bounds, as in the pyramid
of graphs of Qiao et al., "G3Reg: Pyramid Graph-Based Global Registration Using Gaussian Ellipsoid Model", T-ASE 2024,
then point features.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Direction, Indices, Points, Registration, Rejected, RejectReason, Transform
from segslam.registration import refinement
from segslam.registration.cliques import maximum_cliques
from segslam.registration.segregator.consistency_graph import consistency_graph
from segslam.registration.segregator.correspondences import Correspondences, feature_pairs
from segslam.registration.segregator.gaussians import align_gaussians
from segslam.registration.segregator.pose_solver import Scored, solve_level, solve_pose

CLIQUE_MAX_NODES = 200_000
"""Chosen: search nodes after which the search stops with the best clique found."""
CERTAIN_INLIERS = 12
"""Chosen on simulated 00 and 08: least number of inliers of a certain pose, after which no other is tried."""

MIN_GROUND_PATCHES = 5
"""Chosen: smallest number of ground patches that determine the vertical."""
TILT_RAD = math.radians(5.0)
"""Chosen: standard deviation of a sensor's tilt, without visible ground."""
PATCH_RAD = math.radians(13.0)
"""Chosen: scatter of a ground normal before any is seen, as in a corridor whose ground is seen by 16 beams."""
RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))
"""Median angle of directions that scatter by 1 in each of two directions."""


def match(source: Description, target: Description, *, config: SegregatorConfig) -> Registration | Rejected:
    """The pose of the source in the target with the most consistent correspondences, without an initial guess.

    Returns `Rejected` with TOO_FEW_CORRESPONDENCES, SMALL_CLIQUE, DEGENERATE or TOO_FEW_INLIERS if there is no pose.
    """
    ranked = hypotheses(source, target, config=config)
    return ranked if isinstance(ranked, Rejected) else ranked[0]


def hypotheses(source: Description, target: Description, *, config: SegregatorConfig) -> list[Registration] | Rejected:
    """Distinct poses, the one with the highest score first; none is searched after a certain one.

    `Rejected` as `match` returns it, for the narrowest bound.
    """
    found, rejections = [], []
    for attempt in _attempts(source, target, config):
        if isinstance(attempt, Rejected):
            rejections.append(attempt)
            continue
        found.append(attempt)
        if attempt[1].num_inliers >= CERTAIN_INLIERS:
            break
    if not found:
        return rejections[0]
    ranked = [registration for _, registration in sorted(found, key=lambda attempt: -attempt[0])]
    poses = [registration.T_target_source for registration in ranked]
    return [registration for k, registration in enumerate(ranked) if not refinement.is_near(poses[k], poses[:k])]


def _attempts(source: Description, target: Description, config: SegregatorConfig) -> Iterator[Scored | Rejected]:
    """Scores and poses of the maximum cliques: of clusters, then of clusters and features, for increasing bounds."""
    for correspondences in putative(source, target, config=config):
        number = len(correspondences.source)
        if number < config.min_clique:
            yield Rejected(RejectReason.TOO_FEW_CORRESPONDENCES, f"{number} correspondences")
            continue
        for bound_m in config.noise_bounds_m:
            adjacency = consistency_graph(correspondences, length_bound_m=2.0 * bound_m, config=config)
            cliques = maximum_cliques(adjacency, max_cliques=config.max_cliques, max_nodes=CLIQUE_MAX_NODES)
            size, num_edges = len(cliques[0]), int(np.bitwise_count(adjacency).sum()) // 2
            if size < config.min_clique:
                yield Rejected(RejectReason.SMALL_CLIQUE, f"{size} consistent correspondences")
                continue
            for clique in cliques:
                fit = _solve(source, target, correspondences, clique, bound_m, config)
                if isinstance(fit, Rejected):
                    yield fit
                    continue
                score, registration = fit
                yield score, replace(registration, num_correspondences=number, num_edges=num_edges)


def putative(source: Description, target: Description, *, config: SegregatorConfig) -> Iterator[Correspondences]:
    """Sets of correspondences to try: all pairs of clusters of one class; then also features, if both scans have any.

    With `features` set to `always`, the first set contains features.
    """
    clusters = np.argwhere(source.classes[:, None] == target.classes)
    if config.features != "always":
        yield Correspondences.of(source, target, clusters)
    if config.features == "always" or (
        config.features != "never" and len(source.feature_points) and len(target.feature_points)
    ):
        yield Correspondences.of(source, target, np.concatenate([clusters, feature_pairs(source, target)]))


def _solve(
    source: Description,
    target: Description,
    correspondences: Correspondences,
    clique: Indices,
    bound_m: float,
    config: SegregatorConfig,
) -> Scored | Rejected:
    """The pose from the correspondences of one clique, by `config.solver`.

    The initial pose of `gaussians` has the verticals aligned, if both are known.
    """
    members = correspondences.take(clique)
    source_up, target_up = upward(source), upward(target)
    if config.solver != "gaussians" or source_up is None or target_up is None:
        fit = solve_pose(members.source, members.target, bound_m=bound_m, config=config)
        if config.solver != "gaussians" or isinstance(fit, Rejected):
            return fit
        rough: Transform | Rejected = fit[1].T_target_source
    else:
        rough = solve_level(members.source, members.target, source_up, target_up, bound_m=bound_m)
    if isinstance(rough, Rejected):
        return rough
    return align_gaussians(correspondences, source, target, rough, config=config)


def upward(description: Description) -> Direction | None:
    """Upward unit vector from the normals of the ground; None if too little ground is visible, or it has no middle."""
    if len(description.ground_normals) < MIN_GROUND_PATCHES:
        return None
    middle = _middle(description.ground_normals)
    return middle if middle.any() else None


def vertical(description: Description) -> Direction:
    """Upward unit vector: the scan's z axis, corrected by the normals of the ground as far as ground is visible.

    Ground and z axis are weighted by their inverse variances: that of the ground follows from the scatter of its
    normals around their middle, that of the z axis is `TILT_RAD`.
    """
    normals = description.ground_normals
    if not len(normals):
        return np.array([0.0, 0.0, 1.0])
    middle = _middle(normals)
    scatter = np.median(np.linalg.norm(normals - middle, axis=1)) / RAYLEIGH_MEDIAN
    variance = (len(normals) * scatter**2 + PATCH_RAD**2) / len(normals) ** 2  # of the middle
    total = middle / variance + np.array([0.0, 0.0, 1.0 / TILT_RAD**2])
    return total / np.linalg.norm(total)


def _middle(normals: Points) -> Direction:
    """Unit vector of the medians of the components: patches of slopes and walls do not move it, as they do the mean.

    Zero if all medians are, as of four walls that are labelled as ground.
    """
    middle = np.median(normals.astype(np.float64), axis=0)
    return middle / (np.linalg.norm(middle) or 1.0)

"""Semantic clusters: labelled points -> Gaussians.

Yin, Yuan, Cao, Ji, Zhang, Xie, "Segregator: Global Point Cloud Registration with Semantic and Geometric Cues", ICRA
2023, section III. The segmentation is dynamic curved-voxel clustering (DCVC) of Zhou, Guo, Gan, Yang, "T-LOAM:
Truncated Least Squares LiDAR-Only Odometry and Mapping in Real Time", TGRS 2021: points fall in voxels of range, pitch
and azimuth around the sensor, and occupied voxels that touch (26 neighbours) form one cluster.

Differs from T-LOAM and from the Segregator authors' program: azimuth wraps, and clusters are connected components
proper. Theirs joins clusters only where a point without a cluster meets them, so how a row of cars splits depends on
the order of the points.
"""

import math

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.points import canonical_order, group_moments, within_range
from segslam.core.types import Covariances, Description, Indices, Label, Labels, Points, Vector

DCVC_START_RADIUS_M = 0.35
"""Authors: depth of the first radial bin of DCVC before it shrinks (m)."""
DCVC_RADIUS_STEP_M = 0.0004
"""Authors: shrinking of each radial bin, the first included (m)."""
DCVC_AZIMUTH_DEG = 1.2
"""Authors: azimuth bin of DCVC (degrees)."""
MIN_RANGE_M = 0.5
"""Authors: nearest point clustered (m)."""
MAX_RANGE_M = 120.0
"""Authors: farthest point clustered (m)."""

FIRST_RADIUS_M = 5.0
"""Start of the first radial bin, or the nearest point of the class if that is nearer (the authors' program) (m)."""


Gaussians = tuple[Points, Covariances, Labels, Indices]
"""The columns of clusters in a description."""


def semantic_clusters(points: Points, labels: Labels, *, config: SegregatorConfig) -> Description:
    """Description of the clusters alone, for each class in `config.cluster_min_points`.

    They are sorted by class, then by visible surface, largest first.
    The visible surface is proportional to the number of points times the squared range. The first
    `config.max_clusters_per_class` clusters of each class are kept.
    Centres are in the frame of `points`, whose origin is the sensor. Points that are NaN or out of range are ignored.
    The result does not depend on the order of the points.
    """
    chosen = np.flatnonzero(np.isin(labels, [int(label) for label in config.cluster_min_points]))
    chosen = chosen[within_range(points[chosen], MIN_RANGE_M, MAX_RANGE_M)]
    chosen = chosen[canonical_order(points[chosen])]
    points, labels = points[chosen].astype(np.float64), labels[chosen]
    parts = [
        _class_clusters(points[labels == label], label, min_points, config)
        for label, min_points in sorted(config.cluster_min_points.items())
    ]
    return Description(*map(np.concatenate, zip(*parts, strict=True)))


def curved_voxel_clusters(points: Points, *, pitch_deg: float) -> Indices:
    """(n,) the cluster of each point by DCVC, numbered from 0. The points are finite and none is at the origin.

    The first radial bin starts at the nearest point, `FIRST_RADIUS_M` away at most. The width of azimuth bins is the
    one nearest to `DCVC_AZIMUTH_DEG` that divides the circle.
    """
    if not len(points):
        return np.empty(0, np.int64)
    range_m, elevation, turn = geometry.spherical(points)
    bounds = [min(FIRST_RADIUS_M, range_m.min())]
    while bounds[-1] <= range_m.max():
        bounds.append(bounds[-1] + DCVC_START_RADIUS_M - len(bounds) * DCVC_RADIUS_STEP_M)
    radial = np.searchsorted(bounds[1:], range_m, side="right")
    pitch = _nearest_bin(elevation - min(0.0, elevation.min()), math.radians(pitch_deg))
    num_azimuth = round(360.0 / DCVC_AZIMUTH_DEG)
    azimuth = _nearest_bin(turn, math.tau / num_azimuth) % num_azimuth
    num_radial = int(radial.max()) + 2  # one more than occupied: neighbours of the outermost bin have keys of their own
    keys, voxel = np.unique((pitch * num_radial + radial) * num_azimuth + azimuth, return_inverse=True)
    return _components(keys, num_radial, num_azimuth)[voxel]


def _class_clusters(points: Points, label: Label, min_points: int, config: SegregatorConfig) -> Gaussians:
    cluster = curved_voxel_clusters(points, pitch_deg=config.dcvc_pitch_deg)
    sizes = np.bincount(cluster)
    large = sizes >= min_points
    renumbered = np.cumsum(large) - 1
    kept = large[cluster]
    means, covariances = group_moments(points[kept], renumbered[cluster[kept]], int(large.sum()))
    area = sizes[large] * (means**2).sum(axis=1)
    order = np.lexsort((*means.T, -area))[: config.max_clusters_per_class]
    return means[order], covariances[order], np.full(len(order), label, np.uint8), sizes[large][order]


def _nearest_bin(values: Vector, width: float) -> Indices:
    return np.floor(values / width + 0.5).astype(np.int64)


def _components(keys: Indices, num_radial: int, num_azimuth: int) -> Indices:
    """The connected component of each voxel, numbered from 0; azimuth wraps.

    Keys are distinct and ascending: (pitch * num_radial + radial) * num_azimuth + azimuth.
    """
    row, azimuth = np.divmod(keys, num_azimuth)
    pitch, radial, turn = np.indices((2, 3, 3)).reshape(3, -1, 1)
    beside = (row + pitch * num_radial + radial - 1) * num_azimuth + (azimuth + turn - 1) % num_azimuth
    at = np.minimum(np.searchsorted(keys, beside), len(keys) - 1)
    touching = keys[at] == beside
    ends = np.nonzero(touching)[1], at[touching]
    return connected_components(coo_array((np.ones(len(ends[0])), ends), (len(keys),) * 2), directed=False)[1]

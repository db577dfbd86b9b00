"""What the patches of two scans show at a pose: each falls into one bin, however many points it has.

A patch has the points of a cube of `PATCH_M` whose normals have the same largest component, seen from the other scan.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from segslam.core import geometry
from segslam.core.config import VerifyConfig
from segslam.core.points import cell_keys, within_range
from segslam.core.types import Mask, Points, Transform, Vector
from segslam.registration.free_space import MIN_MARGIN_M, NUM_COLUMNS, SHARE_OF_PATH, FreeSpace
from segslam.registration.refinement import STANDING_NORMAL_Z
from segslam.verification.gates import SAME_NORMAL, Observed
from segslam.verification.patches import PATCH_M

RESIDUALS = (0.5, 0.8, 1.2, 2.0)
"""Edges of the bins of a patch's root mean square residual, in units of the roughness."""
BINS = ("in free space", "no surface", *(f"{kind} {u}" for kind in ("facing", "turned") for u in range(5)))
"""A surface is near, and most normals are the same (facing) or not (turned), by residual."""
VIOLATING, KNOWN = 0.3, 1.0 / 3.0
"""Chosen: a patch violates free space if this share of its points does; it is judged if so many are in sight."""

Counts = Float[np.ndarray, "2 12"]
"""Number of patches in each bin: of standing surfaces, then of ground."""


class _Fates(NamedTuple):
    """What happens to points in the view of another scan; flags (n,) each."""

    violates: Mask
    matches: Mask
    is_hidden: Mask
    """Out of sight, and on no surface: nothing is known."""


def evidence(source: Observed, target: Observed, T_target_source: Transform, *, config: VerifyConfig) -> Counts:
    """Patches by what they show at this pose, in both directions of comparison."""
    sigma_m = max(source[0].roughness_m, target[0].roughness_m)
    forth = _seen_from(target, source, T_target_source, sigma_m, config)
    return forth + _seen_from(source, target, geometry.inverse(T_target_source), sigma_m, config)


def _seen_from(b: Observed, a: Observed, T_b_a: Transform, sigma_m: float, config: VerifyConfig) -> Counts:
    """The patches of a in the view of b."""
    surface, other = a[0], b[0]
    moved = geometry.apply(T_b_a, surface.points)
    near = within_range(moved, 0.0, config.max_range_m)
    points, normals = moved[near], surface.normals[near] @ T_b_a[:3, :3].T
    if not len(points):
        return np.zeros((2, len(BINS)))
    stands = np.abs(surface.normals[near, 2]) < STANDING_NORMAL_Z
    rows, apart_m = other.nearest(points)
    residual = np.einsum("ij,ij->i", points - other.points[rows], other.normals[rows]) / sigma_m
    is_same = np.abs(np.einsum("ij,ij->i", normals, other.normals[rows])) > SAME_NORMAL
    fates = _fates(points, b[1], apart_m < config.inlier_m, config)
    keys, _ = cell_keys(points, PATCH_M)
    _, patch = np.unique(3 * keys + np.abs(normals).argmax(axis=1), return_inverse=True)

    def share(flags: Vector, of: Vector) -> Vector:
        return np.bincount(patch, flags * of) / np.maximum(np.bincount(patch, of), 1e-9)

    everything, in_sight, matching = np.ones(len(points)), ~fates.is_hidden * 1.0, fates.matches * 1.0
    level = np.digitize(np.sqrt(share(residual**2, matching)), RESIDUALS)
    level += np.where(share(is_same, matching) > 0.5, 2, 2 + len(RESIDUALS) + 1)
    shown = np.where(share(matching, in_sight) > KNOWN, level, 1)
    shown[share(fates.violates, everything) > VIOLATING] = 0
    shown += np.where(share(stands, everything) > 0.5, 0, len(BINS))
    known = share(in_sight, everything) >= KNOWN
    return np.bincount(shown[known], minlength=2 * len(BINS)).reshape(2, -1).astype(np.float64)


def _fates(points: Points, seen: FreeSpace, is_near: Mask, config: VerifyConfig) -> _Fates:
    """Points in the frame of the scan that sees: in front of its returns, on its surface, or behind."""
    range_m, elevation, azimuth = geometry.spherical(points.astype(np.float32))
    row = np.floor((elevation - seen.lowest_rad) / seen.row_rad).astype(np.int64)
    column = np.floor((azimuth + math.pi) / math.tau * NUM_COLUMNS).astype(np.int64) % NUM_COLUMNS
    inside = (row >= 0) & (row < len(seen.nearest_m))
    return_m = np.where(inside, seen.nearest_m[np.where(inside, row, 0), column], np.inf)
    margin_m = min(max(SHARE_OF_PATH * seen.free_path_m, MIN_MARGIN_M), config.free_space_margin_m)
    has_return = np.isfinite(return_m)
    margins_m = margin_m + config.free_space_margin_ratio * range_m
    violates = has_return & (range_m + margins_m < return_m)
    return _Fates(violates, is_near, ~is_near & ~violates & (~has_return | (range_m > return_m + margins_m)))

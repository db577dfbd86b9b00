"""What the patches of two scans show at a pose: on a surface of the other scan, on none, in free space, or hidden.

A patch has the standing points of a scan in a cube of `PATCH_M` whose normals have the same largest component. The
residuals of its points have a cause in common, so it counts once, however many points it has. Ground does not count,
because it fits the ground of any street.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int8

from segslam.core import geometry
from segslam.core.points import cell_keys, within_range
from segslam.core.types import Indices, Points, Transform, Vector
from segslam.registration.free_space import AT_RETURN, BEHIND, IN_FRONT, NO_RETURN, fates, violation
from segslam.registration.prepared import Observed
from segslam.registration.refinement import Surface

INLIER_M = 0.5
"""Chosen: refine.voxel_m: distance to the other scan within which a point overlaps it (m)."""
MAX_RANGE_M = 50.0
"""Chosen on simulated 00 and 08: points farther from the other sensor are out of its reach (m)."""

NUM_SCANS = 16
"""Number of scans whose patches are in memory, about 0.4 MB each."""
PATCH_M = 1.5
"""Edge of the cube of a patch."""
RESIDUALS = (0.6, 1.0, 1.6)
"""Edges of the bins of a patch's root mean square distance to the surface, in units of the roughness."""
FAR_M = 10.0
"""Patches farther from the other sensor than this have bins of their own."""
VIOLATING, KNOWN = 0.3, 1.0 / 3.0
"""Shares of the points of a patch: in free space, and known, for a patch that is there or that is judged at all."""
FREE_SPACE, NO_SURFACE, HIDDEN, RESIDUAL = range(4)
KINDS = ("free space", "no surface", "hidden", *(f"residual {level}" for level in range(len(RESIDUALS) + 1)))
"""What a patch shows: it is where the other scan saw through, within its view but on none of its surfaces, behind what
it saw, or on a surface."""
BINS = tuple(f"{where}, {kind}" for where in ("near", "far") for kind in KINDS)

Counts = Float[np.ndarray, "14"]
"""Number of patches in each of `BINS`."""
Shown = Int8[np.ndarray, "_"]
"""Bin of each patch of a scan, -1 for patches outside the view of the other."""


class Patches(NamedTuple):
    """The standing points of a scan in its frame, and the patch of each."""

    points: Points
    patch: Indices
    size: Vector
    """Number of points of each patch."""


class Agreement(NamedTuple):
    """What two scans show at a pose; of overlap, residual and violation the worse of both directions of comparison."""

    overlap: float
    """Share of the standing points within reach of the other scan that lie within `INLIER_M` of it."""
    rms_m: float
    """Root mean square distance of these points to the planes of the other surface (m); infinite if there are none."""
    free_space_violation: float
    """Share of the points that violate the free space of the other scan, of those in directions with a return."""
    of_source: Shown
    of_target: Shown
    """Empty if only the patches of the source were looked at."""

    @property
    def counts(self) -> Counts:
        """Of both scans."""
        return counted(self.of_source) + counted(self.of_target)


@lru_cache(NUM_SCANS)
def patches_of(surface: Surface) -> Patches:
    """The patches of a scan."""
    points, normals = surface.standing()
    keys, _ = cell_keys(points, PATCH_M)
    _, patch = np.unique(3 * keys + np.abs(normals).argmax(axis=1), return_inverse=True)
    return Patches(points, patch, np.bincount(patch).astype(np.float64))


def agreement(source: Observed, target: Observed, T_target_source: Transform) -> Agreement:
    """Agreement of two scans at this pose of the source in the target."""
    ways = [
        (*_seen_from(b, a, T_b_a), violation(a.surface.points, b.free_space, T_b_a))
        for a, b, T_b_a in ((source, target, T_target_source), (target, source, geometry.inverse(T_target_source)))
    ]
    overlaps, residuals_m, shown, violations = zip(*ways, strict=True)
    return Agreement(min(overlaps), max(residuals_m), max(violations), *shown)


def counts_at(source: Observed, target: Observed, T_target_source: Transform) -> Counts:
    """The patches of both scans at this pose, in each bin, as `agreement` finds them."""
    of_source = _seen_from(target, source, T_target_source)[2]
    return counted(of_source) + counted(_seen_from(source, target, geometry.inverse(T_target_source))[2])


def first_look(source: Observed, target: Observed, T_target_source: Transform) -> Shown:
    """The patches of the source alone, in half of the time: a first look at a pose that may still be refined."""
    return _seen_from(target, source, T_target_source)[2]


def counted(shown: Shown) -> Counts:
    """Number of patches in each bin."""
    return np.bincount(shown[shown >= 0], minlength=len(BINS)).astype(np.float64)


def _seen_from(b: Observed, a: Observed, T_b_a: Transform) -> tuple[float, float, Shown]:
    """Overlap, residual (m) and patches of a's standing points in the view of b."""
    standing = patches_of(a.surface)
    moved = geometry.apply(T_b_a, standing.points)
    within = within_range(moved, 0.0, MAX_RANGE_M)
    points = moved[within]
    if not len(points):
        return 0.0, math.inf, np.full(len(standing.size), -1, np.int8)
    apart_m, to_plane_m = b.surface.distances_m(points)
    is_near = apart_m < INLIER_M
    rms_m = float(np.sqrt(np.mean(to_plane_m[is_near] ** 2))) if is_near.any() else math.inf
    fate = fates(points, b.free_space)
    known, near, squared, violating, hidden, unseen, range_m = (
        np.bincount(standing.patch[within], weights, minlength=len(standing.size))
        for weights in (
            is_near | (fate == IN_FRONT) | (fate == AT_RETURN),
            is_near,
            is_near * (to_plane_m / max(a.surface.roughness_m, b.surface.roughness_m)) ** 2,
            fate == IN_FRONT,
            ~is_near & (fate == BEHIND),
            ~is_near & (fate == NO_RETURN),
            np.linalg.norm(points, axis=1),
        )
    )
    level = np.digitize(np.sqrt(squared / np.maximum(near, 1.0)), RESIDUALS)
    shown = np.where(near > KNOWN * known, RESIDUAL + level, NO_SURFACE)
    shown[violating > VIOLATING * standing.size] = FREE_SPACE
    shown[known < KNOWN * standing.size] = HIDDEN
    shown += len(KINDS) * (range_m >= FAR_M * standing.size)
    shown[(known < KNOWN * standing.size) & ((hidden < unseen) | (hidden + unseen == 0.0))] = -1
    return float(np.mean(is_near)), rms_m, shown.astype(np.int8)

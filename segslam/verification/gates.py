"""Gates for a refined pose: overlap of the surfaces, residual, and free space.

At the correct pose, the points above ground ("standing") of one scan lie on the surfaces of the other, and no scan has
points where the other observed free space. Ground points do not count, because they fit the ground of any street.

The residual at a correct pose depends on the sensor and the place. It is therefore divided by the roughness of the
surfaces, and its limit is relative to neighbouring keyframes of the run, whose poses are known (`NoiseFloor`).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import VerifyConfig
from segslam.core.points import within_range
from segslam.core.types import Direction, Mask, Points, Rejected, RejectReason, Transform, Vector
from segslam.registration.free_space import violation
from segslam.registration.prepared import Observed
from segslam.registration.refinement import Surface
from segslam.verification.patches import PATCH_M, common_residual_m


@dataclass(frozen=True, slots=True)
class Agreement:
    """Overlap, residual and free-space violation of two aligned scans; the worse of both directions of comparison."""

    overlap: float
    """Share of the standing points within reach of the other scan that lie within `inlier_m` of it."""
    rms_m: float
    """Root mean square distance of these points to the planes of the other surface (m)."""
    residual_ratio: float
    """`rms_m` divided by the larger roughness of the two surfaces."""
    free_space_violation: float
    """Share of the points that violate the free space of the other scan, of those in directions with a return."""
    free_path_m: float
    """Median range of the returns: how narrow the place is; the smaller one of the two scans (m)."""
    common_residual_m: float = 0.0
    """Part of the residual that the points of a patch have in common (`patches.common_residual_m`)."""

    @property
    def mismatch(self) -> float:
        """As the function `mismatch`."""
        return mismatch(self.overlap, self.residual_ratio)


@dataclass(frozen=True, slots=True)
class NoiseFloor:
    """Agreement of scans with a known relative pose: neighbours along a drive."""

    overlap: float
    residual_ratio: float
    free_space_violation: float


SINGLE_PAIR = NoiseFloor(overlap=0.93, residual_ratio=0.78, free_space_violation=0.002)
"""For pairs that come from no run. Medians of real scans up to 3 m apart: KITTI 00 0.93, 0.70, 0.002; the courtyard
0.93, 0.78, 0.002; NCLT in submaps of 11 scans, which share most of them, 0.91, 0.47, 0.005."""
LEAST_RESIDUAL_RATIO = 0.62
"""Chosen: neighbours that share points have smaller ratios than any other scans."""
CERTAIN_RESIDUAL, CERTAIN_VIOLATION, LEAST_VIOLATION = 1.25, 3.0, 0.005
"""Chosen: up to these multiples of the floor, a pose fits as well as neighbours do. Of the 11 real pairs of
KITTI 00, 0.5 to 35 m apart, 95 % have less."""
CONTRADICTED = 3.0
"""Chosen on simulated parking lots of equal cars, seeds 0, 2 and 4: a pose that violates free space more than so many
times as much as a free pose may is contradicted by a free one. The limit is then 0.015 to 0.018; 370 correct poses have
up to 0.007, 34 wrong ones that fit almost as well as a correct one 0.022 to 0.052."""
RESIDUAL_OF_NEIGHBOURS, VIOLATION_OF_NEIGHBOURS = 0.85, 0.5
"""Chosen on simulated corridors, seed 1: limits of scans in narrow places that overlap as neighbours do, relative to
those of others, unless a second surface confirms the pose."""
NARROW_M, OPEN_M = 4.0, 6.0
"""Chosen: free paths of narrow places, where the limits above hold, and of open ones, where they do not. Simulated
corridors have 1.7 to 4.5 m, the courtyard, NCLT, KITTI and simulated streets 4.7 to 14.4 m. In a street parked cars
come and go: half of the correct poses on another day violate free space by more than such a limit."""
COMMON_RESIDUAL_M = 0.07
"""Chosen on simulated corridors, seed 2: largest common residual in narrow places. In wider ones the limit grows with
the free path, as the effect of errors of the angles does."""
FREE_RESIDUAL, NO_VIOLATION = 1.2, 0.001
"""Chosen on simulated scenes, seed 0: factor of the largest residual in open places if free space is violated no more
than between neighbours, or by this share. None of 651 wrong poses with such residuals violated it so little, and all of
8 correct ones."""
NARROW_VIEW = 0.5
"""Chosen: a scan with returns in less than this share of the azimuths sees one side of a place only."""
DOUBTFUL, DOUBTFUL_NARROW = 1.3, 2.0
"""Chosen on simulated corridors and tunnels, even seeds: factors of the least second support for a pose that fits less
well than neighbours do, and for such a pose of a scan with a narrow view."""
COARSE_VIOLATION = 3.0
"""Chosen: a coarse pose may violate free space this much more than a refined one."""
BADLY_OBSERVED, VIOLATION_BADLY_OBSERVED = 0.05, 0.5
"""Chosen on simulated garages, seed 2: below this ratio of variances a pose may violate free space by this share of the
limit."""
WEAKLY_OBSERVED = 0.02
"""Chosen on simulated tunnels, even seeds: a ratio of variances below which more than one surface must match along the
weak direction. Of the wrong poses that fit as well as neighbours do it is 0.011 to 0.013; corridors have 0.023 or more.
"""
FACING, SAME_NORMAL, MIN_FACING = 0.5, 0.8, 10
"""Chosen: a surface faces a direction within 60 degrees; two surfaces are the same within 37 degrees; fewer facing
points than `MIN_FACING` prove nothing."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that a pose must satisfy."""

    min_overlap: float
    max_residual_ratio: float
    max_free_space_violation: float
    max_common_residual_m: float
    """In narrow places; in proportion to the free path in wider ones."""
    violation_of_neighbours: float
    """In open places the residual of a pose that violates free space as little may be `FREE_RESIDUAL` times larger."""
    overlap_of_neighbours: float
    """In narrow places, scans that overlap as much as neighbours do see the same things from nearly the same place, and
    must fit nearly as well: up to half of this overlap the limits hold as they are, from there they fall linearly."""

    def at(self, overlap: float, free_path_m: float) -> tuple[float, float]:
        """Largest residual ratio and free-space violation of scans with this overlap in a place with this free path."""
        share = min(max(2.0 * overlap / self.overlap_of_neighbours - 1.0, 0.0), 1.0)
        share *= min(max((OPEN_M - free_path_m) / (OPEN_M - NARROW_M), 0.0), 1.0)
        return (
            (1.0 - share * (1.0 - RESIDUAL_OF_NEIGHBOURS)) * self.max_residual_ratio,
            (1.0 - share * (1.0 - VIOLATION_OF_NEIGHBOURS)) * self.max_free_space_violation,
        )

    @property
    def most_mismatch(self) -> float:
        """Mismatch of a pose at the limits of overlap and residual; no pose that passes has more."""
        return mismatch(self.min_overlap, FREE_RESIDUAL * self.max_residual_ratio)

    def unreduced(self) -> "Limits":
        """The limits at any overlap, for poses that a second surface confirms."""
        return replace(self, overlap_of_neighbours=math.inf)

    def loosened(self) -> "Limits":
        """Limits for rivals, which need not fit as well as an accepted pose to make it ambiguous."""
        return replace(
            self,
            min_overlap=0.75 * self.min_overlap,
            max_residual_ratio=1.3 * self.max_residual_ratio,
            max_free_space_violation=1.5 * self.max_free_space_violation,
            max_common_residual_m=1.3 * self.max_common_residual_m,
        )


def limits(floor: NoiseFloor, *, config: VerifyConfig) -> Limits:
    """Limits for scans with this noise floor: the settings at the default floor; less overlap and more violation if the
    neighbours of the run have less and more."""
    return Limits(
        min_overlap=config.min_overlap * min(floor.overlap / SINGLE_PAIR.overlap, 1.0),
        max_residual_ratio=config.max_residual_ratio * max(floor.residual_ratio, LEAST_RESIDUAL_RATIO),
        max_common_residual_m=COMMON_RESIDUAL_M,
        violation_of_neighbours=max(floor.free_space_violation, NO_VIOLATION),
        overlap_of_neighbours=floor.overlap,
        max_free_space_violation=max(
            config.max_free_space_violation, config.max_violation_ratio * floor.free_space_violation
        ),
    )


def agreement(source: Observed, target: Observed, T_target_source: Transform, *, config: VerifyConfig) -> Agreement:
    """Agreement of two scans at this pose of the source in the target."""
    ways = [
        (*_surface_agreement(a[0].standing, b[0], T_b_a, config), violation(a[0].points, b[1], T_b_a, config=config))
        for a, b, T_b_a in (
            (source, target, T_target_source),
            (target, source, geometry.inverse(T_target_source)),
        )
    ]
    overlaps, residuals, common, violations = zip(*ways, strict=True)
    roughness_m = max(source[0].roughness_m, target[0].roughness_m)
    free_path_m = min(source[1].free_path_m, target[1].free_path_m)
    ratio = max(residuals) / roughness_m
    return Agreement(min(overlaps), max(residuals), ratio, max(violations), free_path_m, max(common))


def mismatch(overlap: float, residual_ratio: float) -> float:
    """Mean squared residual of the standing points in units of twice the roughness, truncated at 1 (no match)."""
    return 1.0 - overlap + overlap * min(residual_ratio / 2.0, 1.0) ** 2


def mismatch_of_some(
    standing: Points, target: Surface, T_target_source: Transform, *, roughness_m: float, config: VerifyConfig
) -> float:
    """Mismatch of some standing points of the source. With all of them and both directions it is hardly smaller."""
    overlap, _, _, to_plane_m = _paired(standing, target, T_target_source, config)
    return mismatch(overlap, _rms_m(to_plane_m) / roughness_m)


class Support(NamedTuple):
    """Shares of the points facing a direction that match a surface of the other scan."""

    whole: float
    """Of all facing points."""
    second: float
    """Of the points outside the surface that most of them match. A single surface, such as the end of a corridor,
    exists at many places; two surfaces at the same distance from each other are rare."""


def weak_support(
    source: Surface, target: Surface, T_target_source: Transform, direction: Direction, *, config: VerifyConfig
) -> Support:
    """Evidence for the position along a direction; the smaller shares of both directions of comparison.

    `direction`: unit vector in the source's frame in which the scans constrain the pose least. Only surfaces facing it
    determine the pose there, as the recesses of doors do along a corridor, whose walls match at any shift. A surface
    matches within `inlier_m` if the normals are the same, a second one if it also fits within twice the roughness.
    Shares are 0 where too few points face the direction to decide, as in a smooth tunnel.
    """
    fit_m = 2.0 * max(source.roughness_m, target.roughness_m)
    there = T_target_source[:3, :3] @ direction
    forth = _support(source, target, T_target_source, direction, fit_m, config)
    back = _support(target, source, geometry.inverse(T_target_source), there, fit_m, config)
    return Support(min(forth.whole, back.whole), min(forth.second, back.second))


def _support(
    a: Surface, b: Surface, T_b_a: Transform, towards: Direction, fit_m: float, config: VerifyConfig
) -> Support:
    """Support of one scan by the other; `towards` in the frame of the first."""
    normals = a.normals
    facing = np.abs(normals @ towards) > FACING
    moved = geometry.apply(T_b_a, a.points[facing])
    near = within_range(moved, 0.0, config.max_range_m)
    if near.sum() < MIN_FACING:
        return Support(0.0, 0.0)
    rows, to_point = b.nearest(moved[near])
    turned = normals[facing][near] @ T_b_a[:3, :3].T
    same = np.abs(np.einsum("ij,ij->i", turned, b.normals[rows])) > SAME_NORMAL
    matches = (to_point < config.inlier_m) & same
    to_plane = np.abs(np.einsum("ij,ij->i", moved[near] - b.points[rows], b.normals[rows]))
    fits = matches & (to_plane < fit_m)
    along_m = a.points[facing][near] @ towards
    beside = ~_within_fullest(along_m, fits, 2.0 * config.inlier_m)
    return Support(float(np.mean(matches)), float(np.mean(fits[beside])) if beside.any() else 0.0)


def _within_fullest(along_m: Vector, counted: Mask, width_m: float) -> Mask:
    """(n,) the points within the interval of this width that has most of the counted points."""
    if not counted.any():
        return np.zeros(len(along_m), bool)
    starts_m = np.sort(along_m[counted])
    sizes = np.searchsorted(starts_m, starts_m + width_m, side="right") - np.arange(len(starts_m))
    start_m = starts_m[sizes.argmax()]
    return (along_m >= start_m) & (along_m <= start_m + width_m)


def is_certain(found: Agreement, floor: NoiseFloor) -> bool:
    """True if a pose fits as well as neighbours do, so that no other pose can fit better."""
    return found.residual_ratio <= CERTAIN_RESIDUAL * floor.residual_ratio and is_free(found, floor)


def is_free(found: Agreement, floor: NoiseFloor) -> bool:
    """True if a pose violates free space as little as neighbours do."""
    return found.free_space_violation <= _free(floor)


def contradicts(found: Agreement, other: Agreement, floor: NoiseFloor) -> bool:
    """True if a pose violates free space as little as neighbours do, and the other pose much more.

    Of two poses that fit almost as well, as in rows of equal cars, the scans then disprove the other: it puts objects
    where free places were seen.
    """
    return is_free(found, floor) and other.free_space_violation > CONTRADICTED * _free(floor)


def _free(floor: NoiseFloor) -> float:
    """Largest free-space violation of a pose that violates it as little as neighbours do."""
    return max(CERTAIN_VIOLATION * floor.free_space_violation, LEAST_VIOLATION)


def early_rejection(
    source: Observed,
    target: Observed,
    T_target_source: Transform,
    allowed: Limits,
    *,
    config: VerifyConfig,
    factor: float = COARSE_VIOLATION,
) -> Rejected | None:
    """Rejects a pose that violates free space `factor` times as much as allowed; refinement rarely corrects that.

    Takes 1 ms.
    """
    forth = violation(source[0].points, target[1], T_target_source, config=config, is_coarse=True)
    back = violation(target[0].points, source[1], geometry.inverse(T_target_source), config=config, is_coarse=True)
    most = factor * allowed.max_free_space_violation
    if max(forth, back) > most:
        return Rejected(RejectReason.FREE_SPACE_VIOLATED, f"{max(forth, back):.4f} > {most:.4f} before refinement")
    return None


def rejection(found: Agreement, allowed: Limits) -> Rejected | None:
    """The first gate that a pose fails, in the order of the pipeline; None if it passes all."""
    if found.overlap < allowed.min_overlap:
        return Rejected(RejectReason.LOW_OVERLAP, f"{found.overlap:.3f} < {allowed.min_overlap:.3f}")
    max_residual_ratio, max_violation = allowed.at(found.overlap, found.free_path_m)
    if found.free_path_m >= OPEN_M and found.free_space_violation <= allowed.violation_of_neighbours:
        max_residual_ratio *= FREE_RESIDUAL
    if found.residual_ratio > max_residual_ratio:
        detail = f"{found.rms_m:.3f} m, {found.residual_ratio:.2f} > {max_residual_ratio:.2f} times the roughness"
        return Rejected(RejectReason.HIGH_RESIDUAL, detail)
    most_m = allowed.max_common_residual_m * max(found.free_path_m / NARROW_M, 1.0)
    if found.common_residual_m > most_m:
        detail = f"{found.common_residual_m:.3f} m > {most_m:.3f} m in common over patches of {PATCH_M} m"
        return Rejected(RejectReason.HIGH_RESIDUAL, detail)
    if found.free_space_violation > max_violation:
        detail = f"{found.free_space_violation:.4f} > {max_violation:.4f}"
        return Rejected(RejectReason.FREE_SPACE_VIOLATED, detail)
    return None


def _surface_agreement(
    standing: Points, b: Surface, T_b_a: Transform, config: VerifyConfig
) -> tuple[float, float, float]:
    """Overlap, residual and common residual of a's standing points."""
    overlap, points, normals, to_plane_m = _paired(standing, b, T_b_a, config)
    return overlap, _rms_m(to_plane_m), common_residual_m(points, normals, to_plane_m)


def _paired(
    standing: Points, b: Surface, T_b_a: Transform, config: VerifyConfig
) -> tuple[float, Points, Points, Vector]:
    """Overlap of a's standing points within reach of b's sensor (0 where none is), and the points near b's surface.

    Of these the positions in b's frame, the normals of the surface, and the signed distances along them (m).
    """
    moved = geometry.apply(T_b_a, standing)
    moved = moved[within_range(moved, 0.0, config.max_range_m)]
    rows, to_point_m = b.nearest(moved)
    is_near = to_point_m < config.inlier_m
    points, rows = moved[is_near], rows[is_near]
    normals = b.normals[rows]
    to_plane_m = np.einsum("ij,ij->i", points - b.points[rows], normals)
    return len(points) / max(len(moved), 1), points, normals, to_plane_m


def _rms_m(distances_m: Vector) -> float:
    """Root mean square; infinite for no distances."""
    return float(np.sqrt(np.mean(distances_m**2))) if len(distances_m) else math.inf

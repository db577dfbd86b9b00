"""A finished drive on the globe: placed in the local frame of its fixes, and bent by them where they are better."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from segslam.core.trajectory import Poses
from segslam.core.types import Points, Transform, Vector
from segslam.gnss.alignment import place
from segslam.gnss.fixes import OUTSIDE, Fixes
from segslam.gnss.fusion import calibrate, fuse
from segslam.gnss.geodesy import Origin
from segslam.gnss.matching import Drive, prepare
from segslam.gnss.statistics import KEPT_WEIGHT, Weights, robust_weights
from segslam.graph import Edge
from segslam.graph.position_fixes import PositionedGraph

CONTRADICTED = "contradicts_drive"
"""Reason for which a fix is not kept: the drive and other fixes contradict it."""


class Use(StrEnum):
    """What the fixes may change."""

    ALIGN = "align"
    """The map is placed as it is."""
    FUSE = "fuse"
    """It is bent, too, if held-out fixes confirm that."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """A drive in the local frame (east, north, up) at its first usable fix."""

    fixes: Fixes
    origin: Origin
    T_enu_map: Transform
    """Rigid placement of the map in the local frame."""
    T_enu_keyframe: Poses
    """(k, 4, 4) poses of the keyframes; with bent axes not `T_enu_map` times those of the map."""
    heading_sigma_deg: float
    position_sigma_m: Vector
    """(3,) standard deviations of the placement: east, north, up (that of the mean of correlated heights)."""
    fix_sigma_m: Vector
    """(3,) standard deviations of single fixes about the drive; infinite for heights that are unknown."""
    arm_m: Vector
    """(3,) position of the antenna in the LiDAR frame; zeros where it is not significant."""
    arm_sigma_m: Vector
    """(2,) standard deviations of its first two components."""
    measured_offset_s: float
    """Seconds added to the times of the fixes beyond those asked for; 0 if not significant."""
    offset_sigma_s: float
    is_bent: tuple[bool, bool]
    """Horizontally, and in height."""
    reasons: tuple[str, ...]
    """(n,) why a fix was not kept; empty for kept ones."""
    measured_enu_m: Points
    """(n, 3) positions of the fixes; NaN where unknown."""
    residual_m: Points
    """(n, 3) measured less estimated positions of the antenna; NaN for fixes outside the drive."""
    weights: Weights
    """(n, 2) robust weights, horizontally and in height; 0 for fixes outside the drive."""

    @property
    def num_kept(self) -> int:
        """Number of fixes without a reason against them."""
        return self.reasons.count("")


def georeference(
    edges: Sequence[Edge], drive: Drive, fixes: Fixes, *, use: Use = Use.FUSE, offset_s: float = 0.0
) -> Georeference:
    """Place a drive in the frame of its fixes, and bend it if `use` allows that and held-out fixes confirm it.

    `edges`: the graph whose optimum are the poses of the drive's keyframes, with the information that they have there.
    `offset_s` is added to the times of the fixes. Raises SegslamError with the reason if the fixes do not determine a
    placement, Unsolvable if the graph cannot be solved.
    """
    prepared = prepare(fixes, drive, offset_s=offset_s)
    placement = place(prepared, offset_s=offset_s)
    graph = PositionedGraph(edges, drive.T_map_keyframe)
    placement, measured_offset_s, level = calibrate(graph, prepared, placement, offset_s=offset_s)
    matched, T_enu_keyframe = placement.matched, placement.T_enu_keyframe
    sigma_m, is_bent = placement.sigma_m, (False, False)
    weights = robust_weights(placement.residual(T_enu_keyframe), sigma_m, matched.time_s)
    if use is Use.FUSE:
        T_enu_keyframe, weights, sigma_m, is_bent = fuse(graph, placement, level)
    residual = np.full((len(fixes), 3), np.nan)
    residual[matched.rows] = placement.residual(T_enu_keyframe)
    all_weights = np.zeros((len(fixes), 2))
    all_weights[matched.rows] = weights
    against = np.full(len(fixes), OUTSIDE, object)
    against[matched.rows] = np.where(weights[:, 0] >= KEPT_WEIGHT, "", CONTRADICTED)
    num_up = np.sum(np.isfinite(residual[matched.rows, 2]) & (weights[:, 1] >= KEPT_WEIGHT))
    up_sigma_m = placement.sigma_m[2] / np.sqrt(max(num_up / placement.correlated, 1.0)) if num_up else np.inf
    return Georeference(
        fixes=fixes,
        origin=prepared.origin,
        T_enu_map=placement.T_enu_map,
        T_enu_keyframe=T_enu_keyframe,
        heading_sigma_deg=float(np.degrees(level.constant_sigma[2])),
        position_sigma_m=np.array([*level.constant_sigma[3:5], up_sigma_m]),
        fix_sigma_m=sigma_m,
        arm_m=placement.arm_m,
        arm_sigma_m=level.constant_sigma[7:9],
        measured_offset_s=measured_offset_s,
        offset_sigma_s=float(level.constant_sigma[6]),
        is_bent=is_bent,
        reasons=tuple(reason or other for reason, other in zip(fixes.reasons, against.tolist(), strict=True)),
        measured_enu_m=prepared.enu_m,
        residual_m=residual,
        weights=all_weights,
    )

"""Largest difference between a loop and the relative pose that the graph predicts, from the drift of odometry.

Odometry drifts with the distance travelled, so each bound is a base plus a part that grows with the shortest chain
between the two keyframes: horizontal distance, height, and rotation.
"""

import math

import numpy as np

from segslam.core import geometry
from segslam.core.types import LoopCandidate, Rejected, RejectReason, Rotation, Transform, Vector

PRIOR_GATE = 1.5
"""Chosen: largest horizontal distance from the prior, in search radii."""

BASE_HEIGHT_M = 1.0
"""Chosen: storeys are 3 m apart: largest height difference of two visits without drift (m)."""
HEIGHT_RATIO = 0.008
"""Chosen: ramps of 100 to 150 m: increase of that height difference per metre travelled between the two keyframes."""
BASE_TURN_DEG = 15.0
"""Chosen: largest rotation between a loop and its prior without drift (degrees)."""
TURN_RATIO_DEG = 0.02
"""Chosen: increase of that rotation per metre travelled between the two keyframes (degrees)."""


def height_bounds_m(chain_m: Vector) -> Vector:
    """Largest height errors of keyframes relative to another, from the length of the chain to each (m)."""
    return BASE_HEIGHT_M + HEIGHT_RATIO * chain_m


def turn_bound_rad(chain_m: float) -> float:
    """Largest rotation error of one keyframe relative to another, from the chain between them; at most pi."""
    return min(math.radians(BASE_TURN_DEG + TURN_RATIO_DEG * chain_m), math.pi)


def far_from_prior(
    T_target_source: Transform, candidate: LoopCandidate, R_world_target: Rotation, *, slack_m: float
) -> Rejected | None:
    """Rejects with FAR_FROM_PRIOR a pose that the drift of odometry cannot explain; None if it can.

    The world's z axis points up. `slack_m` is added to the bounds of distance and height, for a pose that refinement
    may still move.
    """
    prior = candidate.T_target_source_prior
    apart = R_world_target @ (T_target_source[:3, 3] - prior[:3, 3])
    (height_m,) = height_bounds_m(np.array([candidate.chain_m]))
    bounds = {
        "distance": (math.hypot(*apart[:2]), PRIOR_GATE * candidate.search_radius_m + slack_m, "m"),
        "height": (abs(float(apart[2])), float(height_m) + slack_m, "m"),
        "rotation": (
            math.degrees(geometry.angle(geometry.inverse(prior) @ T_target_source)),
            math.degrees(turn_bound_rad(candidate.chain_m)),
            "degrees",
        ),
    }
    for name, (found, allowed, unit) in bounds.items():
        if found > allowed:
            return Rejected(RejectReason.FAR_FROM_PRIOR, f"{name} {found:.1f} {unit} > {allowed:.1f} {unit}")
    return None

"""Placement of a finished trajectory in the frame of its fixes.

The start has four degrees of freedom, heading and position, over the whole drive: a fix measures no heading, and a
single error must not decide. The refinement adds a small tilt.
"""

from dataclasses import dataclass

import numpy as np

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Points, SegslamError, Transform, Vector
from segslam.gnss.matching import Matched, Prepared
from segslam.gnss.statistics import Weights, correlated, fix_noise, longest_chain, robust_weights, sigmas
from segslam.graph.closure_pairs import adjoints
from segslam.graph.edges import BREAK_DEG

NUM_GUESSES = 400
"""Chosen: pairs of fixes that propose a heading; half of the fixes may be wrong, and 100 good pairs are left."""
LEAST_FIXES = 4
"""Three parameters of the plane, and one fix more."""
LEAST_SPAN_M = 1.0
"""Chosen: fixes within this show no heading."""
ROUNDS = 12
"""Chosen: iterations of the refinement; it settles in about six."""
PRIOR_TILT_DEG, PRIOR_OFFSET_S, PRIOR_ARM_M = 2.0, 1.0, 1.0
"""Chosen: standard deviations, before the fixes, of the tilt of the map, the offset of the clocks, and each component
of the lever arm."""
PRIOR = np.array([*2 * [np.radians(PRIOR_TILT_DEG)], 1.0, 1e4, 1e4, 1e4, PRIOR_OFFSET_S, PRIOR_ARM_M, PRIOR_ARM_M])
"""The same of all constants of `linearised`; those of heading and position are so large that the fixes alone determine
both, also if all fixes are kilometres from the first keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Pose of the map in the local frame, by matched fixes of a receiver."""

    matched: Matched
    T_enu_map: Transform
    arm_m: Vector
    """(3,) position of the antenna in the LiDAR frame (m); 0 where it is not significant."""
    weights: Weights
    """(n, 2) robust weights, horizontally and in height; 0 outside the largest chain that is consistent with the drive.
    """
    sigma_m: Vector
    """(3,) standard deviation of single fixes about the placed drive: east, north, up."""
    correlated: float
    """How many fixes in a row count as one."""
    heading_sigma_deg: float

    @property
    def T_enu_keyframe(self) -> Poses:  # noqa: N802  (a transform)
        """(k, 4, 4) poses of the keyframes of the placed drive."""
        return self.T_enu_map @ self.matched.drive.T_map_keyframe

    def residual(self, T_enu_keyframe: Poses) -> Points:
        """(n, 3) measured less estimated positions of the antenna, for these poses of the keyframes (k, 4, 4)."""
        T_enu_lidar = T_enu_keyframe[self.matched.keyframe] @ self.matched.T_keyframe_lidar
        return self.matched.enu_m - antennas(T_enu_lidar, self.arm_m)


def place(prepared: Prepared, *, offset_s: float = 0.0) -> Placement:
    """Place the drive in the frame of its fixes, `offset_s` added to their times.

    Raises SegslamError with the reason if the fixes do not determine a placement.
    """
    matched = prepared.matched(offset_s)
    source, span_m = prepared.fixes.source, float(np.hypot(*np.ptp(matched.enu_m[:, :2], axis=0)))
    if len(matched) < LEAST_FIXES:
        raise SegslamError(
            f"{source}: {len(matched)} usable fixes are within the drive; at least {LEAST_FIXES} are needed to place "
            "the map, spread over the drive"
        )
    if span_m < LEAST_SPAN_M:
        raise SegslamError(
            f"{source}: all fixes are within {span_m:.2f} m, so they show no heading; use fixes of a longer part of "
            "the drive"
        )
    placement = refined(matched, _start(matched, source), np.zeros(3))
    if placement.heading_sigma_deg > BREAK_DEG:
        raise SegslamError(
            f"{source}: the fixes determine the heading of the map to {placement.heading_sigma_deg:.1f} degrees only "
            f"({span_m:.0f} m of drive, errors of {placement.sigma_m[0]:.1f} m): a map is placed if it is known to "
            f"{BREAK_DEG:.0f}; use fixes of a longer part of the drive"
        )
    return placement


def _start(matched: Matched, source: str) -> Transform:
    """Heading and position by the pairs of fixes whose heading suits most fixes (least sum of square roots)."""
    estimated, measured = matched.T_map_lidar[:, :3, 3], matched.enu_m
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, len(matched), (20 * NUM_GUESSES, 2))
    vectors = [(points[pairs[:, 1]] - points[pairs[:, 0]])[:, :2] for points in (estimated, measured)]
    lengths = [np.hypot(*vector.T) for vector in vectors]
    far = np.argsort(-np.minimum(*lengths), kind="stable")
    chosen = far[: len(far) // 2]  # of the longer half, those of about equal length
    chosen = chosen[np.argsort(np.abs(np.log(np.maximum(lengths[0], 1e-6) / np.maximum(lengths[1], 1e-6)))[chosen])]
    if lengths[0][chosen[0]] < LEAST_SPAN_M:
        raise SegslamError(
            f"{source}: the sensor moved by less than {LEAST_SPAN_M:g} m between the fixes, so they "
            "show no heading; use fixes of a longer part of the drive"
        )
    best = (np.inf, 0.0, np.zeros(2))
    for row in chosen[:NUM_GUESSES]:
        (x, y), (east, north) = vectors[0][row], vectors[1][row]
        heading = np.arctan2(north, east) - np.arctan2(y, x)
        difference = measured[:, :2] - estimated[:, :2] @ geometry.yaw(heading)[:2, :2].T
        shift = np.median(difference, axis=0)
        cost = float(np.sum(np.sqrt(np.hypot(*(difference - shift).T))))
        if cost < best[0]:
            best = cost, float(heading), shift
    rotation = geometry.yaw(best[1])
    up = measured[:, 2] - estimated[:, 2]
    known = np.isfinite(up)
    return geometry.transform(rotation, [*best[2], float(np.median(up[known])) if known.any() else 0.0])


def refined(matched: Matched, start: Transform, arm_m: Vector) -> Placement:
    """The placement near `start` by iteratively reweighted least squares on the largest chain of consistent fixes.

    `arm_m` (3,): position of the antenna in the LiDAR frame.
    """
    T_enu_map = start
    for _ in range(ROUNDS):
        residual, columns = linearised(matched, T_enu_map, arm_m)
        chain = longest_chain(residual, matched.travel_m, sigma_m=fix_noise(residual))
        sigma = sigmas(residual, chain, chain & np.isfinite(residual[:, 2]))
        many = correlated(residual[chain][:, :2])
        weights = robust_weights(residual, sigma) * chain[:, None]
        precision = weights.take([0, 0, 1], axis=1) / sigma**2 / many
        prior, six = PRIOR[:6] ** -2.0, columns[:, :, :6]
        tilt = np.array([-T_enu_map[1, 2], T_enu_map[0, 2], 0.0, 0.0, 0.0, 0.0])  # heading, position: no prior value
        system = np.einsum("nij,ni,nik->jk", six, precision, six) + np.diag(prior)
        right = np.einsum("nij,ni,ni->j", six, precision, np.nan_to_num(residual)) - prior * tilt
        covariance = np.linalg.inv(system)
        T_enu_map = moved(T_enu_map, covariance @ right)
    residual, _ = linearised(matched, T_enu_map, arm_m)
    weights = robust_weights(residual, sigma, matched.time_s) * chain[:, None]
    heading_deg = float(np.degrees(np.sqrt(covariance[2, 2])))
    return Placement(matched, T_enu_map, arm_m, weights, sigma, many, heading_deg)


def linearised(matched: Matched, T_enu_map: Transform, arm_m: Vector) -> tuple[Points, np.ndarray]:
    """(n, 3) residuals, and (n, 3, 9) derivatives of the positions by the constants.

    The constants are a rotation about the first keyframe (rad) and a shift (m) of the map in the local frame, seconds
    added to the times of the fixes, and the first two components of the lever arm (m).
    """
    T_enu_lidar = T_enu_map @ matched.T_map_lidar
    estimated = antennas(T_enu_lidar, arm_m)
    T_antenna_map = geometry.transforms(np.eye(3), T_enu_map[:3, 3] - estimated)  # with the axes of the local frame
    velocity = matched.velocity @ T_enu_map[:3, :3].T
    columns = np.dstack([adjoints(T_antenna_map)[:, 3:], velocity, T_enu_lidar[:, :3, :2]])
    columns[~np.isfinite(matched.enu_m)] = 0.0
    return matched.enu_m - estimated, columns


def antennas(T_a_lidar: Poses, arm_m: Vector) -> Points:
    """(n, 3) positions of the antenna in frame a, for poses (n, 4, 4) and the lever arm (3,) (LiDAR, m)."""
    return T_a_lidar[:, :3, :3] @ arm_m + T_a_lidar[:, :3, 3]


def moved(T_enu_map: Transform, step: Vector) -> Transform:
    """The placement after a rotation about the origin of the map (rad), and a shift (m): the six values of `step`."""
    turn = geometry.exp(geometry.tangent(rotation_rad=step[:3], translation_m=0.0))
    rotation = geometry.nearest_rotation(turn[:3, :3] @ T_enu_map[:3, :3])
    return geometry.transform(rotation, T_enu_map[:3, 3] + step[3:6])

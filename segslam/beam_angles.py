"""What is left over of a spinning LiDAR's angles, from scans of one drive that lie some metres apart.

Beams that all point lower than believed turn each plane into a cone around the sensor. An encoder that runs out of
centre (or an axis that leans) bends straight walls: what lies ahead appears too far to one side, what lies behind too
far to the other, in the sensor's own sense of rotation. Two scans from different places bend one surface differently,
and no rigid motion lays the one on the other: the two angles are a seventh and an eighth unknown of their
registration. On real scans of KITTI 00 that registration finds the 0.205 degrees which KITTI's readers add.

An odometry that takes cones for planes turns up or down with every metre, and one that takes bent walls for straight
ones turns sideways. How much it did is the turn by which it differs from a registration that knows better.
"""

import math
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from segslam import geometry
from segslam.types import AngleSamples, Mask, Points, Transform, Vector

APART_M = 20.0
"""Travel between the two scans of a pair. Chosen: far enough for the angles to show, and scans still overlap."""
EVERY_M = 10.0
"""A pair begins. Chosen: the angles of simulated drives are followed better than every 20 m, at twice the cost."""
MOST_PAIRS = 1000
"""Chosen: those of 10 km; on longer drives they lie farther apart."""
MOST_TURN_RAD = math.radians(45.0)
"""Chosen: scans that turned more share little of what lies ahead and behind."""
MOST_POINTS = 4000  # chosen: of the source; all others would find the same
REACH_M = (1.0, 0.8, 0.6, *[0.5] * 17)
"""Search distance of each step, at most. Chosen: odometry is off by less than the first."""
SETTLED = 1e-3
"""A step smaller than this (rad, m) is the last. Chosen: what the angles of one pair can be known to."""
RESIDUAL_M = 0.05
"""Where a point has lost three quarters of its weight. Chosen: above the noise of ranges, below what has moved."""
LEVEL_NORMAL_Z, STANDING_NORMAL_Z = 0.95, 0.15
"""Chosen: what is neither level nor upright is mostly foliage, which looks another from each side and shows an angle of
0.02 degrees that is none."""
LEAST_PAIRED = 500  # chosen: fewer points are no scan of a street
OFFSET_RAD = math.radians(0.035)
"""By so much `register` finds the vertical angle too large for the odometry's pitch. Measured on simulated 00 to 09:
0.02 degrees beyond the simulated angle, and without any KISS-ICP turns up as by 0.02 degrees."""


@runtime_checkable
class Surface(Protocol):
    """A scan to register, in its own frame."""

    @property
    def points(self) -> Points:
        """(n, 3) m."""
        ...

    @property
    def normals(self) -> Points:
        """(n, 3) unit vectors."""
        ...

    def nearest(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: row of the point of the scan that is nearest to each of some points, and how far it is (m)."""


def sample_angles(
    surface_of: Callable[[int], Surface], T_odom_keyframes: Float[np.ndarray, "n 4 4"], travel_m: Vector
) -> AngleSamples:
    """The leftover angles, and how much too far down and left the odometry turned, at places along a drive.

    Row i of the arrays is keyframe i; `surface_of` gives its scan. Pairs of scans that tell nothing are left out.
    """
    surface_of = lru_cache(6)(surface_of)  # a pair begins where the last but one ended
    rows, angles, excesses = [], [], []
    for target, source in _pairs(T_odom_keyframes, travel_m):
        T_prior = geometry.inverse(T_odom_keyframes[target]) @ T_odom_keyframes[source]
        found = register(surface_of(source), surface_of(target), T_prior)
        if found is not None:
            T_target_source, angle_rad = found
            excess_rad = geometry.log(geometry.inverse(T_target_source) @ T_prior)[1:3]
            rows.append((travel_m[source] + travel_m[target]) / 2)
            angles.append(angle_rad - [OFFSET_RAD, 0.0])
            excesses.append(excess_rad / (travel_m[source] - travel_m[target]))
    return AngleSamples(np.array(rows), np.reshape(angles, (-1, 2)), np.reshape(excesses, (-1, 2)))


def register(
    source: Surface, target: Surface, T_target_source: Transform
) -> tuple[Transform, Float[np.ndarray, "2"]] | None:
    """The pose of the source near a first guess, and two angles (rad) of both scans: by which their points lie too low,
    and by which what is ahead lies too far left, as what is behind lies too far right.

    Minimises distances from points to planes under Geman and McClure's kernel; None where too few points meet.
    """
    if min(len(source.points), len(target.points)) < LEAST_PAIRED:
        return None
    points = source.points[_is_clear(source.normals)]
    points = points[:: math.ceil(max(len(points), 1) / MOST_POINTS)]
    target_is_clear = _is_clear(target.normals)
    angle_rad = np.zeros(2)
    for reach_m in REACH_M:
        nearest, distance_m = target.nearest(geometry.apply(T_target_source, points))
        paired = (distance_m < reach_m) & target_is_clear[nearest]
        if paired.sum() < LEAST_PAIRED:
            return None
        rows = nearest[paired]
        step = _step(points[paired], target.points[rows], target.normals[rows], T_target_source, angle_rad)
        T_target_source = T_target_source @ geometry.exp(step[:6])
        angle_rad = angle_rad + step[6:]
        if np.linalg.norm(step) < SETTLED:
            break
    return T_target_source, angle_rad


def raising(points: Points) -> Points:
    """(n, 3) m per radian: how each point moves as its beam is raised. It keeps its range and azimuth."""
    flat = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    x, y, z = points.T
    return np.column_stack([-z * x / flat, -z * y / flat, flat])


def swinging(points: Points) -> Points:
    """(n, 3) m per radian: how each point moves as what is ahead swings right, and what is behind left."""
    x, y, _ = points.T
    ahead = x / np.maximum(np.hypot(x, y), 1e-9)
    return np.column_stack([ahead * y, -ahead * x, np.zeros_like(x)])


def corrected(points: Points, angle_rad: Float[np.ndarray, "2"]) -> Points:
    """(n, 3) points that lie too low and, ahead, too far left by these angles, put right."""
    return points + np.tensordot(angle_rad, _corrections(points), axes=1)


def _corrections(points: Points) -> Float[np.ndarray, "2 n 3"]:
    """m per radian of either angle."""
    return np.stack([raising(points), swinging(points)])


def _is_clear(normals: Points) -> Mask:
    """(n,) whether each surface is level or upright, as the ground and walls are."""
    upward = np.abs(normals[:, 2])
    return (upward > LEVEL_NORMAL_Z) | (upward < STANDING_NORMAL_Z)


def _step(
    source: Points, target: Points, normals: Points, T_target_source: Transform, angle_rad: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "8"]:
    """One Gauss-Newton step of matched points: a tangent of the pose, and changes of the angles."""
    by_angle_source, by_angle_target = _corrections(source), _corrections(target)
    right = source + np.tensordot(angle_rad, by_angle_source, axes=1)
    moved = geometry.apply(T_target_source, right)
    residual_m = np.einsum("ij,ij->i", normals, moved - target - np.tensordot(angle_rad, by_angle_target, axes=1))
    normals_source = normals @ T_target_source[:3, :3]
    by_angle = np.einsum("ij,kij->ik", normals_source, by_angle_source) - np.einsum(
        "ij,kij->ik", normals, by_angle_target
    )
    jacobian = np.hstack([np.cross(right, normals_source), normals_source, by_angle])
    weight = (1.0 + (residual_m / RESIDUAL_M) ** 2) ** -2
    weighted = jacobian * weight[:, None]
    return -np.linalg.lstsq(weighted.T @ jacobian, weighted.T @ residual_m)[0]


def _pairs(T_odom_keyframes: np.ndarray, travel_m: Vector) -> Iterator[tuple[int, int]]:
    """(older, newer) keyframes `APART_M` of travel apart, evenly along the drive, without a sharp turn between."""
    starts_m = np.arange(0.0, travel_m[-1] - APART_M, max(EVERY_M, float(travel_m[-1]) / MOST_PAIRS))
    targets, sources = np.searchsorted(travel_m, [starts_m, starts_m + APART_M])
    for target, source in zip(targets.tolist(), sources.tolist(), strict=True):
        T_target_source = geometry.inverse(T_odom_keyframes[target]) @ T_odom_keyframes[source]
        if geometry.angle(T_target_source) < MOST_TURN_RAD:
            yield target, source

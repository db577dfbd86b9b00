"""SE(3) as 4x4 matrices.

Tangents are [rotation rad; translation m]; `exp` and `log` are those of SE(3), not of SO(3) x R^3.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core.types import Direction, Information, Points, Rotation, Tangent, Transform, Vector

Triple = float | Sequence[float] | np.ndarray
"""Three numbers, or one for all three."""
Moments = Float[np.ndarray, "4 4"]
"""Means of the products of the homogeneous coordinates of points."""


def transform(rotation: Rotation, translation: Triple) -> Transform:
    """The 4x4 matrix of a rotation and a translation (m)."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation
    T_a_b[:3, 3] = translation
    return T_a_b


def transforms(rotations: np.ndarray, translations: Points) -> Float[np.ndarray, "_ 4 4"]:
    """The 4x4 matrices of rotations (n, 3, 3), or of one for all, and translations (n, 3) (m)."""
    T_a_b = np.tile(np.eye(4), (len(translations), 1, 1))
    T_a_b[:, :3, :3] = rotations
    T_a_b[:, :3, 3] = translations
    return T_a_b


def apply(T_a_b: Transform, points_b: Points) -> Points:
    """Points (n, 3) of frame b in frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def inverse(T_a_b: Transform) -> Transform:
    """T_b_a."""
    R_b_a = T_a_b[:3, :3].T
    return transform(R_b_a, -R_b_a @ T_a_b[:3, 3])


def unit_rows(vectors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Each vector at unit length; one that is shorter than 1e-9 stays shorter than 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def yaw(angle_rad: float) -> Rotation:
    """A rotation about z, counter-clockwise seen from above."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def level(up: Direction) -> Rotation:
    """The smallest rotation that maps the unit vector `up` to +z; about x if `up` is -z."""
    axis = np.array([up[1], -up[0], 0.0])  # up x z
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    return ScipyRotation.from_rotvec(axis * math.atan2(sine, up[2])).as_matrix()


def tangent(*, rotation_rad: Triple, translation_m: Triple) -> Tangent:
    """A tangent from its two halves; a scalar applies to all three axes. Also used for standard deviations."""
    return np.concatenate([np.broadcast_to(np.asarray(half, dtype=float), 3) for half in (rotation_rad, translation_m)])


def exp(xi: Tangent) -> Transform:
    """The rigid transform of a tangent; inverse of `log`."""
    phi, rho = xi[:3], xi[3:]
    theta = float(np.linalg.norm(phi))
    cross = _cross(phi)
    # 1 - cos(theta) as a square: exact for small angles
    a, b = (1.0, 0.5) if theta < 1e-8 else (math.sin(theta) / theta, 2.0 * (math.sin(theta / 2.0) / theta) ** 2)
    return transform(np.eye(3) + a * cross + b * cross @ cross, _left_jacobian(phi) @ rho)


def log(T_a_b: Transform) -> Tangent:
    """The tangent of a rigid transform, rotation within [0, pi]; inverse of `exp`."""
    phi = ScipyRotation.from_matrix(T_a_b[:3, :3]).as_rotvec()
    return np.concatenate([phi, np.linalg.solve(_left_jacobian(phi), T_a_b[:3, 3])])


def scaled(T_a_b: Transform, factor: float) -> Transform:
    """The motion with the same twist over `factor` times the time; exactly `T_a_b` for a factor of 1."""
    return T_a_b if factor == 1.0 else exp(factor * log(T_a_b))


def angle(T_a_b: Transform) -> float:
    """Angle of the rotation (rad), 0 to pi, from its sine and cosine: exact near 0 and near pi."""
    (a, b, c), (d, e, f), (g, h, i) = T_a_b[:3, :3].tolist()
    return math.atan2(math.hypot(h - f, c - g, d - b), a + e + i - 1.0)


def distance(T_a_b: Transform) -> float:
    """Length of the translation (m)."""
    return float(np.linalg.norm(T_a_b[:3, 3]))


def interpolate(T_w_a: Transform, T_w_b: Transform, fraction: float) -> Transform:
    """The pose that lies `fraction` of the way along the screw motion from a (0) to b (1)."""
    return T_w_a @ exp(fraction * log(inverse(T_w_a) @ T_w_b))


def with_covariance(information: Information, noise: Information) -> Information:
    """The information of a tangent after adding independent noise of this covariance.

    Inverse(inverse(I) + S), computed so that I may be singular: unknown directions stay unknown.
    """
    total = np.linalg.solve(np.eye(6) + information @ noise, information)
    return (total + total.T) / 2


def nearest_rotation(matrix: Rotation) -> Rotation:
    """The rotation nearest to a matrix in the Frobenius norm; undoes rounding in files."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def nearest_transform(matrix: np.ndarray) -> Transform:
    """The rigid transform nearest to a (3, 4) or (4, 4) matrix; undoes rounding in files and in long products."""
    return transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])


def _left_jacobian(phi: np.ndarray) -> Rotation:
    theta = float(np.linalg.norm(phi))
    cross = _cross(phi)
    if theta < 1e-4:  # series: the closed form loses precision here; the next terms are below 1e-13
        return np.eye(3) + cross / 2.0 + cross @ cross / 6.0
    a = 2.0 * (math.sin(theta / 2.0) / theta) ** 2  # 1 - cos(theta) as a square, as in `exp`
    b = (theta - math.sin(theta)) / theta**3
    return np.eye(3) + a * cross + b * cross @ cross


def _cross(phi: np.ndarray) -> np.ndarray:
    """The matrix of the cross product with a vector."""
    x, y, z = phi.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def spherical(points: Points) -> tuple[Vector, Vector, Vector]:
    """Range (m), elevation and azimuth (rad) of each point, of the dtype of `points`."""
    x, y, z = points.T
    level = np.hypot(x, y)
    return np.hypot(level, z), np.arctan2(z, level), np.arctan2(y, x)


def raise_beams(points: Points, angle_deg: float) -> Points:
    """The points at the same range and azimuth, their elevation raised by `angle_deg`; of the same dtype.

    A positive angle corrects a sensor that measures points too low. Zero returns the points themselves.
    """
    if angle_deg == 0.0:
        return points
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    x, y, z = np.ascontiguousarray(points.T)
    horizontal = np.sqrt(x * x + y * y)
    # A point straight above has no azimuth to keep; squares below `tiny` lose their digits.
    np.maximum(horizontal, np.sqrt(np.finfo(x.dtype).tiny), out=horizontal)
    stretch = cosine - sine * z / horizontal
    return np.stack([x * stretch, y * stretch, sine * horizontal + cosine * z], axis=1)


def raising(points: Points) -> Points:
    """(n, 3) m per radian: the derivative of `raise_beams` at zero, for each point."""
    horizontal = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    x, y, z = points.T
    return np.column_stack([-z * x / horizontal, -z * y / horizontal, horizontal])


def chance_beyond(reach_m: float, covariance: Information) -> float:
    """Probability that a pose with this covariance is off by more than `reach_m` in its least known direction."""
    largest = max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 1e-12)
    return math.erfc(reach_m / math.sqrt(2.0 * largest))


def moments_of(points: Points) -> Moments:
    """The moments of points (n, 3), for `displacement_m`."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    return homogeneous.T @ homogeneous / len(points)


def displacement_m(moments: Moments, T_a_points: Transform, T_a_other: Transform) -> float:
    """Root mean square distance (m) between points at two poses: one figure for translation and rotation.

    `moments` of the points in their own frame.
    """
    apart = (T_a_points - T_a_other)[:3]
    return math.sqrt(max(float(np.vdot(apart @ moments, apart)), 0.0))

"""SE(3) as 4x4 matrices.

Tangents are [rotation rad; translation m]; `exp` and `log` are those of SE(3), not of SO(3) x R^3.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.types import Information, Points, Rotation, Tangent, Transform

Triple = float | Sequence[float] | np.ndarray
"""Three numbers, or one for all three."""


def transform(rotation: Rotation, translation: Triple) -> Transform:
    """The 4x4 matrix of a rotation and a translation (m)."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation
    T_a_b[:3, 3] = translation
    return T_a_b


def apply(T_a_b: Transform, points_b: Points) -> Points:
    """Points of b, in a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def inverse(T_a_b: Transform) -> Transform:
    """T_b_a."""
    R_b_a = T_a_b[:3, :3].T
    return transform(R_b_a, -R_b_a @ T_a_b[:3, 3])


def yaw(angle_rad: float) -> Rotation:
    """A turn about z, counter-clockwise seen from above."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def tangent(*, rotation_rad: Triple, translation_m: Triple) -> Tangent:
    """A tangent from its named halves; scalars spread over the three axes. Also serves for standard deviations."""
    return np.concatenate([np.broadcast_to(np.asarray(half, dtype=float), 3) for half in (rotation_rad, translation_m)])


def exp(xi: Tangent) -> Transform:
    """The rigid transform of a tangent; inverse of `log`."""
    phi, rho = xi[:3], xi[3:]
    return transform(ScipyRotation.from_rotvec(phi).as_matrix(), _left_jacobian(phi) @ rho)


def log(T_a_b: Transform) -> Tangent:
    """The tangent of a rigid transform, rotation within [0, pi]; inverse of `exp`."""
    phi = ScipyRotation.from_matrix(T_a_b[:3, :3]).as_rotvec()
    return np.concatenate([phi, np.linalg.solve(_left_jacobian(phi), T_a_b[:3, 3])])


def angle(T_a_b: Transform) -> float:
    """Size of the rotation, in radians, 0 to pi: arccos((tr R - 1) / 2), computed without loss near 0."""
    return float(ScipyRotation.from_matrix(T_a_b[:3, :3]).magnitude())


def distance(T_a_b: Transform) -> float:
    """Size of the translation, in metres."""
    return float(np.linalg.norm(T_a_b[:3, 3]))


def interpolate(T_w_a: Transform, T_w_b: Transform, fraction: float) -> Transform:
    """The pose that lies `fraction` of the way along the screw motion from a (0) to b (1)."""
    return T_w_a @ exp(fraction * log(inverse(T_w_a) @ T_w_b))


def with_noise(information: Information, *, rotation_rad: Triple, translation_m: Triple) -> Information:
    """The information of a tangent that is also off by independent noise of these standard deviations.

    Inverse(inverse(I) + S), written so that I may be singular: what was unknown stays so.
    """
    noise = np.diag(tangent(rotation_rad=rotation_rad, translation_m=translation_m) ** 2)
    total = np.linalg.solve(np.eye(6) + information @ noise, information)
    return (total + total.T) / 2


def nearest_rotation(matrix: Rotation) -> Rotation:
    """The rotation nearest to a matrix in the Frobenius norm; undoes rounding in files."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _left_jacobian(phi: np.ndarray) -> Rotation:
    theta = float(np.linalg.norm(phi))
    x, y, z = phi
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if theta < 1e-4:  # series: the closed form loses digits here, the next term is below 1e-17
        return np.eye(3) + cross / 2.0 + cross @ cross / 6.0
    a = (1.0 - math.cos(theta)) / theta**2
    b = (theta - math.sin(theta)) / theta**3
    return np.eye(3) + a * cross + b * cross @ cross

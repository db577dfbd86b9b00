"""Duration of a sweep, measured on scans whose points carry no times.

A spinning LiDAR measures the points of a sweep one after the other while it moves. Without times they are not moved to
one time, and the scan stays distorted: in a bend by metres at large distances. Scans from two places then distort one
surface differently, and no rigid motion aligns them: the duration of the sweep is a seventh unknown of their
registration. It is measured for each azimuth at which a sweep may begin, and the one that explains most is kept.

With the duration at zero, points are paired too well, and a part of it shows. It is the one with which none is left.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.stats import t as student

from segslam.candidates.proximity import BREAK_TRAVEL_M
from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.trajectory import Poses
from segslam.core.types import Transform, Vector
from segslam.odometry.calibration import MIN_PAIRS, MOST_PAIRS, PointsOf
from segslam.odometry.checked import SIGNIFICANT
from segslam.registration.refinement import LightSurface, downsample
from segslam.slam.adjustment.alignment import align, pairs_of
from segslam.slam.adjustment.correction import Correction, Sweep, Velocities, swept
from segslam.slam.adjustment.submaps import STEPS

FROM_DEG = np.arange(0.0, 360.0, 45.0)
"""Chosen: azimuths at which a sweep may begin, with an eighth of the points on the wrong side at most."""


class _Shown(NamedTuple):
    """What pairs of scans show beyond a sweep by which they are corrected, for each azimuth of `FROM_DEG`."""

    seconds: Vector
    sigma_s: Vector
    gain: Vector
    """By how much it raises the log-likelihood of the pairs."""
    num_pairs: int


def measure_sweep(
    points_of: PointsOf, T_world: Poses, travel_m: Vector, velocities: Velocities, *, config: RefineConfig
) -> Sweep | None:
    """The sweep by pairs of keyframes of a drive; None if too few show one, or not significantly.

    `travel_m` (n,): length of the path.
    """
    pairs = _pairs(travel_m, velocities)

    @cache
    def shown(seconds: float, from_deg: float) -> _Shown | None:
        sweep = Sweep(seconds, 0.0, from_deg)
        found = []
        for target, source in pairs:
            surfaces = [
                LightSurface(
                    downsample(Correction(0.0, sweep, velocities.per_second[one])(points_of(one)), config=config)
                )
                for one in (target, source)
            ]
            T_prior = geometry.inverse(T_world[target]) @ T_world[source]
            normal = _normal_equations(surfaces[1], surfaces[0], T_prior, velocities.per_second[[target, source]])
            found += [] if normal is None else [normal]
        return _solved(np.array(found)) if len(found) >= MIN_PAIRS else None

    first = shown(0.0, 0.0)
    if first is None:
        return None
    best = int(np.argmax(first.gain))
    seconds, from_deg = float(first.seconds[best]), float(FROM_DEG[best])
    chance = len(FROM_DEG) * 2.0 * student.sf(abs(seconds) / first.sigma_s[best], first.num_pairs - 1)
    if not chance < SIGNIFICANT:  # nor if it is unknown
        return None

    def left(duration_s: float) -> float:
        found = shown(duration_s, from_deg if duration_s else 0.0)
        return 0.0 if found is None else float(found.seconds[best])

    longest_s = float(np.copysign(velocities.interval_s, seconds))
    if left(longest_s) * seconds >= 0.0:
        return None  # no sweep takes longer than the time between scans
    duration_s = float(brentq(left, 0.0, longest_s, xtol=float(first.sigma_s[best])))
    last = shown(duration_s, from_deg)
    if last is None:
        return None
    share = (seconds - left(duration_s)) / duration_s
    return Sweep(duration_s + left(duration_s) / share, float(last.sigma_s[best]) / share, from_deg)


def _pairs(travel_m: Vector, velocities: Velocities) -> list[tuple[int, int]]:
    """(older, newer) keyframes in which the sensor turned fastest, each in one pair, so that pairs are independent."""
    older = np.arange(max(len(travel_m) - STEPS[0], 0))
    older = older[travel_m[older + STEPS[0]] - travel_m[older] < BREAK_TRAVEL_M]
    turning = np.linalg.norm(velocities.per_second[:, :3], axis=1)
    chosen: list[tuple[int, int]] = []
    used = set[int]()
    for first in older[np.argsort(-(turning[older] + turning[older + STEPS[0]]))].tolist():
        if len(chosen) < MOST_PAIRS and not used & {first, first + STEPS[0]}:
            used |= {first, first + STEPS[0]}
            chosen.append((first, first + STEPS[0]))
    return chosen


def _normal_equations(
    source: LightSurface, target: LightSurface, T_prior: Transform, velocities: Float[np.ndarray, "2 6"]
) -> Float[np.ndarray, "2 m"] | None:
    """Gradient and curvature of the log-likelihood by the duration, for each azimuth, at the best pose for each.

    `velocities` of target and source. None if they cannot be aligned.
    """
    aligned = align(source, target, T_prior)
    if aligned is None:
        return None
    pairs = pairs_of(source, target, aligned.T_target_source)
    pose = np.column_stack([np.cross(pairs.source, pairs.normals_source), pairs.normals_source])
    by_duration = np.column_stack(
        [
            np.einsum("ij,ij->i", pairs.normals_source, swept(pairs.source, velocities[1], from_deg))
            - np.einsum("ij,ij->i", pairs.normals, swept(pairs.target, velocities[0], from_deg))
            for from_deg in FROM_DEG
        ]
    )
    weighted = pose.T * pairs.weights
    coupling = weighted @ by_duration
    poses = np.linalg.lstsq(weighted @ pose, np.column_stack([weighted @ pairs.residual_m, coupling]))[0]
    gradient = by_duration.T @ (pairs.weights * pairs.residual_m) - coupling.T @ poses[:, 0]
    curvature = pairs.weights @ by_duration**2 - np.einsum("ij,ij->j", coupling, poses[:, 1:])
    variance = float(pairs.weights @ pairs.residual_m**2 / pairs.weights.sum())
    return np.array([-gradient, curvature]) / variance


def _solved(found: Float[np.ndarray, "k 2 m"]) -> _Shown | None:
    """The durations by all pairs, and their standard deviations by how much the pairs differ; None without motion."""
    gradient, curvature = found[:, 0], found[:, 1]
    total = curvature.sum(axis=0)
    if not (total > 0.0).all():
        return None
    seconds = gradient.sum(axis=0) / total
    sigma_s = np.sqrt(np.sum((gradient - seconds * curvature) ** 2, axis=0)) / total
    return _Shown(seconds, sigma_s, seconds**2 * total / 2.0, len(found))

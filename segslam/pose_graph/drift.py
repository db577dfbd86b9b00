"""Systematic drift: a vertical angle left over in the scans bends every drive up or down, and loops hardly see it.

A drive that pitches evenly with every metre lies on a sphere instead of a plane, and there every loop closes as it does
on the plane: what a constant pitch adds to the transform around a closed loop is the integral of d(|p|^2) / 2 in height
and of the direction of travel in tilt, both zero. What closures tell of the bend is of second order, below the noise
of any but exact ones, and the twist that fits them best is noise. The scans tell (`vertical_angle`). Whether to believe
them:

- the angle is estimated along the drive, as a constant and a slow change (an Ornstein-Uhlenbeck process);
- it predicts how much too far the odometry turned, which was measured apart for each pair of scans;
- stretches of the drive are held out in turn, and predicted from the others. Prediction and measurement must agree by
  more than chance (a one-sided t-test over stretches), and be nearer to each other than the measurement is to zero.

Then each motion of the odometry is turned back before the last optimisation; GTSAM solves for the rest as before.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit
from scipy.stats import sem

from segslam import geometry
from segslam.pose_graph.edges import Edge
from segslam.types import AngleSamples, DriftEvidence, Vector

BEND_M = 48.0
"""KISS-ICP turns by the leftover angle in this many metres. Chosen: simulated 06 at 0.2 and 0.35 degrees (44 to 48)."""
CONSTANT_SIGMA_RAD = math.radians(0.3)  # chosen: what calibrations of sensors leave
SLOW_SIGMA_RAD = math.radians(0.08)  # chosen: as the simulator's axis wanders
SLOW_M = 150.0  # chosen: 15 s at 10 m/s, the same
SAMPLE_SIGMA_RAD = math.radians(0.06)
"""Error of one sample. Measured on simulated 06: 0.055 to 0.066 degrees against the true angle."""
LEAST_ANGLE_RAD = math.radians(0.08)
"""Chosen: estimates are off by as much on simulated 06 and 07, and a smaller angle bends little."""
NUM_STRETCHES = 8
"""Chosen: seven degrees of freedom for the test; on a drive of 1 km a stretch is as long as angles stay alike."""
LEAST_SAMPLES = 2 * NUM_STRETCHES
MOST_SIGMAS = 5.0  # chosen: far above noise, and one failed pair of scans does not decide
SIGNIFICANCE = 0.05
"""Chance that prediction and measurement pass as alike where the one has nothing to do with the other. Chosen: as the
prediction must also be nearer than zero is, 2 of 100 drives that an angle did not bend are straightened, and 94 that
0.1 degrees did; at 0.01 it would be none and 76."""


class HeldOut(NamedTuple):
    """Stretches of the drive beside what the others predict."""

    chi2_before: float
    """Of the excess pitch as it is."""
    chi2_after: float
    """Of the excess pitch less its prediction."""
    t_value: float
    """Of the agreement between the two, over stretches."""


def judge(samples: AngleSamples) -> DriftEvidence:
    """Whether a leftover vertical angle bent the odometry, by stretches of the drive held out of the fit."""
    if len(samples.travel_m) < LEAST_SAMPLES:
        reason = f"{len(samples.travel_m)} pairs of scans, {LEAST_SAMPLES} needed"
        return DriftEvidence(chosen=False, reason=reason, num_pairs=len(samples.travel_m))
    held_out = _held_out(samples)
    angle_rad = float(np.median(samples.angle_rad))
    needed = float(stdtrit(NUM_STRETCHES - 1, 1.0 - SIGNIFICANCE))
    reason = _objection(angle_rad, held_out, needed)
    return DriftEvidence(
        chosen=not reason,
        reason=reason or "held-out stretches are as predicted",
        num_pairs=len(samples.travel_m),
        angle_deg=math.degrees(angle_rad),
        chi2_before=held_out.chi2_before,
        chi2_after=held_out.chi2_after,
        t_value=held_out.t_value,
        t_needed=needed,
    )


def pitch_per_m(samples: AngleSamples, travel_m: Vector) -> Vector:
    """(n,) how much too far down the odometry turns at these places, in rad/m."""
    return smoothed_angle(samples, travel_m) / BEND_M


def straightened(odometry: list[Edge], turned_rad: Vector) -> list[Edge]:
    """The motions without the pitch (rad, nose down) that each has too much; as much before as after each."""
    return [
        Edge(edge.a, edge.b, T_half @ edge.T_a_b @ T_half, edge.information)
        for edge, turned in zip(odometry, turned_rad, strict=True)
        for T_half in [geometry.exp(geometry.tangent(rotation_rad=[0.0, -turned / 2, 0.0], translation_m=0.0))]
    ]


def smoothed_angle(samples: AngleSamples, travel_m: Vector) -> Vector:
    """(n,) rad: the expected angle at these places, given the samples; those far off all others are left out."""
    kept = _without_outliers(samples)
    covariance = _covariance(kept.travel_m, kept.travel_m) + SAMPLE_SIGMA_RAD**2 * np.eye(len(kept.travel_m))
    return _covariance(travel_m, kept.travel_m) @ np.linalg.solve(covariance, kept.angle_rad)


def _covariance(travel_a_m: Vector, travel_b_m: Vector) -> Float[np.ndarray, "_ _"]:
    apart_m = np.abs(travel_a_m[:, None] - travel_b_m)
    return CONSTANT_SIGMA_RAD**2 + SLOW_SIGMA_RAD**2 * np.exp(-apart_m / SLOW_M)


def _held_out(samples: AngleSamples) -> HeldOut:
    """The excess pitch of each stretch beside what the angles of the other stretches predict."""
    excess = samples.excess_rad_per_m
    bounds = np.linspace(0, len(excess), NUM_STRETCHES + 1).astype(int)
    predicted = np.concatenate(
        [
            pitch_per_m(samples.rows(np.delete(np.arange(len(excess)), slice(start, end))), samples.travel_m[start:end])
            for start, end in pairwise(bounds)
        ]
    )
    agreement = np.add.reduceat(predicted * excess, bounds[:-1])
    sigma = max(1.4826 * float(np.median(np.abs(excess - np.median(excess)))), np.finfo(float).tiny)
    return HeldOut(
        chi2_before=_chi2(excess / sigma),
        chi2_after=_chi2((excess - predicted) / sigma),
        t_value=float(agreement.mean() / max(sem(agreement), np.finfo(float).tiny)),
    )


def _chi2(errors: Vector) -> float:
    """Each error counts at most as `MOST_SIGMAS`."""
    return float(np.minimum(errors**2, MOST_SIGMAS**2).sum())


def _objection(angle_rad: float, held_out: HeldOut, needed: float) -> str:
    """Why not to believe in a bend; empty if there is no reason."""
    if abs(angle_rad) < LEAST_ANGLE_RAD:
        return f"{math.degrees(angle_rad):.3f} degrees are within the error of the estimate"
    if held_out.t_value < needed:
        return f"held-out stretches are not as predicted (t {held_out.t_value:.1f} < {needed:.1f})"
    if held_out.chi2_after >= held_out.chi2_before:
        return "held-out stretches are no better for it"
    return ""


def _without_outliers(samples: AngleSamples) -> AngleSamples:
    off = np.abs(samples.angle_rad - np.median(samples.angle_rad))
    spread = max(1.4826 * float(np.median(off)), SAMPLE_SIGMA_RAD)
    return samples.rows(np.flatnonzero(off <= 4.0 * spread))

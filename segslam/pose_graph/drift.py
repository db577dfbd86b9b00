"""Systematic drift: angles left over in the scans bend every drive up, down or sideways, and loops hardly see it.

A drive that pitches evenly with every metre lies on a sphere instead of a plane, and there every loop closes as it does
on the plane: what a constant pitch adds to the transform around a closed loop is the integral of d(|p|^2) / 2 in height
and of the direction of travel in tilt, both zero. What closures tell of the bend is of second order, below the noise
of any but exact ones, and the twist that fits them best is noise. The scans tell (`beam_angles`). How they are used:

- each angle is a constant and a slow change around it (an Ornstein-Uhlenbeck process). How much it changes, and how far
  off a sample is, are those under which the samples are likeliest, so that angles that do not change bend nothing;
- the angles predict how much too far the odometry turned, which was measured apart for each pair of scans;
- short stretches of the drive are held out in turn, and predicted from what lies around them. Prediction and
  measurement must agree by more than chance (a one-sided t-test over stretches, of both angles together, for an
  odometry takes either for the shape of the world or neither), and be nearer to each other than the measurement is to
  zero.

Then each motion of the odometry is turned back before the last optimisation; GTSAM solves for the rest as before.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit
from scipy.stats import sem

from segslam import geometry
from segslam.pose_graph.edges import Edge
from segslam.types import AngleSamples, DriftEvidence, Mask, Vector

BEND_M = np.array([40.0, 50.0])
"""KISS-ICP turns down by the vertical angle in so many metres, and left by that of azimuth in so many. Chosen:
simulated 00 to 09 with seed 1 against the angles that were simulated (34 to 40, 43 to 62)."""
SLOW_M = 150.0
"""Way on which an angle changes. Chosen: 15 s at 10 m/s, as the simulator's axis wanders; 75 and 300 do as well."""
SLOW_SIGMAS_RAD = np.radians([0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.14, 0.2])
SAMPLE_SIGMAS_RAD = np.radians([0.03, 0.045, 0.06, 0.085, 0.12, 0.17])
"""What the two may be. Chosen: steps of 1.4, around the 0.06 and 0.09 degrees by which samples are off where the angles
are known (simulated 00 to 09)."""
LEAST_ANGLE_RAD = math.radians(0.05)
"""A constant smaller than this counts half. Chosen: means over simulated drives are off by 0.02 degrees, depending on
the errors of single beams; half is expected where constants of such a size and their errors are alike."""
STRAIGHTENED_WORTH = 3.0
"""By so much the information of straightened odometry exceeds what `noise.odometry_information` claims. Chosen: squared
errors of chains of ten and a hundred are 0.9 and 0.35 times as large as before (simulated 00 to 09, seed 1)."""
STRETCH = 4  # pairs of scans that are held out at once; chosen
MARGIN = 2
"""As many on either side share a scan with those, and are held out too."""
LEAST_SAMPLES = 32  # chosen: a third of a kilometre, eight stretches
MOST_SIGMAS = 5.0  # chosen: far above noise, and one failed pair of scans does not decide
SIGNIFICANCE = 0.05
"""Chance that prediction and measurement pass as alike where the one has nothing to do with the other. Chosen: as the
prediction must also be nearer than zero is, fewer drives pass."""


class AlongDrive(NamedTuple):
    """One angle along a drive, as samples (n,) show it; all angles in rad."""

    travel_m: Vector
    deviation: Vector
    """Of each sample from the mean."""
    constant: float
    """The mean, or half of it where it is small."""
    slow_sigma: float
    precision: Float[np.ndarray, "n n"]
    """Inverse of the covariance of the samples; those far off all others have a precision near zero."""

    def at(self, travel_m: Vector) -> Vector:
        """(m,) the expected angle at these places."""
        expected = _correlation(travel_m, self.travel_m) @ (self.precision @ self.deviation)
        return self.constant + self.slow_sigma**2 * expected

    def held_out(self) -> Vector:
        """(n,) the angle of each sample, expected from those that share no scan with its stretch.

        What is left of samples B after a prediction from all others is P_BB^-1 (P y)_B, with P their precision
        (Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, eq. 5.12, for more than one).
        """
        pulled = self.precision @ self.deviation
        predicted = np.empty(len(pulled))
        for start in range(0, len(pulled), STRETCH):
            out = slice(max(start - MARGIN, 0), start + STRETCH + MARGIN)
            inner = slice(start, start + STRETCH)
            expected = self.deviation[out] - np.linalg.solve(self.precision[out, out], pulled[out])
            predicted[inner] = expected[start - out.start :][:STRETCH]
        return self.constant + predicted


class HeldOut(NamedTuple):
    """Stretches of the drive beside what the others predict."""

    chi2_before: float
    """Of the excess turns as they are."""
    chi2_after: float
    """Of the excess turns less their prediction."""
    t_value: float
    """Of the agreement between the two, over stretches."""
    t_needed: float


def judge(samples: AngleSamples) -> DriftEvidence:
    """Whether leftover angles bent the odometry, by stretches of the drive held out of the fit."""
    if len(samples.travel_m) < LEAST_SAMPLES:
        reason = f"{len(samples.travel_m)} pairs of scans, {LEAST_SAMPLES} needed"
        return DriftEvidence(chosen=False, reason=reason, num_pairs=len(samples.travel_m))
    angles = fitted(samples)
    held_out = _held_out(angles, samples.excess_rad_per_m)
    reason = _objection(angles, held_out)
    vertical, azimuth = np.degrees(np.median(samples.angle_rad, axis=0)).tolist()
    return DriftEvidence(
        chosen=not reason,
        reason=reason or "held-out stretches are as predicted",
        num_pairs=len(samples.travel_m),
        vertical_deg=vertical,
        azimuth_deg=azimuth,
        vertical_change_deg=math.degrees(angles[0].slow_sigma),
        azimuth_change_deg=math.degrees(angles[1].slow_sigma),
        **held_out._asdict(),
    )


def turns_per_m(samples: AngleSamples, travel_m: Vector) -> Float[np.ndarray, "n 2"]:
    """How much too far down, and too far left, the odometry turns at these places, in rad/m."""
    return angles_along(samples, travel_m) / BEND_M


def angles_along(samples: AngleSamples, travel_m: Vector) -> Float[np.ndarray, "n 2"]:
    """The vertical angle and that of azimuth to be expected at these places, in rad."""
    return np.column_stack([angle.at(travel_m) for angle in fitted(samples)])


def straightened(odometry: list[Edge], turned_rad: Float[np.ndarray, "n 2"]) -> list[Edge]:
    """The motions without what each has turned too far (rad, nose down and left); as much before as after each.

    They are worth more than before.
    """
    return [
        Edge(edge.a, edge.b, T_half @ edge.T_a_b @ T_half, STRAIGHTENED_WORTH * edge.information)
        for edge, (down, left) in zip(odometry, turned_rad, strict=True)
        for T_half in [geometry.exp(geometry.tangent(rotation_rad=[0.0, -down / 2, -left / 2], translation_m=0.0))]
    ]


def fitted(samples: AngleSamples) -> tuple[AlongDrive, AlongDrive]:
    """The vertical angle and that of azimuth along the drive, under the sigmas that make the samples likeliest."""
    vertical, azimuth = samples.angle_rad.T
    return _fitted(samples.travel_m, vertical), _fitted(samples.travel_m, azimuth)


def _fitted(travel_m: Vector, angle_rad: Vector) -> AlongDrive:
    kept = _without_outliers(angle_rad)
    correlation = _correlation(travel_m, travel_m)
    slow_sigma, sample_sigma, mean = _likeliest(correlation[np.ix_(kept, kept)], angle_rad[kept])
    is_plain = abs(mean) > LEAST_ANGLE_RAD
    noise = np.where(kept, sample_sigma, 1e3) ** 2
    return AlongDrive(
        travel_m,
        angle_rad - mean,
        mean if is_plain else mean / 2,
        slow_sigma,
        np.linalg.inv(slow_sigma**2 * correlation + np.diag(noise)),
    )


def _likeliest(correlation: Float[np.ndarray, "n n"], angle_rad: Vector) -> tuple[float, float, float]:
    """The sigmas of change and samples under which these are likeliest, and the mean that goes with them."""
    spread, axes = np.linalg.eigh(correlation)
    angle, one = axes.T @ angle_rad, axes.sum(axis=0)
    best = (-math.inf, 0.0, 0.0, 0.0)
    for slow_sigma, sample_sigma in product(SLOW_SIGMAS_RAD, SAMPLE_SIGMAS_RAD):
        variance = slow_sigma**2 * spread + sample_sigma**2
        mean = (one * angle / variance).sum() / (one**2 / variance).sum()
        likelihood = -np.log(variance).sum() - ((angle - mean * one) ** 2 / variance).sum()
        best = max(best, (float(likelihood), float(slow_sigma), float(sample_sigma), float(mean)))
    return best[1:]


def _correlation(travel_a_m: Vector, travel_b_m: Vector) -> Float[np.ndarray, "_ _"]:
    return np.exp(-np.abs(travel_a_m[:, None] - travel_b_m) / SLOW_M)


def _held_out(angles: tuple[AlongDrive, AlongDrive], excess_rad_per_m: Float[np.ndarray, "n 2"]) -> HeldOut:
    """The excess turns of each stretch beside what the angles around it predict."""
    predicted = np.column_stack([angle.held_out() for angle in angles]) / BEND_M
    off_middle = np.abs(excess_rad_per_m - np.median(excess_rad_per_m, axis=0))
    sigma = np.maximum(1.4826 * np.median(off_middle, axis=0), np.finfo(float).tiny)
    measured, predicted = excess_rad_per_m / sigma, predicted / sigma
    products = (predicted * np.clip(measured, -MOST_SIGMAS, MOST_SIGMAS)).sum(axis=1)
    agreement = np.add.reduceat(products, np.arange(0, len(products), STRETCH))
    return HeldOut(
        chi2_before=_chi2(measured),
        chi2_after=_chi2(measured - predicted),
        t_value=float(agreement.mean() / max(sem(agreement), np.finfo(float).tiny)),
        t_needed=float(stdtrit(len(agreement) - 1, 1.0 - SIGNIFICANCE)),
    )


def _chi2(errors: Float[np.ndarray, "n 2"]) -> float:
    """Each error counts at most as `MOST_SIGMAS`."""
    return float(np.minimum(errors**2, MOST_SIGMAS**2).sum())


def _objection(angles: tuple[AlongDrive, AlongDrive], held_out: HeldOut) -> str:
    """Why not to believe in a bend; empty if there is no reason."""
    if not any(abs(angle.constant) > LEAST_ANGLE_RAD or angle.slow_sigma for angle in angles):
        return "the angles are within the error of their estimates"
    if held_out.t_value < held_out.t_needed:
        return f"held-out stretches are not as predicted (t {held_out.t_value:.1f} < {held_out.t_needed:.1f})"
    if held_out.chi2_after >= held_out.chi2_before:
        return "held-out stretches are no better for it"
    return ""


def _without_outliers(angle_rad: Vector) -> Mask:
    off = np.abs(angle_rad - np.median(angle_rad))
    return off <= 4.0 * max(1.4826 * float(np.median(off)), float(SAMPLE_SIGMAS_RAD[0]))

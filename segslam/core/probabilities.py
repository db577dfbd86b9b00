"""The two probabilities by which evidence is judged, in all stages, and functions of probabilities."""

import math

from scipy.special import ndtri

INLIER_PROBABILITY = 0.99
"""Statistics: what belongs to a distribution is below this quantile of it. A closure is an inlier if its squared error
is, by the chi-square distribution (6 degrees of freedom); two keyframes are candidates for a loop unless they are near
each other with less than the rest of this probability; a vertical angle of the sensor differs from zero if it is beyond
this quantile of its error."""

SIGNIFICANT = 0.001
"""Chosen: what is less probable is excluded. An odometry of other sensors is overruled where its pose is less likely,
given the scans; KISS-ICP is off where chance explains its distance from a registration with less; a pose has a good
score if its odds of being wrong are less; two edges of a file contradict each other if chance explains their difference
with less, and so do two position fixes. The adjustment has the same share of chance for a sweep that scans show, for
surfaces that become thicker, and for a pose out of reach of an alignment; the clock and the lever arm of a receiver are
corrected if chance explains what fixes show of them with less."""


def sigmas_beyond(probability: float) -> float:
    """Number of standard deviations that a normal variable exceeds, to either side, with this probability."""
    return float(-ndtri(0.5 * probability))


def log_odds(probability: float) -> float:
    """Log of how much more probable something is than its opposite (nats); at most 35, by the rounding of numbers."""
    return math.log(max(probability, 1e-300)) - math.log(max(1.0 - probability, 1e-15))


def log_chance(chi_square: float, dimensions: int) -> float:
    """Log of the largest probability of a chi-square as large as this, whatever the distribution of the errors.

    By Markov's inequality: its mean is the number of dimensions if their covariance is true. Errors of odometry are
    often small and sometimes large.
    """
    return min(0.0, math.log(dimensions / max(chi_square, 1.0)))

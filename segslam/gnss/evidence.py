"""How much of the difference between fixes and drive is the drift of the drive, and how much is the receiver's error.

The difference r of the fixes to the placed drive is Gaussian with the covariance

    C = s^2 P + q^2 K(tau) + w^2 I + A S A',    K(tau)_ij = exp(-|t_i - t_j| / tau)

    symbol  meaning
    P       covariance of the positions of the drive from its graph, the first pose held
    A, S    derivatives of the positions by placement, clock and lever arm; their covariance before the fixes
    s       factor on the noise of the drive, if its graph claims too little
    q, tau  standard deviation and time constant of the slow errors of the receiver (multipath, atmosphere)
    w       standard deviation of its errors from fix to fix

The three unknowns are those of the largest likelihood; placement, clock and lever arm are then the most likely ones
(generalised least squares: errors that last for minutes do not pass for a lever arm). The two kinds of error are
distinct: the drift of a drive grows with the travel, is small between places joined by loops, and is smooth; the errors
of a receiver depend on time alone.
A standard deviation claimed by the receiver is not used: it is often wrong by a factor of ten.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from segslam.core.types import Indices, Vector
from segslam.gnss.alignment import PRIOR, Placement, linearised
from segslam.gnss.statistics import KEPT_WEIGHT, fix_noise
from segslam.graph.closure_pairs import adjoints
from segslam.graph.position_fixes import PositionedGraph

MOST_FIXES = 150
"""Chosen: fixes compared, spread over the drive; the result differs little from 100 on."""
DRIFT_FACTORS = np.array([1.0, 2.0, 4.0, 8.0])
TIME_CONSTANTS_S = np.array([1.0, 5.0, 20.0, 60.0, 200.0, 600.0])
RECEIVER_FACTORS = 2.0 ** np.arange(-5.0, 1.5)
"""Grids of s, tau, and of q relative to the standard deviation of all differences."""
PRIOR_DRIFT_FACTOR = 3.0
"""Chosen: the noise of the graph is estimated on the drive, so s is within this factor at one standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The noise of largest likelihood along one axis or two, s, q, tau and w, and the constants with it."""

    drift_factor: float
    sigma_m: float
    time_constant_s: float
    white_m: float
    constants: Vector
    """(c,) the most likely constants, as differences to those with which the residuals were computed."""
    constant_sigma: Vector
    """(c,) their standard deviations."""

    def effective_sigma_m(self, interval_s: float) -> float:
        """Standard deviation of fixes every `interval_s`, if they are treated as independent, relative to the graph.

        The mean of many fixes then has the variance that it has with slow errors. The noise of the graph stays as it
        is, so that of the fixes is divided by the factor of the drift.
        """
        many = max(1.0, 2.0 * self.time_constant_s / max(interval_s, 1e-3))
        return math.sqrt(many * self.sigma_m**2 + self.white_m**2) / self.drift_factor


def estimated(
    graph: PositionedGraph, placement: Placement, *, axis: int, free: Sequence[bool] = (False, False)
) -> Estimate:
    """The noise of largest likelihood for the kept fixes, horizontally (`axis` 0) or in height (1).

    `free`: whether the clock and the lever arm are among the unknowns. The points on the LiDAR are compared: its
    distance to the antenna changes nothing here.
    """
    axes = [2] if axis else [0, 1]
    prior = PRIOR * np.repeat([True, *free], [6, 1, 2])
    residual, columns = linearised(placement.matched, placement.T_enu_map, placement.arm_m)
    kept = np.flatnonzero(placement.weights[:, axis] >= KEPT_WEIGHT)
    white_m = fix_noise(residual[kept, 2] if axis else residual[kept])
    chosen = kept[np.unique(np.linspace(0, len(kept) - 1, min(MOST_FIXES, len(kept))).round().astype(int))]
    P = _covariance(graph, placement, chosen, axes)
    r = residual[chosen][:, axes].T.ravel()
    A = columns[chosen][:, axes].transpose(1, 0, 2).reshape(len(r), -1)
    fixed = (A * prior**2) @ A.T + white_m**2 * np.eye(len(r))
    scale = max(float(np.sqrt(np.mean(r**2))), white_m)
    time_s = placement.matched.time_s[chosen]
    apart_s = np.abs(time_s[:, None] - time_s)
    best = -np.inf
    for tau in TIME_CONSTANTS_S:
        K = np.kron(np.eye(len(axes)), np.exp(-apart_s / tau))
        for s in DRIFT_FACTORS:
            prior_s = -0.5 * (math.log(s) / math.log(PRIOR_DRIFT_FACTOR)) ** 2
            for q in scale * RECEIVER_FACTORS:
                tried = cho_factor(s**2 * P + q**2 * K + fixed, lower=True, check_finite=False)
                density = -0.5 * r @ cho_solve(tried, r, check_finite=False) - np.log(np.diag(tried[0])).sum()
                if prior_s + density > best:
                    best, factor = prior_s + density, tried
                    likely = float(s), float(q), float(tau)
    gain = (prior**2)[:, None] * A.T
    covariance = np.diag(prior**2) - gain @ cho_solve(factor, gain.T)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Estimate(*likely, white_m, gain @ cho_solve(factor, r), sigma)


def _covariance(graph: PositionedGraph, placement: Placement, chosen: Indices, axes: Sequence[int]) -> np.ndarray:
    """(n d, n d) covariance of the positions of the LiDAR by the drive, along d axes, one after the other."""
    matched = placement.matched
    keys, T_enu_lidar = matched.keyframe[chosen], placement.T_enu_map @ matched.T_map_lidar[chosen]
    moved = T_enu_lidar[:, :3, :3] @ adjoints(np.linalg.inv(matched.T_keyframe_lidar[chosen]))[:, 3:]
    derivatives = np.zeros((len(axes), len(keys), len(matched.drive.keyframe_rows), 6))
    derivatives[:, np.arange(len(keys)), keys] = moved[:, axes].transpose(1, 0, 2)
    return graph.covariance(derivatives.reshape(len(axes) * len(keys), -1))

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
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array
from scipy.sparse.linalg import SuperLU, splu

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Vector
from segslam.gnss.alignment import PRIOR, Placement, linearised
from segslam.gnss.matching import Drive, Matched
from segslam.gnss.statistics import KEPT_WEIGHT, fix_noise
from segslam.graph import Edge
from segslam.graph.closure_pairs import adjoints

MOST_FIXES = 150
"""Chosen: fixes compared, spread over the drive; the result differs little from 100 on."""
HELD = geometry.tangent(rotation_rad=1e-4, translation_m=1e-2)
"""Standard deviations that hold the first pose, since the placement is among the unknowns of A."""
DRIFT_FACTORS = np.array([1.0, 2.0, 4.0, 8.0])
TIME_CONSTANTS_S = np.array([1.0, 5.0, 20.0, 60.0, 200.0, 600.0])
RECEIVER_FACTORS = 2.0 ** np.arange(-5.0, 1.5)
"""Grids of s, tau, and of q relative to the standard deviation of all differences."""
PRIOR_DRIFT_FACTOR = 3.0
"""Chosen: the noise of the graph is estimated on the drive, so s is within this factor at one standard deviation."""


@dataclass(frozen=True, slots=True)
class Noise:
    """The noise of drive and receiver along one axis, or two."""

    drift_factor: float
    """s"""
    sigma_m: float
    """q"""
    time_constant_s: float
    """tau"""
    white_m: float
    """w"""

    def effective_sigma_m(self, interval_s: float) -> float:
        """Standard deviation of fixes every `interval_s`, if they are treated as independent, relative to the graph.

        The mean of many fixes then has the variance that it has with slow errors. The noise of the graph stays as it
        is, so that of the fixes is divided by the factor of the drift.
        """
        many = max(1.0, 2.0 * self.time_constant_s / max(interval_s, 1e-3))
        return math.sqrt(many * self.sigma_m**2 + self.white_m**2) / self.drift_factor


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The noise of largest likelihood, and the constants with it."""

    noise: Noise
    constants: Vector
    """(c,) the most likely constants, as differences to those with which the residuals were computed."""
    sigma: Vector
    """(c,) their standard deviations."""


def drift_solver(edges: Sequence[Edge], T: Poses) -> SuperLU:
    """The factorised information of the poses of a drive; `T` (k, 4, 4): the optimum of the edges, in any frame."""
    rows, columns, blocks = [0], [0], [np.diag(HELD**-2.0)]
    for edge in edges:
        T_b_a = geometry.inverse(T[edge.b]) @ T[edge.a]
        derivatives = (edge.a, -adjoints(T_b_a[None])[0]), (edge.b, np.eye(6))
        for (row, left), (column, right) in product(derivatives, repeat=2):
            rows.append(row)
            columns.append(column)
            blocks.append(left.T @ edge.information @ right)
    inner = np.arange(6)
    at_row = 6 * np.array(rows)[:, None, None] + inner[:, None]
    at_column = 6 * np.array(columns)[:, None, None] + inner
    values = np.array(blocks)
    shape = (6 * len(T), 6 * len(T))
    where = [np.broadcast_to(place, values.shape).ravel() for place in (at_row, at_column)]
    return splu(coo_array((values.ravel(), where), shape=shape).tocsc())


def estimated(
    solver: SuperLU, drive: Drive, matched: Matched, placement: Placement, *, axis: int, free: Sequence[bool]
) -> Estimate:
    """The noise of largest likelihood for the kept fixes, horizontally (`axis` 0) or in height (1).

    `solver`: that of the drive's graph. `free`: whether the clock and the lever arm are among the unknowns. The points
    on the LiDAR are compared: its distance to the antenna changes nothing here.
    """
    axes = [2] if axis else [0, 1]
    prior = PRIOR * np.repeat([True, *free], [6, 1, 2])
    residual, columns = linearised(drive, matched, placement.T_enu_map, placement.arm_m)
    kept = np.flatnonzero(placement.weights[:, axis] >= KEPT_WEIGHT)
    white_m = fix_noise(residual[kept, 2] if axis else residual[kept])
    chosen = kept[np.unique(np.linspace(0, len(kept) - 1, min(MOST_FIXES, len(kept))).round().astype(int))]
    some = matched.some(chosen)
    P = _covariance(solver, placement.T_enu_map @ drive.T_map_keyframe, some, axes)
    r = residual[chosen][:, axes].T.ravel()
    A = columns[chosen][:, axes].transpose(1, 0, 2).reshape(len(r), -1)
    fixed = (A * prior**2) @ A.T + white_m**2 * np.eye(len(r))
    scale = max(float(np.sqrt(np.mean(r**2))), white_m)
    apart_s = np.abs(some.time_s[:, None] - some.time_s)
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
                    noise = Noise(float(s), float(q), float(tau), white_m)
    gain = (prior**2)[:, None] * A.T
    covariance = np.diag(prior**2) - gain @ cho_solve(factor, gain.T)
    return Estimate(noise, gain @ cho_solve(factor, r), np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _covariance(solver: SuperLU, T_enu_keyframe: Poses, matched: Matched, axes: Sequence[int]) -> np.ndarray:
    """(n d, n d) covariance of the positions of the LiDAR by the drive, along d axes, one after the other."""
    R = T_enu_keyframe[matched.keyframe, :3, :3]
    x, y, z = matched.points(np.zeros(3)).T
    zero = np.zeros_like(x)
    cross = np.stack([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    jacobian = np.concatenate([-R @ cross, R], axis=2)  # (n, 3, 6)
    dense = np.zeros((len(axes), len(matched), solver.shape[0]))
    for row, key in enumerate(matched.keyframe):
        dense[:, row, 6 * key : 6 * key + 6] = jacobian[row, axes]
    dense = dense.reshape(-1, solver.shape[0])
    covariance = dense @ solver.solve(np.ascontiguousarray(dense.T))
    return (covariance + covariance.T) / 2

"""A steady drift of the heading: a rotation error at a constant rate per metre of travel and per second.

If closures measure a drift far beyond the noise of the odometry, then noise is a poor model of it. Noise spreads the
correction by its own growth, with turns counted more than straights, so a steady drift is corrected in wrong places.
The two rates are therefore estimated together with all poses, by least squares.

Only the heading is corrected. Closures of a drive observe the rates of roll, pitch and scale badly: an estimate of
them adds errors of metres to a drive whose heading alone drifts.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from jaxtyping import Float
from scipy.sparse.linalg import splu

from segslam.core.types import Points, Vector
from segslam.graph import noise
from segslam.graph.closure_pairs import pairwise_chi2
from segslam.graph.edges import Edge, factor_graph, is_break, jacobian, joined, rotated
from segslam.graph.levenberg_marquardt import search

MUCH_LESS = 0.5
"""Chosen: the correction is used if the rest of the drift needs at most this share of the noise."""
MOST_COMPARED = 300
"""Chosen: number of closures, spread over the drive, that are compared pairwise."""
INDEPENDENT = 1e-6
"""Chosen: below this ratio of eigenvalues, travel and time are proportional; the smallest rates are then used."""
Growth = Float[np.ndarray, "_ k"]


def noise_factor(odometry: Sequence[Edge], certain: Edge) -> float:
    """Factor by which odometry's noise is too small for the drift that a closure measures, at least 1.

    Drift is usual if its chi-square is the number of its degrees of freedom. It is 1 across a break.
    """
    first, last = sorted((certain.a, certain.b))
    if any(is_break(motion) for motion in odometry[first:last]):
        return 1.0
    at_target = Edge(certain.a, certain.a, np.eye(4), noise.CERTAIN)
    return _mean_noise_factor(odometry, [certain, at_target])


class SteadyDrift(NamedTuple):
    """A steady drift of the heading, and what is left of the drift without it."""

    turns: Points
    """(n, 3) rotation missing after each motion (rad), about its z axis."""
    noise_factor: float
    """Factor by which the usual noise is too small for the corrected motions, at least 1."""
    values: gtsam.Values
    """The poses after the correction."""


def steady_drift(
    prior: gtsam.NonlinearFactorGraph,
    odometry: Sequence[Edge],
    closures: Sequence[Edge],
    growth: Growth,
    values: gtsam.Values,
    *,
    tolerated: float,
) -> SteadyDrift | None:
    """The steady drift of an odometry with its usual noise; None if it explains little of what `closures` measure.

    None also if `tolerated` times that noise is enough for the drift. A row of `growth` has the travel (m) and the time
    (s) of a motion, zeros for a motion without drift. `values`: poses that satisfy the closures.
    """
    if not closures:
        return None
    measured = [closures[row] for row in np.unique(np.linspace(0, len(closures) - 1, MOST_COMPARED).astype(int))]
    measured.append(Edge(0, 0, np.eye(4), noise.CERTAIN))
    before = _mean_noise_factor(odometry, measured)
    if before <= tolerated:
        return None
    trials = []
    rate_cost = 0.5 * math.log(len(odometry))  # Schwarz 1978: the Bayesian information criterion of two models
    for model in ([0], [1], [0, 1]):  # rates by travel, by time, by both
        if not growth[:, model].any(axis=0).all():
            continue
        turns, corrected, at = np.zeros((len(odometry), 3)), list(odometry), values
        for _ in range(3):  # linear estimates, each from the one before
            turns[:, 2] += growth[:, model] @ _rates(prior, corrected, closures, growth[:, model], at)
            corrected = rotated(odometry, turns)
            found = search(joined(prior, factor_graph(corrected), factor_graph(closures)), at)
            at = found.values
        trials.append((found.error + rate_cost * len(model), turns, corrected, at))
    if not trials:
        return None
    _, turns, corrected, at = min(trials, key=lambda trial: trial[0])
    factor = _mean_noise_factor(corrected, measured)
    return SteadyDrift(turns, factor, at) if factor <= MUCH_LESS * before else None


def _mean_noise_factor(odometry: Sequence[Edge], measured: Sequence[Edge]) -> float:
    """As `noise_factor`, of the drift between every two measurements: the root of the mean chi-square.

    Two rates explain the drift around one closure whatever its cause; they explain all only if the drift is steady.
    """
    chi2 = pairwise_chi2(odometry, measured)
    return max(1.0, math.sqrt(float(chi2[np.tril_indices(len(chi2), -1)].mean()) / noise.DEGREES_OF_FREEDOM))


def _rates(
    prior: gtsam.NonlinearFactorGraph,
    odometry: Sequence[Edge],
    closures: Sequence[Edge],
    growth: Growth,
    values: gtsam.Values,
) -> Vector:
    """(k,) heading (rad) missing in the motions per unit of each column of `growth`, linearised at `values`."""
    derivatives, errors = jacobian(joined(factor_graph(odometry), prior, factor_graph(closures)), values)
    whitened = np.stack([np.linalg.cholesky(edge.information)[2] for edge in odometry])  # of the heading
    rates = np.zeros((len(errors), growth.shape[1]))
    rates[: 6 * len(odometry)] = -(whitened[:, :, None] * growth[:, None, :]).reshape(-1, growth.shape[1])
    poses = splu((derivatives.T @ derivatives).tocsc())
    rest = rates - derivatives @ poses.solve(derivatives.T @ rates)
    scale = np.maximum(np.linalg.norm(growth, axis=0), 1e-9)
    normal, right = (rates.T @ rest) / np.outer(scale, scale), (rest.T @ errors) / scale
    return np.linalg.pinv((normal + normal.T) / 2, rcond=INDEPENDENT, hermitian=True) @ right / scale

"""Truncated least squares over a pose graph: inliers among the closures, decided together with the poses.

Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020:
truncated least squares, in which a closure costs at most its bound.

| symbol | here |
|---|---|
| r_i^2 | `squared`: squared whitened error (chi-square) of closure i |
| c_bar^2 | `inlier_bound` |
| mu | `control` |
| w_i | `weights` |

Differs from the paper and from GTSAM's GncOptimizer, which optimise until convergence from the first values at each mu:
here each mu takes one Gauss-Newton step from the last values, which is enough for a small change of weights.
Levenberg-Marquardt follows at the end.

Another start is the largest pairwise-consistent set. It holds the inliers unless outliers that are consistent with the
rest, as a repeated street makes them, outnumber the true closures of their place. Then the true closures are rejected,
are consistent too, and lower the cost when they take the place of the outliers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from segslam.core.robust import CONTROL_FACTOR, first_control, tls_weights
from segslam.core.types import Mask, Vector
from segslam.graph.closure_pairs import Pairs, largest_consistent
from segslam.graph.edges import Edge, factor_graph, squared_errors
from segslam.graph.levenberg_marquardt import Search, search, step

MAX_STEPS = 100
NEGLIGIBLE_WEIGHT = 1e-6
"""Closures with a smaller weight are left out of the linear system."""
MAX_TRIALS = 10
"""Chosen: each takes some optimisations; there are hardly more places with so many rejected closures."""
MIN_GROUP = 3
"""Chosen: a smaller group hardly ever has a lower cost than the change of odometry that it requires."""
NEARLY_ALL = 0.9
"""Chosen: a true closure is consistent with all other true ones but one in a hundred; with half of them, outliers are
too."""
LARGE = 0.05
"""Chosen: groups of ten false closures are dropped where 200 true ones are connected, and none where 40 are."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses, and which closures are inliers."""

    search: Search
    """Its error is that of the factors without closures that were rejected."""
    weights: Vector
    """(k,) 1 for an inlier, 0 for a rejected closure."""
    truncated_cost: float
    """The error of `search` and, for each rejected closure, half the bound times its penalty."""


@dataclass(frozen=True, eq=False)
class TruncatedProblem:
    """Factors that are always kept, and closures that are kept or cost their penalty times half of `inlier_bound`."""

    backbone: gtsam.NonlinearFactorGraph
    closures: Sequence[Edge]
    inlier_bound: float
    """Bound of the squared whitened error (chi-square, not half of it)."""
    penalties: Vector
    """(k,) 0 to 1: cost of rejecting each closure; low for closures that may be wrong together."""

    @cached_property
    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Those of the closures."""
        return factor_graph(self.closures)

    def squared_errors(self, values: gtsam.Values) -> Vector:
        """(k,) chi-square of each closure."""
        return squared_errors(self.factors, values)

    def inliers(self, values: gtsam.Values) -> Vector:
        """(k,) 1 for each closure within the bound, else 0."""
        return (self.squared_errors(values) <= self.inlier_bound).astype(float)

    def weighted(self, weights: Vector) -> gtsam.NonlinearFactorGraph:
        """The least-squares problem in which closure i has its information times `weights[i]`."""
        graph = gtsam.NonlinearFactorGraph(self.backbone)
        for i, (closure, weight) in enumerate(zip(self.closures, weights, strict=True)):
            if weight == 1.0:
                graph.add(self.factors.at(i))
            elif weight > NEGLIGIBLE_WEIGHT:
                graph.add(closure.factor(weight=float(weight)))
        return graph


def solve(problem: TruncatedProblem, start: gtsam.Values) -> Solution:
    """Poses and inliers by graduated non-convexity, or near `start` if their cost is lower there.

    Neither is sure to be the global optimum.
    """
    values, iterations = _graduate(problem, start)
    graduated = settle(problem, values, iterations)
    return graduated if graduated.weights.all() else better(graduated, settle(problem, start))


def better(*solutions: Solution) -> Solution:
    """The solution with the lowest truncated cost."""
    return min(solutions, key=lambda solution: solution.truncated_cost)


def settle_from(problem: TruncatedProblem, start: gtsam.Values, likely: Mask, iterations: int = 0) -> Solution:
    """The solution near the optimum, searched from `start`, of some `likely` closures (k,)."""
    found = search(problem.weighted(likely.astype(float)), start)
    return settle(problem, found.values, iterations + found.iterations)


def _graduate(problem: TruncatedProblem, start: gtsam.Values) -> tuple[gtsam.Values, int]:
    """Algorithm 1: from the optimum of all closures to weights of 0 and 1; the poses, and the number of iterations."""
    values, _, iterations, _ = search(problem.weighted(np.ones(len(problem.closures))), start)
    worst = problem.squared_errors(values).max(initial=0.0)
    if worst <= problem.inlier_bound:
        return values, iterations
    control = first_control(worst, problem.inlier_bound)
    for _ in range(MAX_STEPS):
        weights = tls_weights(problem.squared_errors(values), control, problem.inlier_bound)
        if np.minimum(weights, 1.0 - weights).max() < NEGLIGIBLE_WEIGHT:
            break
        values = step(problem.weighted(weights), values)
        iterations += 1
        control *= CONTROL_FACTOR
    return values, iterations


def settle(problem: TruncatedProblem, values: gtsam.Values, iterations: int = 0) -> Solution:
    """Local optimum of the truncated cost near `values`: keep the closures within the bound, optimise, repeat.

    With penalties of 1 neither half raises the cost, so this ends; MAX_STEPS guards against other penalties and against
    rounding at the bound.
    """
    within = problem.inliers(values)
    for _ in range(MAX_STEPS):
        weights = within
        found = search(problem.weighted(weights), values)
        values, iterations = found.values, iterations + found.iterations
        within = problem.inliers(values)
        if (within == weights).all():
            break
    rejection_cost = 0.5 * problem.inlier_bound * float(problem.penalties[weights == 0.0].sum())
    return Solution(found._replace(iterations=iterations), weights, found.error + rejection_cost)


def select_consistent(problem: TruncatedProblem, start: gtsam.Values, consistent: Pairs, near: Pairs) -> Solution:
    """The best solution near `start`, near the largest consistent set, and with rejected groups put in its place.

    `consistent` and `near` (k, k): which pairs of closures are consistent, and which join the same places.
    """
    best = settle_from(problem, start, largest_consistent(consistent))
    return exchange_groups(problem, better(best, settle(problem, start)), consistent, near)


def exchange_groups(problem: TruncatedProblem, best: Solution, consistent: Pairs, near: Pairs) -> Solution:
    """The solution once groups of rejected closures are tried as inliers, the largest first.

    A group is the largest consistent set of one place among the rejected closures. The inliers that are consistent with
    nearly all of it stay.
    """
    left = best.weights == 0.0
    for _ in range(MAX_TRIALS):
        group = largest_consistent(consistent & near, left)
        if group.sum() < MIN_GROUP:
            break
        kept = (best.weights > 0.0) & (consistent[:, group].mean(axis=1) >= NEARLY_ALL)
        trial = settle_from(problem, best.search.values, kept | group)
        left &= ~group
        if trial.truncated_cost < best.truncated_cost:
            best = trial
            left = best.weights == 0.0
    return best


def large_groups(consistent: Pairs, near: Pairs, among: Mask) -> Mask:
    """(k,) those of some closures that form large groups: at least `LARGE` of the members of the largest group.

    Pairs that are consistent and near connect a group. A single outlier is consistent with most of a graph whose
    odometry drifts far, but it has no neighbours of which that is true.
    """
    rows = np.flatnonzero(among)
    _, group = connected_components(csr_array((consistent & near)[np.ix_(rows, rows)]), directed=False)
    sizes = np.bincount(group, minlength=1)
    chosen = np.zeros(len(among), dtype=bool)
    chosen[rows] = sizes[group] >= LARGE * sizes.max(initial=0)
    return chosen

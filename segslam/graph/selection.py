"""Inliers among closures, from the largest pairwise-consistent set.

The largest consistent set holds the inliers unless outliers that are consistent with the rest, as a repeated street
makes them, outnumber the true closures of their place. Then the true closures are rejected, are consistent too, and
lower the cost when they take the place of the outliers.
"""

import gtsam
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from segslam.core.types import Mask
from segslam.graph.closure_pairs import Pairs, largest_consistent
from segslam.graph.gnc import Solution, TruncatedProblem, better, settle, settle_from

MAX_TRIALS = 10
"""Chosen: each takes some optimisations; there are hardly more places with so many rejected closures."""
MIN_GROUP = 3
"""Chosen: a smaller group hardly ever has a lower cost than the change of odometry that it requires."""
NEARLY_ALL = 0.9
"""Chosen: a true closure is consistent with all other true ones but one in a hundred; with half of them, outliers are
too."""
LARGE = 0.05
"""Chosen: groups of ten false closures are dropped where 200 true ones are connected, and none where 40 are."""


def select_consistent(problem: TruncatedProblem, start: gtsam.Values, consistent: Pairs, near: Pairs) -> Solution:
    """The best solution near `start`, near the largest consistent set, and with rejected groups put in its place.

    `consistent` and `near` (k, k): which pairs of closures are consistent, and which join the same places.
    """
    best = settle_from(problem, start, largest_consistent(consistent, np.ones(len(consistent), dtype=bool)))
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

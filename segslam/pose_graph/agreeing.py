"""Which closures to believe, from those that agree with each other: the most, then what those shut out.

The largest set that agrees is the truth unless lies that agree with the rest, as a repeated street makes them,
outnumber the true closures of their place. Then the true ones are left over, agree too, and explain the drive at a
lower cost.
"""

import gtsam
import numpy as np

from segslam.pose_graph.consistency import Agreements, largest_agreeing
from segslam.pose_graph.gnc import Solution, TruncatedProblem, better, settle, settle_from

MOST_TRIALS = 10
"""Chosen: each takes some optimisations; there are hardly more places with so many closures left out."""
LEAST_GROUP = 3
"""Chosen: fewer closures that were left out are hardly ever worth the odometry that they bend."""

NEARLY_ALL = 0.9
"""Chosen: true closures agree with all other true ones but one in a hundred; with half of them, lies do too."""


def believe_agreeing(problem: TruncatedProblem, start: gtsam.Values, agree: Agreements, near: Agreements) -> Solution:
    """The best solution found next to `start`, next to the largest set that agrees, and with groups put in its place.

    `agree` and `near` (k, k) say which two closures do, and which join the same places. A group is the largest of one
    place that agrees among those not believed; with it stay those believed that agree with nearly all of it.
    """
    best = settle_from(problem, start, largest_agreeing(agree, np.ones(len(agree), dtype=bool)))
    best = better(best, settle(problem, start))
    left = best.weights == 0.0
    for _ in range(MOST_TRIALS):
        group = largest_agreeing(agree & near, left)
        if group.sum() < LEAST_GROUP:
            break
        kept = (best.weights > 0.0) & (agree[:, group].mean(axis=1) >= NEARLY_ALL)
        trial = settle_from(problem, best.search.values, kept | group)
        left &= ~group
        if trial.truncated_cost < best.truncated_cost:
            best = trial
            left = best.weights == 0.0
    return best

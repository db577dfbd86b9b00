"""The trials of each experiment: unchanged pairs, pairs with rotated source, pairs with labels removed."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from segslam.bench.experiments.pairs import PairList, true_poses
from segslam.bench.experiments.trials import ScanVariant, Trial, trial
from segslam.core.types import Trajectory

PAPER_PAIR = PairList("0 and 10", np.array([[0, 10]]), 1)
"""The scans of 05 with which the paper tests rotation and removal of labels."""


def pair_trials(pairs: PairList, reference: Trajectory | None) -> list[Trial]:
    """One trial per pair of unchanged scans. Raises SegslamError for a pair without known true pose."""
    return [
        trial(pairs.name, ScanVariant(source), ScanVariant(target), T_target_source)
        for (source, target), T_target_source in true_poses(pairs, reference).items()
    ]


def turned_trials(pairs: PairList, reference: Trajectory | None, *, step_deg: float) -> list[Trial]:
    """Each pair with the source rotated about z in steps. Raises SegslamError as `pair_trials`."""
    return [
        trial(pairs.name, ScanVariant(source, yaw_deg=float(yaw_deg)), ScanVariant(target), T_target_source)
        for (source, target), T_target_source in true_poses(pairs, reference).items()
        for yaw_deg in np.arange(0.0, 360.0, step_deg)
    ]


def unlabelled_trials(
    pairs: PairList,
    reference: Trajectory | None,
    *,
    lost_percent: Sequence[float],
    num_draws: int,
    seed: int,
    both: bool,
) -> list[Trial]:
    """Each pair with a random share of its labels removed, from both scans or from the source; a new draw per trial.

    Raises SegslamError as `pair_trials`.
    """
    trials = []
    for ((source, target), T_target_source), percent in product(true_poses(pairs, reference).items(), lost_percent):
        for draw in range(seed * num_draws, (seed + 1) * num_draws):
            reduced = [ScanVariant(index, lost=percent / 100, draw=draw) for index in (source, target)]
            kept = reduced[1] if both else ScanVariant(target)
            trials.append(trial(pairs.name, reduced[0], kept, T_target_source))
    return trials

"""Ablation: the coarse pose with one component removed, on pairs where it could matter."""

from collections.abc import Callable
from functools import cache

import numpy as np

from segslam.bench.experiments.pairs import Trial
from segslam.core.config import Config, load_config
from segslam.core.types import Description, Label
from segslam.registration import segregator
from tools.benchmarks.common import Row
from tools.benchmarks.registration.attempts import error, percent
from tools.benchmarks.registration.scans import Labelled
from tools.benchmarks.registration.speed import timed

VARIANTS: dict[str, tuple[str, ...]] = {
    "as it is": (),
    "gate: published": ("segregator.gate=published",),
    "gate: lengths": ("segregator.gate=lengths",),
    "one clique a bound": ("segregator.max_cliques=1",),
    "one bound, one clique": ("segregator.max_cliques=1", "segregator.noise_bounds_m=[0.2]"),
    "cars and trunks only": ("segregator.cluster_min_points={car: 6, trunk: 4}",),
    "cars and trunks of the authors' sizes": ("segregator.cluster_min_points={car: 30, trunk: 15}",),
    "things at their centres, not feet": ("segregator.foot_classes=[]",),
    "one noise for all (joint solver)": ("segregator.solver=joint",),
    "features never": ("segregator.features=never",),
    "features always": ("segregator.features=always",),
}
LOST_SHARE = 0.7
"""Of the labels in both scans, in the harder half of the table."""

Case = tuple[Trial, Callable[[int], Labelled]]


def ablation(cases: list[Case], config: Config, *, seed: int) -> list[Row]:
    """A row a variant: success and mean error of coarse poses, labels as they are and with most of them lost."""
    configs = {name: load_config(overrides=changes, base=config) for name, changes in VARIANTS.items()}
    return [{"variant": name} | _measured(cases, changed, seed) for name, changed in configs.items()]


def _measured(cases: list[Case], config: Config, seed: int) -> Row:
    row: Row = {}
    for suffix, share in (("", 0.0), ("_labels_lost", LOST_SHARE)):
        described = cache(lambda scan, index, share=share: _described(scan(index), share, [seed, index], config))
        errors, cpu = [], []
        for pair, scan in cases:
            source, target = described(scan, pair.source.index), described(scan, pair.target.index)
            outcome = segregator.match(source, target, config=config.segregator)
            cpu.append(timed(lambda: segregator.match(source, target, config=config.segregator))[1])  # noqa: B023
            errors.append(error(outcome, pair.T_target_source))
        good = [one for one in errors if one.success]
        row |= {
            f"percent{suffix}": percent([one.success for one in errors]),
            f"mean_m{suffix}": round(float(np.mean([one.translation_m for one in good])), 3),
            f"match_cpu_ms{suffix}": round(1e3 * float(np.median(cpu)), 1),
        }
    return row


def _described(scan: Labelled, lost_share: float, seed: list[int], config: Config) -> Description:
    points, labels = scan
    lost = np.random.default_rng(seed).random(len(labels)) < lost_share
    return segregator.describe(points, np.where(lost, np.uint8(Label.UNLABELLED), labels), config=config.segregator)

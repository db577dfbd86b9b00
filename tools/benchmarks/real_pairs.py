"""Real pairs of KITTI 00 whose poses are known, registered by the methods of `segslam bench`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from segslam.bench.experiments import benchmark
from segslam.bench.experiments.job import Job
from segslam.bench.experiments.pairs import PairList, Trial, pair_trials, read_pairs
from segslam.bench.experiments.rows import Row
from segslam.core.config import Config
from segslam.scans import DataSource

COARSE, REFINED = "segregator", "segregator-c2f"
"""Without and with refinement and verification."""
PREDICTED = (0, 20, 30, 4413)
"""Scans with labels of a network."""


def kitti(data: Path, labels: str) -> DataSource:
    """The real scans of KITTI 00; `labels`: geometric or predicted_labels."""
    return DataSource(data / "kitti", labels=labels)


def reference_pairs(data: Path) -> PairList:
    """The pairs of KITTI 00 whose pose is known to some centimetres."""
    return read_pairs(data / "kitti" / "reference_pairs.json")


def predicted_pairs(data: Path) -> PairList:
    """Those of them whose scans both have labels of a network."""
    whole = reference_pairs(data)
    return replace(whole, pairs=whole.pairs[np.isin(whole.pairs, PREDICTED).all(axis=1)])


def register(source: DataSource, trials: Sequence[Trial], methods: Sequence[str], config: Config) -> list[Row]:
    """The rows of all trials by these methods."""
    return [row for rows in benchmark.run(Job(source, tuple(methods), config), trials) for row in rows]


def register_turned(data: Path, pairs: PairList, labels: str, config: Config, *, num_yaws: int) -> list[Row]:
    """Pairs of KITTI 00, the source turned by each yaw of a full circle, coarse and refined."""
    trials = pair_trials(pairs, None, step_deg=360.0 / num_yaws)
    return register(kitti(data, labels), trials, (COARSE, REFINED), config)

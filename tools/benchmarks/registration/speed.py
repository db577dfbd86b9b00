"""Time of each stage compared with small_gicp on the same pair; size of descriptions; 6,000 correspondences."""

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from time import perf_counter, process_time

import numpy as np

from segslam.bench.experiments.baselines import align_gicp, prepare_gicp
from segslam.bench.experiments.methods import measured
from segslam.bench.experiments.pairs import Trial
from segslam.core.config import Config
from segslam.core.types import Description, Label, Registration
from segslam.registration import refinement, segregator
from segslam.registration.prepared import prepare_observed, prepare_scan
from segslam.verification import register
from segslam.verification.patches import agreement
from tools.benchmarks.common import Row
from tools.benchmarks.registration.scans import Labelled

BESIDE = "small_gicp"
NUM_CLUSTERS = 78
"""Of one class in each of two scans: 6,084 correspondences."""
Seconds = tuple[float, float]
"""By the wall, and of CPU in all threads, which other processes disturb less."""


def stages(pairs: Iterable[tuple[Trial, Callable[[int], Labelled]]], config: Config) -> list[Row]:
    """A row a stage, over the pairs; labels are not in it.

    A cold pair is two scans prepared, matched, refined and verified. Beside it small_gicp prepares both and aligns
    them from the identity.
    """
    seconds: dict[str, list[Seconds]] = {}
    for pair, scan in pairs:
        for stage, taken in _timed_stages(scan(pair.source.index), scan(pair.target.index), config):
            seconds.setdefault(stage, []).append(taken)
    beside = float(np.median([cpu for _, cpu in seconds[BESIDE]]))
    return [_row(stage, np.array(taken), beside) for stage, taken in seconds.items()]


def _timed_stages(source: Labelled, target: Labelled, config: Config) -> Iterable[tuple[str, Seconds]]:
    for scan in (source, target):
        yield "describe", timed(partial(segregator.describe, *scan, config=config.segregator))
        yield "surface and view", timed(partial(prepare_observed, *scan, config=config))
    one, other = (prepare_scan(*scan, config=config) for scan in (source, target))
    yield "match", timed(lambda: segregator.match(one.description, other.description, config=config.segregator))
    coarse = segregator.match(one.description, other.description, config=config.segregator)
    if isinstance(coarse, Registration):
        T_coarse = coarse.T_target_source
        surfaces = one.surface, other.surface
        yield "refine", timed(lambda: refinement.refine(*surfaces, T_coarse, config=config.refine))
        yield "verify", timed(lambda: agreement(one, other, T_coarse))
    clouds, labels = (source[0], target[0]), {"source_labels": source[1], "target_labels": target[1]}
    yield "cold pair", timed(lambda: register(*clouds, **labels, config=config))
    yield BESIDE, timed(lambda: align_gicp(*(prepare_gicp(points) for points, _ in (source, target))))


def timed(work: Callable[[], object]) -> Seconds:
    wall, cpu = perf_counter(), process_time()
    work()
    return perf_counter() - wall, process_time() - cpu


def _row(stage: str, seconds: np.ndarray, beside: float) -> Row:
    (wall, cpu), (wall_95, cpu_95) = (1e3 * np.percentile(seconds, share, axis=0) for share in (50, 95))
    return {
        "stage": stage,
        "num": len(seconds),
        "median_ms": round(wall, 1),
        "p95_ms": round(wall_95, 1),
        "cpu_median_ms": round(cpu, 1),
        "cpu_p95_ms": round(cpu_95, 1),
        f"cpu_in_{BESIDE}": round(cpu / 1e3 / beside, 3),
    }


def sizes(scans: Iterable[tuple[str, Labelled]], config: Config) -> list[Row]:
    """Bytes of the descriptions, as configured and with features always; and the CPU time of the latter."""
    always = config.segregator.model_copy(update={"features": "always"})
    rows: list[Row] = []
    for name, scan in scans:
        usual, whole = (segregator.describe(*scan, config=one) for one in (config.segregator, always))
        cpu = [timed(partial(segregator.describe, *scan, config=always))[1] for _ in range(5)]
        rows.append(
            {
                "scan": name,
                "points": len(scan[0]),
                "clusters": len(usual.sizes),
                "kilobytes": round(_bytes(usual) / 1e3, 1),
                "kilobytes_with_features": round(_bytes(whole) / 1e3, 1),
                "describe_with_features_cpu_ms": round(1e3 * float(np.median(cpu)), 1),
            }
        )
    return rows


def _bytes(description: Description) -> int:
    return sum(getattr(description, field.name).nbytes for field in dataclasses.fields(description))


def many_correspondences(config: Config, *, rng: np.random.Generator) -> list[Row]:
    """Scans with a single class, half of whose clusters the other scan sees again, and with nothing in common."""
    settings = config.segregator.model_copy(update={"features": "never"})
    first, again, strange = (_clusters(rng.uniform([-60, -60, -2], [60, 60, 2], (NUM_CLUSTERS, 3))) for _ in range(3))
    half = np.arange(NUM_CLUSTERS) < NUM_CLUSTERS // 2
    again = _clusters(
        np.where(half[:, None], first.means + rng.normal(scale=0.05, size=first.means.shape), again.means)
    )
    rows: list[Row] = []
    for name, target in (("half in common", again), ("nothing in common", strange)):
        segregator.match(first, target, config=settings)
        with measured() as cost:
            outcome = segregator.match(first, target, config=settings)
        rows.append(
            {
                "scans": name,
                "correspondences": NUM_CLUSTERS**2,
                "inliers": getattr(outcome, "num_inliers", 0),
                "ms": round(1e3 * cost.seconds, 1),
                "cpu_ms": round(1e3 * cost.cpu_seconds, 1),
                "peak_mb": None if cost.peak_mb is None else round(cost.peak_mb, 1),
            }
        )
    return rows


def _clusters(means: np.ndarray) -> Description:
    count = len(means)
    return Description(
        means=means,
        covariances=np.tile(0.3 * np.eye(3), (count, 1, 1)),
        classes=np.full(count, Label.CAR, np.uint8),
        sizes=np.full(count, 100),
        feature_points=np.empty((0, 3)),
        feature_covariances=np.empty((0, 3, 3)),
        feature_classes=np.empty(0, np.uint8),
        feature_descriptors=np.empty((0, 33)),
    )

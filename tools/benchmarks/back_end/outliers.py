"""False closures among true ones: single, in groups anywhere, in groups near the prior."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from segslam.core import geometry
from segslam.core.types import LoopClosure
from segslam.graph import PoseGraph
from tools.benchmarks.back_end.drives import CONFIG, Drive, closure

KINDS = ("random", "grouped", "nearby")
"""Single pairs anywhere; groups with a common error anywhere; groups displaced along the road."""
NEARBY_M = 25.0
SLIDE_M = (5.0, 20.0)


def finished(drive: Drive, true: Sequence[LoopClosure], false: Sequence[LoopClosure]) -> dict[str, Any]:
    """Which of the true and false closures the final optimisation keeps, and the error."""
    graph = PoseGraph(CONFIG.graph)
    for keyframe_id, (T_odom_keyframe, travel) in enumerate(zip(drive.odometry, drive.travel_m, strict=True)):
        graph.add_keyframe(keyframe_id, T_odom_keyframe, float(travel))
    for loop in (*true, *false):
        graph.add_closure(loop)
    started = time.perf_counter()
    weights = graph.finish().closure_weights
    is_true = {(loop.source_id, loop.target_id) for loop in true}
    return {
        "true": len(true),
        "true_rejected": sum(weights[pair] == 0.0 for pair in is_true),
        "outliers": len(false),
        "outliers_kept": sum(weight > 0.0 for pair, weight in weights.items() if pair not in is_true),
        **drive.errors(graph.T_world_keyframes),
        "finish_s": time.perf_counter() - started,
    }


def draw_outliers(drive: Drive, kind: str, num: int, rng: np.random.Generator) -> list[LoopClosure]:
    """`num` false closures, in groups of 5 to 15 neighbours with a common error."""
    found: list[LoopClosure] = []
    while len(found) < num:
        found += _group(drive, kind, 1 if kind == "random" else int(rng.integers(5, 16)), rng)
    return found[:num]


def _group(drive: Drive, kind: str, length: int, rng: np.random.Generator) -> Iterator[LoopClosure]:
    source = int(rng.integers(length + 60, len(drive.truth) - length))
    if kind == "nearby":
        yield from _nearby(drive, source, length, rng)
        return
    target = int(rng.integers(0, source - length - 40))
    heading = rng.uniform(-np.pi, np.pi) if kind == "random" else rng.choice([0.0, np.pi])
    T_first = geometry.transform(geometry.yaw(heading), [*rng.normal(0.0, 3.0, 2), rng.normal(0.0, 0.3)])
    yield from _moved_along(drive, source, target, 1, T_first, length, rng)


def _nearby(drive: Drive, source: int, length: int, rng: np.random.Generator) -> Iterator[LoopClosure]:
    """True closures displaced along the road; none without another visit within reach."""
    old = np.flatnonzero(drive.travel_m[:source] < drive.travel_m[source] - CONFIG.proximity.min_travel_m)
    near = old[np.linalg.norm(drive.truth[old, :3, 3] - drive.truth[source, :3, 3], axis=1) < NEARBY_M]
    if len(near):
        target = int(rng.choice(near))
        T_true = geometry.inverse(drive.truth[target]) @ drive.truth[source]
        slide = [rng.choice([-1.0, 1.0]) * rng.uniform(*SLIDE_M), rng.normal(0.0, 0.5), rng.normal(0.0, 0.1)]
        direction = 1 if T_true[0, 0] > 0 else -1
        T_first = geometry.transform(np.eye(3), slide) @ T_true
        yield from _moved_along(drive, source, target, direction, T_first, length, rng)


def _moved_along(
    drive: Drive,
    source: int,
    target: int,
    direction: int,
    T_first: np.ndarray,
    length: int,
    rng: np.random.Generator,
) -> Iterator[LoopClosure]:
    """The closures of a group of consecutive keyframes; the target moves forwards (1) or backwards (-1)."""
    for k in range(length):
        seen = target + direction * k
        if 0 <= seen < source - 10:
            T_seen_target = geometry.inverse(drive.truth[seen]) @ drive.truth[target]
            T_source_next = geometry.inverse(drive.truth[source]) @ drive.truth[source + k]
            yield closure(source + k, seen, T_seen_target @ T_first @ T_source_next, rng)

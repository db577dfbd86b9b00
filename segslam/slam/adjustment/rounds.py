"""Rounds of the adjustment: register submaps, solve the graph, build the submaps again from the result."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from time import monotonic
from typing import Any, NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import GraphEstimate, IndexPairs, Mask, Points, Vector
from segslam.graph import PoseGraph
from segslam.odometry.calibration import measure_vertical_angle
from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.pairs import EVERY, STEPS, all_pairs
from segslam.slam.adjustment.progress import Progress, no_progress
from segslam.slam.adjustment.record import Adjustment
from segslam.slam.adjustment.registrations import Aligned, RegisteredPair, register_pairs
from segslam.slam.adjustment.submaps import REACH, PointsOf, Submaps
from segslam.slam.adjustment.thickness import map_thickness_m


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The result of an adjustment."""

    record: Adjustment
    before: GraphEstimate
    after: GraphEstimate


class _Round(NamedTuple):
    """The pairs registered in a round before the time limit, and the solution with them."""

    num_pairs: int
    registered: list[RegisteredPair]
    is_complete: bool
    estimate: GraphEstimate
    noise_factors: tuple[float, float]


def adjust(
    graph: PoseGraph,
    before: GraphEstimate,
    points_of: PointsOf,
    *,
    config: Config,
    known: Known | None = None,
    progress: Progress = no_progress,
) -> Adjusted | None:
    """Adjust the poses of a graph after its last optimisation, whose result is `before`.

    `known`: the results of the drives' own adjustments, for several drives. Returns None, and changes nothing, if the
    adjustment is off or no pair of submaps could be registered.
    """
    started = monotonic()
    end_s = started + 60.0 * config.adjustment.max_minutes
    if started >= end_s:
        return None
    T_before, travel_m = graph.T_world_keyframes.copy(), graph.travel_m
    angle = known.angle if known else measure_vertical_angle(points_of, T_before, travel_m, config=config.refine)
    correction_deg = angle.angle_deg if angle is not None and angle.is_significant else 0.0
    corrected = partial(_raised, points_of, correction_deg)
    is_corrected = bool(known.correction_deg.any()) if known else correction_deg != 0.0
    of_drives = known.aligned(points_of, travel_m, config=config.refine) if known else None
    last: _Round | None = None
    for number in range(1, config.adjustment.rounds + 1):
        title = f"refine {number}/{config.adjustment.rounds}"
        aligned = of_drives or _submaps(graph, corrected, config).aligned
        made = _round(graph, aligned, config, end_s, is_corrected, partial(_titled, progress, title))
        last = made or last
        if made is None or not made.is_complete:
            break
    if last is None:
        return None
    T_after = graph.T_world_keyframes
    shared = _seen_twice(last.registered, travel_m, config)
    record = Adjustment(
        num_pairs=last.num_pairs,
        num_registered=len(last.registered),
        num_between_passes=int(_is_between_passes(last.registered, travel_m, config).sum()),
        odometry_noise_factor=last.noise_factors[0],
        noise_factor=last.noise_factors[1],
        moved_m=float(np.sqrt(np.mean(np.sum((T_after - T_before)[:, :3, 3] ** 2, axis=1)))),
        is_complete=last.is_complete,
        seconds=monotonic() - started,
        vertical_deg=None if angle is None else angle.angle_deg,
        vertical_sigma_deg=None if angle is None else angle.sigma_deg,
        correction_deg=correction_deg,
        thickness_before_m=map_thickness_m(points_of, T_before, shared),
        thickness_m=map_thickness_m(corrected, T_after, shared),
    )
    return Adjusted(record, before, last.estimate)


def _raised(points_of: PointsOf, angle_deg: float, keyframe_id: int) -> Points:
    return geometry.raise_beams(points_of(keyframe_id), angle_deg)


def _titled(progress: Progress, title: str, items: Iterable[Any], total: int) -> Iterator[Any]:
    return progress(items, total, title)


def _submaps(graph: PoseGraph, points_of: PointsOf, config: Config) -> Submaps:
    """Submaps by the current poses."""
    return Submaps(points_of, graph.T_world_keyframes.copy(), graph.travel_m, config=config.refine)


def _round(
    graph: PoseGraph,
    aligned: Aligned,
    config: Config,
    end_s: float,
    is_corrected: bool,
    show: Callable[[Iterable[Any], int], Iterator[Any]],
) -> _Round | None:
    """Register submaps by the current poses, and solve the graph; None if no pair could be registered."""
    T_world, travel_m = graph.T_world_keyframes.copy(), graph.travel_m
    pairs = all_pairs(T_world, travel_m, min_travel_m=config.proximity.min_travel_m)
    in_time = takewhile(lambda _: monotonic() < end_s, register_pairs(pairs, aligned, T_world, config=config.refine))
    tried = list(show(in_time, len(pairs)))
    registered = [one for one in tried if one is not None]
    if not registered:
        return None
    share = min(1.0, EVERY / (2 * REACH + 1))  # so that every scan counts once
    estimate, noise_factors = graph.adjust(
        [one.edge(share=share) for one in registered], shared_within=STEPS[-1] if is_corrected else 0
    )
    return _Round(len(pairs), registered, len(tried) == len(pairs), estimate, noise_factors)


def _is_between_passes(factors: Sequence[RegisteredPair], travel_m: Vector, config: Config) -> Mask:
    ends = np.array([(one.target_id, one.source_id) for one in factors])
    return np.diff(travel_m[ends], axis=1)[:, 0] >= config.proximity.min_travel_m


def _seen_twice(factors: Sequence[RegisteredPair], travel_m: Vector, config: Config) -> IndexPairs:
    """(k, 2) keyframes that see the same surfaces: of two passes or, without such, far apart along the drive."""
    ends = np.array([(one.target_id, one.source_id) for one in factors])
    between = _is_between_passes(factors, travel_m, config)
    if between.any():
        return ends[between]
    return ends[np.diff(ends, axis=1)[:, 0] == np.diff(ends, axis=1).max()]

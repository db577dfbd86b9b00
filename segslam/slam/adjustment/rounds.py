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
from segslam.core.trajectory import Poses
from segslam.core.types import GraphEstimate, IndexPairs, Mask, Points, Vector
from segslam.graph import PoseGraph
from segslam.odometry.calibration import VerticalAngle, angle_left, measure_vertical_angle, without_rest
from segslam.slam.adjustment.pairs import EVERY, STEPS, all_pairs
from segslam.slam.adjustment.progress import Progress, no_progress
from segslam.slam.adjustment.record import Adjustment
from segslam.slam.adjustment.registrations import RegisteredPair, register_pairs
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
    graph: PoseGraph, before: GraphEstimate, points_of: PointsOf, *, config: Config, progress: Progress = no_progress
) -> Adjusted | None:
    """Adjust the poses of a graph after its last optimisation, whose result is `before`.

    Returns None, and changes nothing, if the adjustment is off or no pair of submaps could be registered.
    """
    started = monotonic()
    end_s = started + 60.0 * config.adjustment.max_minutes
    if started >= end_s:
        return None
    T_before, travel_m = graph.T_world_keyframes.copy(), graph.travel_m
    angle = measure_vertical_angle(points_of, T_before, travel_m, config=config.refine)
    correction_deg = angle.angle_deg if angle is not None and angle.is_significant else 0.0
    last: _Round | None = None
    for number in range(1, config.adjustment.rounds + 1):
        if number > 1 and correction_deg:
            again = _measured_again(points_of, T_before, graph.T_world_keyframes, travel_m, correction_deg, config)
            if again is not None and again.is_significant:
                angle, correction_deg = again, again.angle_deg
        corrected = partial(_raised, points_of, correction_deg)
        title = f"refine {number}/{config.adjustment.rounds}"
        made = _round(graph, corrected, config, end_s, bool(correction_deg), partial(_titled, progress, title))
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


def _measured_again(
    points_of: PointsOf, T_before: Poses, T_world: Poses, travel_m: Vector, correction_deg: float, config: Config
) -> VerticalAngle | None:
    """The angle that leaves none after an adjustment with it, from what is left before and after one.

    The motions of the odometry turn with the angle, so submaps built by them show too much of it.
    """
    before = angle_left(points_of, T_before, travel_m, 0.0, config=config.refine)
    after = angle_left(points_of, T_world, travel_m, correction_deg, config=config.refine)
    return None if before is None or after is None else without_rest(before, correction_deg, after)


def _raised(points_of: PointsOf, angle_deg: float, keyframe_id: int) -> Points:
    return geometry.raise_beams(points_of(keyframe_id), angle_deg)


def _titled(progress: Progress, title: str, items: Iterable[Any], total: int) -> Iterator[Any]:
    return progress(items, total, title)


def _round(
    graph: PoseGraph,
    points_of: PointsOf,
    config: Config,
    end_s: float,
    is_corrected: bool,
    show: Callable[[Iterable[Any], int], Iterator[Any]],
) -> _Round | None:
    """Register submaps by the current poses, and solve the graph; None if no pair could be registered."""
    T_world, travel_m = graph.T_world_keyframes.copy(), graph.travel_m
    pairs = all_pairs(T_world, travel_m, min_travel_m=config.proximity.min_travel_m)
    submaps = Submaps(points_of, T_world, travel_m, config=config.refine)
    in_time = takewhile(lambda _: monotonic() < end_s, register_pairs(pairs, submaps, T_world, config=config.refine))
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

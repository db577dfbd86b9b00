"""Adjustment of the whole map after the loops, in rounds.

If the points of sweeps were not moved to one time, they are corrected by the motion of the sensor first (`sweeps`). A
round registers submaps with each other, and solves all poses. If the vertical angle of the scans is significant, its
result shows the angle better, and another round corrects the scans by it.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from time import monotonic
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, RefineConfig
from segslam.core.processes import Progress, in_parts, no_progress
from segslam.core.trajectory import Poses
from segslam.core.types import GraphEstimate, Record
from segslam.graph import Edge, PoseGraph
from segslam.graph.levenberg_marquardt import Unsolvable
from segslam.registration.refinement import INFORMATION_SCALE, limited_information
from segslam.slam.adjustment.alignment import PointsOf
from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.submaps import EVERY, REACH, STEPS, Aligned, aligned_by, all_pairs, surfaces_of
from segslam.slam.adjustment.sweeps import Sweep, Velocities, corrected_by, corrections_of, measure_sweep
from segslam.slam.adjustment.thickness import is_thicker, map_thickness_m, median_m
from segslam.slam.adjustment.vertical_angle import VerticalAngle, measure_vertical_angle

logger = logging.getLogger(__name__)

SHARE = min(1.0, EVERY / (2 * REACH + 1))
"""Share of the information of a registration: a scan is in so many submaps."""
MIN_OVERLAP = 0.1
"""Chosen on KITTI 00: smallest share of a submap's points that lie on the other."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Adjustment(Record):
    """The adjustment of a drive, beside its estimate."""

    num_pairs: int
    """Number of pairs of submaps chosen in the last round."""
    num_registered: int
    """Number of these whose registration converged with enough overlap; each is a factor of the graph."""
    num_between_passes: int
    """Number of factors between different passes of a place."""
    odometry_noise_factor: float
    """Standard deviations of the odometry on this drive, relative to those of the settings."""
    noise_factor: float
    """The same of the factors, relative to those of single registrations."""
    moved_m: float
    """Root mean square distance by which keyframes moved."""
    is_complete: bool
    """False if the time limit ended it early."""
    seconds: float
    vertical_deg: float | None = None
    """Remaining vertical angle of the scans; positive if their points are too low. None if it was not measured."""
    vertical_sigma_deg: float | None = None
    correction_deg: float = 0.0
    """Elevation added to all points of the keyframes, for the adjustment and for the map; 0 if not significant."""
    sweep_s: float | None = None
    """Duration of a sweep within which the sensor moved, and which is corrected in the points of the keyframes, for the
    adjustment and for the map; negative if the beams turn clockwise. None if not significant."""
    sweep_sigma_s: float | None = None
    sweep_from_deg: float | None = None
    """Azimuth at which such a sweep begins."""
    thickness_before_m: float | None = None
    """Thickness of surfaces in the map (`thickness`) before the adjustment; None if no surface was seen twice."""
    thickness_m: float | None = None
    """The same after it."""

    @property
    def sweep(self) -> Sweep | None:
        """The sweep that is corrected."""
        if self.sweep_s is None or self.sweep_sigma_s is None or self.sweep_from_deg is None:
            return None
        return Sweep(self.sweep_s, self.sweep_sigma_s, self.sweep_from_deg)

    def figures(self) -> dict[str, float]:
        """The figures of `metrics.json`; unknown ones are omitted. The vertical angle is that left in the scans."""
        figures = {
            "vertical_deg": self.vertical_deg,
            "vertical_sigma_deg": self.vertical_sigma_deg,
            "vertical_correction_deg": self.correction_deg or None,
            "sweep_s": self.sweep_s,
            "sweep_sigma_s": self.sweep_sigma_s,
            "map_thickness_before_m": self.thickness_before_m,
            "map_thickness_m": self.thickness_m,
            "num_submap_pairs": self.num_registered,
            "adjustment_moved_m": self.moved_m,
        }
        return {name: value for name, value in figures.items() if value is not None}


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The result of an adjustment."""

    record: Adjustment
    before: GraphEstimate
    after: GraphEstimate


class _Round(NamedTuple):
    """The pairs registered in a round before the time limit, and the solution with them."""

    angle: VerticalAngle | None
    """Angle by which the scans were corrected, if it is significant."""
    num_pairs: int
    registered: list[Edge]
    is_complete: bool
    estimate: GraphEstimate
    noise_factors: tuple[float, float]


def adjust(
    graph: PoseGraph,
    before: GraphEstimate,
    points_of: PointsOf,
    velocities: Velocities,
    *,
    config: Config,
    known: Known | None = None,
    progress: Progress = no_progress,
) -> Adjusted | None:
    """Adjust the poses of a graph after its last optimisation, whose result is `before`.

    `velocities`: of the sensor at the keyframes. `known`: the results of the drives' own adjustments, for several
    drives. Returns None, and changes nothing, if the adjustment is off, no pair of submaps could be registered, or
    surfaces were thinner before.
    """
    started = monotonic()
    end_s = started + 60.0 * config.adjustment.max_minutes
    if started >= end_s:
        return None
    T_before = graph.T_world_keyframes
    sweep = (
        known.sweep if known else measure_sweep(points_of, T_before, graph.num_breaks, velocities, config=config.refine)
    )
    last = _rounds(graph, points_of, velocities, sweep, known, config, end_s, progress)
    if last is None:
        return None
    correction_deg = 0.0 if last.angle is None else last.angle.correction_deg
    of_map = corrected_by(corrections_of(correction_deg, sweep, velocities), points_of)
    ends = np.array([(edge.a, edge.b) for edge in last.registered])
    apart = np.diff(ends, axis=1)[:, 0]
    is_between = apart > STEPS[-1]
    seen_twice = ends[is_between if is_between.any() else apart == apart.max()]  # else seen from farthest apart
    before_m, after_m = (map_thickness_m(of_map, T, seen_twice) for T in (T_before, graph.T_world_keyframes))
    is_corrected = sweep is not None or correction_deg != 0.0
    raw_before_m = map_thickness_m(points_of, T_before, seen_twice) if is_corrected else before_m
    if is_thicker(before_m, after_m):
        graph.drop_adjustment()
        logger.warning("surfaces of the map were thinner before the adjustment of the whole map: it is not used")
        return None
    moved_m = (graph.T_world_keyframes - T_before)[:, :3, 3]
    record = Adjustment(
        num_pairs=last.num_pairs,
        num_registered=len(last.registered),
        num_between_passes=int(is_between.sum()),
        odometry_noise_factor=last.noise_factors[0],
        noise_factor=last.noise_factors[1],
        moved_m=float(np.sqrt(np.mean(np.sum(moved_m**2, axis=1)))),
        is_complete=last.is_complete,
        seconds=monotonic() - started,
        vertical_deg=None if last.angle is None else last.angle.angle_deg,
        vertical_sigma_deg=None if last.angle is None else last.angle.sigma_deg,
        correction_deg=correction_deg,
        sweep_s=None if sweep is None else sweep.seconds,
        sweep_sigma_s=None if sweep is None else sweep.sigma_s,
        sweep_from_deg=None if sweep is None else sweep.from_deg,
        thickness_before_m=median_m(raw_before_m),
        thickness_m=median_m(after_m),
    )
    return Adjusted(record, before, last.estimate)


def _rounds(
    graph: PoseGraph,
    points_of: PointsOf,
    velocities: Velocities,
    sweep: Sweep | None,
    known: Known | None,
    config: Config,
    end_s: float,
    progress: Progress,
) -> _Round | None:
    """The last round in which a pair of submaps could be registered; None if there is none."""
    refine, travel_m = config.refine, graph.travel_m
    motion_variance = graph.motion_variance
    of_drives = known.aligned(points_of, motion_variance, config=refine) if known else None
    straight_of = corrected_by(corrections_of(0.0, sweep, velocities), points_of)
    T_world = graph.T_world_keyframes
    measured = partial(measure_vertical_angle, straight_of, travel_m=travel_m, motion_variance=motion_variance)
    angle = known.angle if known else measured(T_world, config=refine)
    last: _Round | None = None
    num_rounds = config.adjustment.rounds if angle is not None and angle.is_significant else 1
    for number in range(1, num_rounds + 1):
        T_world = graph.T_world_keyframes
        if angle is not None and number > 1 and not known:
            # the motions of the odometry turn with the angle: submaps built by them show too much of it
            again = measured(T_world, config=refine, near=angle)
            if again is None or not again.is_significant:
                break
            angle = again
        raised_deg = 0.0 if angle is None else angle.correction_deg
        corrections = known.corrections if known else corrections_of(raised_deg, sweep, velocities)
        shared_within = STEPS[-1] if any(one.raised_deg for one in corrections) else 0
        surface_of = surfaces_of(corrected_by(corrections, points_of), T_world, motion_variance, config=refine)
        aligned = of_drives or aligned_by(surface_of)
        pairs = all_pairs(T_world, travel_m, graph.covariances, min_travel_m=config.proximity.min_travel_m)
        title = f"refine {number}/{num_rounds}"
        register = partial(register_pairs, aligned=aligned, T_world=T_world, end_s=end_s, config=refine)
        if known:  # which keeps alignments in the memory of this process
            tried = list(progress(register(pairs.tolist()), len(pairs), title))
        else:
            tried = list(in_parts(pairs.tolist(), register, progress=progress, title=title))
        registered = [one for one in tried if one is not None]
        if not registered:
            break
        try:
            estimate, noise_factors = graph.adjust(registered, shared_within=shared_within)
        except Unsolvable as why:
            logger.warning("the whole map is not adjusted%s: %s", " further" * (number > 1), why)
            break
        last = _Round(angle, len(pairs), registered, len(tried) == len(pairs), estimate, noise_factors)
        if not last.is_complete:
            break
    return last


def register_pairs(
    pairs: Sequence[Sequence[int]], aligned: Aligned, T_world: Poses, *, end_s: float, config: RefineConfig
) -> Iterator[Edge | None]:
    """Register each pair (target, source) from its current pose; None without convergence or enough overlap.

    None is begun after `end_s`, a time of time.monotonic. An edge has a share of its information, so that every scan
    counts once.
    """
    for target_id, source_id in takewhile(lambda _: monotonic() < end_s, pairs):
        T_prior = geometry.inverse(T_world[target_id]) @ T_world[source_id]
        found = aligned(target_id, source_id, T_prior)
        if found is None or found.overlap < MIN_OVERLAP:
            yield None
            continue
        information = limited_information(INFORMATION_SCALE * found.information, config=config)
        yield Edge(target_id, source_id, geometry.nearest_transform(found.T_target_source), SHARE * information)

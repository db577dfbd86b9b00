"""Registration of two scans: describe and prepare each scan once, then match, refine and verify the pair."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from threading import Lock
from time import perf_counter
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from segslam import geometry, refinement, segregator
from segslam.config import Config
from segslam.semantics import geometric_labels
from segslam.system.threads import at_once
from segslam.types import (
    Alignment,
    Description,
    Direction,
    Label,
    Labels,
    Points,
    Registration,
    Rejected,
    RejectReason,
    Transform,
    as_points,
)
from segslam.verification import gates
from segslam.verification.free_space import FreeSpace, observe_free_space

Labeller = Callable[[Points], Labels]
MOST_SHIFT_M = 8
"""Chosen: largest shift along the weak direction at which rivals are searched, in steps of 1 m; refinement finds rivals
within 0.5 m."""
SPARSE_MARGIN = 1.25
"""Chosen: a rival is refined with all points if its mismatch after refinement with few is at most so many times the
largest that makes a pose ambiguous."""
NUM_SAMPLED = 800
"""Chosen: number of standing points that show how well a pose fits, to 0.02."""
HOPELESS = 1.2
"""Chosen: a pose is dropped if, after the first iterations, its mismatch is more than so many times the largest of the
poses that are searched. Of 46 rivals in streets, corridors, tunnels, garages and forests none had more than 1.05; nine
of ten other poses had more."""
SAME_POSE_M, SAME_POSE_RAD = 0.75, math.radians(5.0)
"""Chosen: poses closer to each other than this are the same."""
KNOWN_M, KNOWN_RAD = 1.0, math.radians(3.0)
"""Chosen: a known pose is off by less. Nearer rivals hardly exist: `SAME_POSE_M`."""
MOST_PLANS = 24
"""Chosen: floor-plan poses looked through for those near the prior, 1 ms each."""

NUM_FLOOR_PLANS = 4
"""Number of floor plans in memory: a scan is compared with several others in turn. A source has 12 MB of spectra."""


@runtime_checkable
class Gate(Protocol):
    """Prior knowledge about the pose: a rejection for an impossible pose, None for all others."""

    def __call__(self, T_target_source: Transform, *, slack_m: float) -> Rejected | None:
        """`slack_m`: distance by which refinement may still move the pose."""
        ...


def anywhere(T_target_source: Transform, *, slack_m: float) -> Rejected | None:
    """The gate of scans without prior knowledge."""
    return None


class Stopwatch:
    """Seconds spent in each stage, summed over all calls and threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lock = Lock()

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Context manager that adds the time within it to this stage."""
        started = perf_counter()
        try:
            yield
        finally:
            self.add(stage, perf_counter() - started)

    def add(self, stage: str, seconds: float) -> None:
        """Add a time measured elsewhere (s)."""
        with self._lock:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScan:
    """A scan prepared for registration; computed once per scan."""

    description: Description
    surface: refinement.Surface
    free_space: FreeSpace

    @property
    def observed(self) -> gates.Observed:
        """Input of the gates: surface and free space."""
        return self.surface, self.free_space


def register(
    source_points: ArrayLike,
    target_points: ArrayLike,
    *,
    source_labels: Labels | None = None,
    target_labels: Labels | None = None,
    config: Config | None = None,
) -> Alignment | Rejected:
    """The pose of one scan in another without an initial guess, each in its own sensor's frame (z up, metres).

    Points are rows of x, y, z; further columns, such as intensities, are ignored. Labels are learning ids, one per
    point; for a scan without labels, geometric labels are computed. The pose is `fine.T_target_source` of the result,
    or the result is `Rejected`. Raises SegslamError for arrays of another shape.
    """
    config = config or Config()

    def prepared(given: ArrayLike, labels: Labels | None) -> PreparedScan:
        points = as_points(given)
        return prepare_scan(points, shape_labels(points, config=config) if labels is None else labels, config=config)

    source, target = at_once(
        lambda: prepared(source_points, source_labels), lambda: prepared(target_points, target_labels)
    )
    return register_prepared(source, target, config=config)


def shape_labels(points: Points, *, config: Config) -> Labels:
    """Labels computed from geometry alone."""
    return geometric_labels(points, config=config.geometric)


def prepare_scan(
    points: Points, labels: Labels, *, config: Config, seen_from_here: Points | None = None
) -> PreparedScan:
    """Description, surface and free space of a scan; `points` in the scan's own frame.

    If `points` are gathered from several scans, `seen_from_here` are the points measured from this pose: free space is
    computed from these only. Points of moving classes are used for neither surface nor free space.
    """
    surface, seen = prepare_observed(points, labels, config=config, seen_from_here=seen_from_here)
    return PreparedScan(segregator.describe(points, labels, config=config.segregator), surface, seen)


def prepare_observed(
    points: Points, labels: Labels, *, config: Config, seen_from_here: Points | None = None
) -> gates.Observed:
    """Surface and free space as in `prepare_scan`: sufficient to refine and verify a pose that is nearly known."""
    still = points.compress(labels < Label.MOVING_CAR, axis=0)
    surface = refinement.make_surface(refinement.downsample(still, config=config.refine), config=config.refine)
    return surface, observe_free_space(still if seen_from_here is None else seen_from_here)


def register_prepared(
    source: PreparedScan,
    target: PreparedScan,
    *,
    config: Config,
    gate: Gate = anywhere,
    floor: gates.NoiseFloor = gates.SINGLE_PAIR,
    watch: Stopwatch | None = None,
) -> Alignment | Rejected:
    """The refined and verified pose of the source in the target without an initial guess, or the reason of rejection.

    Hypotheses are tried from best to worst, and the first that passes all gates is returned. If the scans constrain it
    badly in some direction and a different pose fits almost as well, the result is AMBIGUOUS. `gate` may reject a pose
    before and after refinement. `floor` is the noise of the run. If no hypothesis passes, the rejection of the best one
    is returned.
    """
    allowed = gates.limits(floor, config=config.verify)
    trial = _Trial(source, target, config, gate, floor, allowed, watch or Stopwatch())
    rejections = []
    for coarse in _coarse(trial):
        outcome = coarse if isinstance(coarse, Rejected) else trial.outcome(coarse)
        if isinstance(outcome, Found):
            return _unless_ambiguous(outcome, trial)
        rejections.append(outcome)
    return rejections[0]


def register_near(
    source: PreparedScan,
    target: PreparedScan,
    T_target_source: Transform,
    *,
    config: Config,
    floor: gates.NoiseFloor,
    watch: Stopwatch,
) -> Alignment | Rejected:
    """The refined and verified pose near one that is known to `KNOWN_M` and `KNOWN_RAD`; no other poses are tried.

    Rejects FAR_FROM_PRIOR if refinement moves the pose farther.
    """
    trial = _Trial(source, target, config, anywhere, floor, gates.limits(floor, config=config.verify), watch)
    with watch("refine"):
        fine = refinement.refine(source.surface, target.surface, T_target_source, config=config.refine)
    if isinstance(fine, Rejected):
        return fine
    moved = geometry.inverse(T_target_source) @ fine.T_target_source
    if geometry.distance(moved) > KNOWN_M or geometry.angle(moved) > KNOWN_RAD:
        detail = f"moved {geometry.distance(moved):.2f} m, {math.degrees(geometry.angle(moved)):.1f} degrees"
        return Rejected(RejectReason.FAR_FROM_PRIOR, detail)
    coarse = replace(fine, T_target_source=T_target_source, num_inliers=0, num_correspondences=0)
    with watch("verify"):
        found = trial.verified(coarse, fine)
    return found if isinstance(found, Rejected) else found.alignment


def may_match(
    source: PreparedScan,
    target: PreparedScan,
    *,
    config: Config,
    gate: Gate,
    floor: gates.NoiseFloor,
    mismatch: float,
    watch: Stopwatch,
) -> bool:
    """Whether `register_prepared` may find a pose with about this mismatch or less; a few points decide that."""
    trial = _Trial(source, target, config, gate, floor, gates.limits(floor, config=config.verify), watch)
    most = SPARSE_MARGIN * mismatch
    few = _few(source, config=config, most=most)
    ends = (trial.led(coarse, few) for coarse in _coarse(trial) if isinstance(coarse, Registration))
    return any(led is not None and trial.mismatch(led.T_target_source) <= most for led in ends)


class Found(NamedTuple):
    """A pose that passed all gates."""

    alignment: Alignment
    agreement: gates.Agreement
    weak_direction: Direction
    """Level direction in the source's frame in which the scans constrain the pose least."""


class _Few(NamedTuple):
    """A few points of the source, which lead to poses and show in 1 ms how well they fit."""

    surface: refinement.Surface
    standing: Points
    most: float
    """Largest mismatch of the poses that are searched."""
    found: tuple[Found, ...]
    """Poses that are not searched again."""


def _few(source: PreparedScan, *, config: Config, most: float, found: tuple[Found, ...] = ()) -> _Few:
    standing = source.surface.standing
    sampled = standing[:: max(len(standing) // NUM_SAMPLED, 1)]
    return _Few(refinement.sparse(source.surface, config=config.refine), sampled, most, found)


class _Trial(NamedTuple):
    """Two scans, and the gates that a pose between them must pass."""

    source: PreparedScan
    target: PreparedScan
    config: Config
    gate: Gate
    floor: gates.NoiseFloor
    limits: gates.Limits
    watch: Stopwatch
    is_rival: bool = False
    """Whether the poses are compared with one that was found."""

    def outcome(self, coarse: Registration) -> Found | Rejected:
        """One hypothesis, refined and verified."""
        config = self.config.verify
        if coarse.num_inliers < config.min_inliers:
            return Rejected(RejectReason.TOO_FEW_INLIERS, f"{coarse.num_inliers} < {config.min_inliers}")
        rejected = self.gate(coarse.T_target_source, slack_m=config.max_coarse_fine_m)
        if rejected is not None:
            return rejected
        scans = self.source.observed, self.target.observed
        with self.watch("verify"):
            hopeless = gates.early_rejection(*scans, coarse.T_target_source, self.limits, config=config)
        if hopeless is not None:
            return hopeless
        with self.watch("refine"):
            fine = refinement.refine(
                self.source.surface, self.target.surface, coarse.T_target_source, config=self.config.refine
            )
        if isinstance(fine, Rejected):
            return fine
        with self.watch("verify"):
            return self.verified(coarse, fine)

    def led(self, coarse: Registration, few: _Few) -> Registration | None:
        """The pose to which a few points of the source lead; None if it is impossible or fits badly.

        The first iterations show both whether the pose fits badly and whether it is one of those found.
        """
        if self.gate(coarse.T_target_source, slack_m=self.config.verify.max_coarse_fine_m) is not None:
            return None
        scans = self.source.observed, self.target.observed
        with self.watch("verify"):
            hopeless = gates.early_rejection(*scans, coarse.T_target_source, self.limits, config=self.config.verify)
        if hopeless is not None or min(map(len, (few.surface, self.target.surface))) < self.config.refine.min_points:
            return None
        surfaces = few.surface, self.target.surface
        with self.watch("refine"):
            T_begun = refinement.approach(*surfaces, coarse.T_target_source, config=self.config.refine)
            if _is_near(T_begun, few.found):
                return replace(coarse, T_target_source=T_begun)
            if self._mismatch_of(few, T_begun) > HOPELESS * few.most:
                return None
            fine = refinement.refine(*surfaces, T_begun, config=self.config.refine, must_converge=False)
        return None if isinstance(fine, Rejected) else replace(coarse, T_target_source=fine.T_target_source)

    def _mismatch_of(self, few: _Few, T_target_source: Transform) -> float:
        roughness_m = max(self.source.surface.roughness_m, self.target.surface.roughness_m)
        return gates.mismatch_of_some(
            few.standing, self.target.surface, T_target_source, roughness_m=roughness_m, config=self.config.verify
        )

    def mismatch(self, T_target_source: Transform) -> float:
        """Mismatch of the scans at this pose."""
        scans = self.source.observed, self.target.observed
        with self.watch("verify"):
            return gates.agreement(*scans, T_target_source, config=self.config.verify).mismatch

    def verified(self, coarse: Registration, fine: Registration) -> Found | Rejected:
        """A refined pose that passes all gates."""
        config = self.config.verify
        moved_m = geometry.distance(geometry.inverse(coarse.T_target_source) @ fine.T_target_source)
        if moved_m > config.max_coarse_fine_m:
            detail = f"moved {moved_m:.2f} m > {config.max_coarse_fine_m} m"
            return Rejected(RejectReason.REFINEMENT_DIVERGED, detail)
        far = self.gate(fine.T_target_source, slack_m=0.0)
        if far is not None:
            return far
        found = gates.agreement(self.source.observed, self.target.observed, fine.T_target_source, config=config)
        observability, _ = refinement.observability(fine.information, config=self.config.refine)
        alignment = Alignment(
            coarse, fine, found.overlap, found.rms_m, found.free_space_violation, observability=observability
        )
        passed = Found(alignment, found, refinement.weakest_level(fine.information))
        rejected = self.rejection(passed)
        return passed if rejected is None else rejected

    def rejection(self, pose: Found) -> Rejected | None:
        """Rejects a pose that fits badly, or along whose weak direction nothing matches, as if slid along a corridor.

        More than one surface must match there if the fine Hessian hardly constrains a direction, if it constrains one
        badly and the pose fits less well than neighbours do, if a scan sees one side of the place only, or if the
        stricter limits of narrow places are exceeded. Rivals need not be proven as well as that.
        """
        found = pose.agreement
        config = self.config.verify
        rejected = gates.rejection(found, self.limits.unreduced())
        if rejected is not None:
            return rejected
        scans = self.source.surface, self.target.surface
        T_target_source = pose.alignment.fine.T_target_source
        support = gates.weak_support(*scans, T_target_source, pose.weak_direction, config=config)
        least = config.min_weak_support * found.overlap
        if support.whole < least:
            return Rejected(RejectReason.LOW_OVERLAP, f"{support.whole:.3f} < {least:.3f} along the weakest direction")
        is_doubtful = not self.is_rival and not gates.is_certain(found, self.floor)
        is_narrow = min(self.source.free_space.view, self.target.free_space.view) < gates.NARROW_VIEW
        least = config.min_second_support * found.overlap
        if is_doubtful:
            least *= gates.DOUBTFUL_NARROW if is_narrow else gates.DOUBTFUL
        has_second = support.second >= least
        rejected = None
        if not has_second or (is_doubtful and not gates.is_free(found, self.floor)):
            rejected = gates.rejection(found, self.limits)
        if has_second:
            return rejected
        detail = f"{support.second:.3f} < {least:.3f} beside one surface along the weakest direction"
        if rejected is not None:
            return Rejected(rejected.reason, f"{rejected.detail}, and {detail}")
        needed = refinement.UNOBSERVED if self.is_rival else gates.WEAKLY_OBSERVED
        is_open = pose.alignment.observability < (config.well_observed if is_doubtful else needed)
        return Rejected(RejectReason.LOW_OVERLAP, detail) if is_narrow or is_open else None


def _unless_ambiguous(found: Found, trial: _Trial) -> Alignment | Rejected:
    """The best of a pose and its rivals; AMBIGUOUS if a different pose fits almost as well.

    Rivals are searched if the scans constrain the pose badly in some direction, as along a tunnel, or fit less well
    than neighbouring keyframes do. In the second case poses that the prior excludes are rivals too: a pose that fits
    no better than wrong ones is not proven by being near the prior.
    """
    config = trial.config.verify
    certain = gates.is_certain(found.agreement, trial.floor)
    if certain and found.alignment.observability >= config.well_observed:
        return found.alignment
    loose = trial._replace(limits=trial.limits.loosened(), gate=trial.gate if certain else anywhere, is_rival=True)
    passed = [found]
    most = SPARSE_MARGIN * config.rival_ratio * found.agreement.mismatch
    few = _few(trial.source, config=trial.config, most=most, found=(found,))
    for led in _rivals(found, loose, few):
        if not _is_near(led.T_target_source, passed) and loose.mismatch(led.T_target_source) <= most:
            rival = loose.outcome(led)
            if isinstance(rival, Found) and not _is_near(rival.alignment.fine.T_target_source, passed):
                passed.append(rival)
    best, *others = sorted(passed, key=lambda one: one.agreement.mismatch)
    if others and others[0].agreement.mismatch < config.rival_ratio * best.agreement.mismatch:
        apart = geometry.inverse(best.alignment.fine.T_target_source) @ others[0].alignment.fine.T_target_source
        beside = f"{others[0].agreement.mismatch:.3f} {geometry.distance(apart):.1f} m off"
        return Rejected(RejectReason.AMBIGUOUS, f"mismatch {best.agreement.mismatch:.3f}, and {beside}")
    rejected = trial.gate(best.alignment.fine.T_target_source, slack_m=0.0)
    if rejected is None:
        rejected = trial.rejection(best)
    return best.alignment if rejected is None else rejected


def _rivals(found: Found, trial: _Trial, few: _Few) -> list[Registration]:
    """Other poses that may fit as well, to which a few points lead: along the weak direction, and from floor plans."""

    def lead(coarse: Registration) -> Registration | None:
        return trial.led(coarse, few)

    def along() -> list[Registration]:
        ways = (sign * found.weak_direction for sign in (-1.0, 1.0))
        return [led for way in ways for led in _shifted(found.alignment.fine, way, lead)]

    def from_plans() -> list[Registration]:
        plans = _plans(trial, num_poses=trial.config.verify.max_rivals)
        leds = [lead(coarse) for coarse in plans if not _is_near(coarse.T_target_source, [found])]
        return [led for led in leds if led is not None]

    shifted, planned = at_once(along, from_plans)
    return shifted + planned


def _shifted(
    pose: Registration, direction: Direction, lead: Callable[[Registration], Registration | None]
) -> Iterator[Registration]:
    """Poses to which refinement (`lead`) leads from shifts in one direction, the farthest first.

    Shifts between the start and the end of a refinement are not tried: they would lead to the same pose.
    """
    nearest_m = math.inf
    for shift_m in range(MOST_SHIFT_M, 0, -1):
        if shift_m >= nearest_m:
            continue
        T_shifted = pose.T_target_source @ geometry.transform(np.eye(3), shift_m * direction)
        led = lead(replace(pose, T_target_source=T_shifted))
        if led is not None:
            yield led
            nearest_m = float((geometry.inverse(pose.T_target_source) @ led.T_target_source)[:3, 3] @ direction)


def _is_near(T_target_source: Transform, others: Sequence[Found]) -> bool:
    """True if a pose is so close to one of the others that refinement would lead to it."""
    apart = [geometry.inverse(other.alignment.fine.T_target_source) @ T_target_source for other in others]
    return any(geometry.distance(T) < SAME_POSE_M and geometry.angle(T) < SAME_POSE_RAD for T in apart)


def _coarse(trial: _Trial) -> Iterator[Registration | Rejected]:
    """Hypotheses from clusters and features, then from floor plans.

    Poses that the prior excludes are skipped and not counted: in symmetric places, such as a corridor, most poses
    that fit are turned by 180 degrees or far along it.
    """
    config = trial.config
    with trial.watch("match"):
        ranked = segregator.hypotheses(trial.source.description, trial.target.description, config=config.segregator)
    if isinstance(ranked, Rejected):
        yield ranked
    else:
        possible = [coarse for coarse in ranked if _is_possible(coarse, trial)]
        yield from (possible or ranked[:1])[: config.verify.max_hypotheses]
    yield from _plans(trial, num_poses=config.verify.max_plan_hypotheses)


def _plans(trial: _Trial, *, num_poses: int) -> list[Registration]:
    """Poses near the prior that align the two floor plans."""
    if num_poses == 0:
        return []
    with trial.watch("match"):
        plans = _floor_plan(trial.source), _floor_plan(trial.target)
        ranked = segregator.plan_hypotheses(*plans, num_poses=max(MOST_PLANS, num_poses))
        return list(islice((coarse for coarse in ranked if _is_possible(coarse, trial)), num_poses))


@lru_cache(NUM_FLOOR_PLANS)
def _floor_plan(scan: PreparedScan) -> segregator.FloorPlan:
    return segregator.FloorPlan(scan.surface.standing, segregator.vertical(scan.description))


def _is_possible(coarse: Registration, trial: _Trial) -> bool:
    return trial.gate(coarse.T_target_source, slack_m=trial.config.verify.max_coarse_fine_m) is None

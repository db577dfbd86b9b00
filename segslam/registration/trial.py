"""One pose between two scans: refined, and verified by all gates; and the hypotheses to try."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import islice
from threading import Lock
from time import perf_counter
from typing import NamedTuple, Protocol, runtime_checkable

from segslam import geometry, refinement, segregator
from segslam.config import Config
from segslam.registration.prepared import PreparedScan
from segslam.types import Alignment, Direction, Registration, Rejected, RejectReason, Transform
from segslam.verification import gates

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


_ADDING = Lock()
"""Held while a stopwatch is changed. All share it: a stopwatch itself can be sent to another process."""


class Stopwatch:
    """Seconds spent in each stage, summed over all calls and threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

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
        with _ADDING:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds


class Found(NamedTuple):
    """A pose that passed all gates."""

    alignment: Alignment
    agreement: gates.Agreement
    weak_direction: Direction
    """Level direction in the source's frame in which the scans constrain the pose least."""


class Trial(NamedTuple):
    """Two scans, and the gates that a pose between them must pass."""

    source: PreparedScan
    target: PreparedScan
    config: Config
    gate: Gate
    floor: gates.NoiseFloor
    limits: gates.Limits
    watch: Stopwatch
    is_rival: bool = False
    """True if the poses are rivals of one that was found; their limits are looser."""

    def outcome(self, coarse: Registration) -> Found | Rejected:
        """A hypothesis, refined and verified; `Rejected` by the first gate that it fails."""
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

    def mismatch(self, T_target_source: Transform) -> float:
        """Mismatch of the scans at this pose."""
        scans = self.source.observed, self.target.observed
        with self.watch("verify"):
            return gates.agreement(*scans, T_target_source, config=self.config.verify).mismatch

    def verified(self, coarse: Registration, fine: Registration) -> Found | Rejected:
        """A refined pose as `Found` if it passes all gates, else the rejection."""
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
        """Rejects a pose that fits badly, or that no surface confirms along its weak direction, as in a corridor.

        More than one surface must match there if the fine Hessian hardly constrains a direction, if it constrains one
        badly and the pose fits less well than neighbours do, if a scan sees one side of the place only, or if the
        stricter limits of narrow places are exceeded. Rivals need less evidence.
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


def coarse_poses(trial: Trial) -> Iterator[Registration | Rejected]:
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
    yield from plans_near(trial, num_poses=config.verify.max_plan_hypotheses)


def plans_near(trial: Trial, *, num_poses: int) -> list[Registration]:
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


def _is_possible(coarse: Registration, trial: Trial) -> bool:
    return trial.gate(coarse.T_target_source, slack_m=trial.config.verify.max_coarse_fine_m) is None

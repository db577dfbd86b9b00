"""The poses that two scans suggest, from clusters and features, then from floor plans; and a pose that is tried.

It is refined with few points, then with all; then it is judged by what the scans show there.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from functools import lru_cache
from itertools import islice, tee
from typing import NamedTuple, Protocol, runtime_checkable

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import Alignment, Registration, Rejected, RejectReason, Transform, probability_text
from segslam.registration import refinement, segregator
from segslam.registration.prepared import PreparedScan
from segslam.verification import patches, score

MAX_HYPOTHESES = 3
"""Chosen: number of coarse poses tried, the best first."""
MAX_PLAN_HYPOTHESES = 6
"""Chosen: number of poses tried after these, and of rivals of a found pose, from aligning the two floor plans."""
MAX_COARSE_FINE_M = 2.0
"""Chosen: largest correction of a coarse pose by refinement (m)."""

MOST_PLANS = 24
"""Chosen: floor-plan poses looked through for those near the prior, 1 ms each."""

NUM_FLOOR_PLANS = 4
"""Number of floor plans in memory: a scan is compared with several others in turn. A source has 12 MB of spectra."""

MIN_INLIERS = 3
"""Three positions determine a pose: smallest number of clique members consistent with a coarse one."""

NUM_FEW = 4
"""Number of sources of which few points are in memory."""
FEW_OFF_M = 0.5
"""Chosen: few points lead to a pose nearer than this to that of all points. Of 210 accepted poses (KITTI 00, NCLT, its
submaps, simulated 06, scenes of even seeds) none was farther off than 0.33 m."""
FEW_PRECISION_M = 0.02
"""Chosen: few points are refined until an iteration moves the pose by less, because all points refine it further. Of 36
pairs (KITTI 00, courtyard, scenes) none is decided otherwise than with a millimetre."""
FEW_NATS = 4.0
"""Chosen: a pose is not refined further if its log odds, by the patches of one scan after a refinement with few points
and without other poses, are more than this below the least odds of an accepted pose. Of 316 right poses (scenes, KITTI
00, courtyard) none was more than 0.6 below; with 2 instead one hypothesis of 60 pairs of KITTI 00 is lost."""


@runtime_checkable
class Gate(Protocol):
    """Prior knowledge about the pose: a rejection for an impossible pose, None for all others."""

    def __call__(self, T_target_source: Transform, *, slack_m: float) -> Rejected | None:
        """`slack_m`: distance by which refinement may still move the pose."""
        ...


def anywhere(T_target_source: Transform, *, slack_m: float) -> Rejected | None:
    """The gate of scans without prior knowledge."""
    return None


@lru_cache(2)
def _ranked_plans(source: PreparedScan, target: PreparedScan) -> Iterator[Registration]:
    """Poses by the floor plans, the best first; copies start again, so that rivals need no other search.

    Kept for two pairs: two threads try a scan at different places at the same time (`slam.recognition`).
    """
    (plans,) = tee(segregator.plan_hypotheses(_floor_plan(source), _floor_plan(target), num_poses=MOST_PLANS), 1)
    return plans


@lru_cache(NUM_FLOOR_PLANS)
def _floor_plan(scan: PreparedScan) -> segregator.FloorPlan:
    return segregator.FloorPlan(*scan.surface.standing(), segregator.vertical(scan.description))


@lru_cache(NUM_FEW)
def few_points(source: PreparedScan) -> refinement.Surface:
    """Some points of a source, which lead to poses."""
    return source.surface.sparse()


def forget_scans() -> None:
    """Release what was computed from the last scans; it is computed again when it is needed."""
    for kept in (_ranked_plans, _floor_plan, few_points, patches.patches_of):
        kept.cache_clear()


class Found(NamedTuple):
    """A refined pose, and what the scans show there."""

    coarse: Registration
    fine: Registration
    agreement: patches.Agreement

    @property
    def T_target_source(self) -> Transform:  # noqa: N802  (a transform)
        """The refined pose, (4, 4)."""
        return self.fine.T_target_source

    @property
    def mean_ratio(self) -> float:
        """Mean log ratio of the patches (nats)."""
        return score.shipped().mean_ratio(self.agreement.counts)


class Trial(NamedTuple):
    """Two scans, and what is known about the pose of the source in the target; its methods try poses."""

    source: PreparedScan
    target: PreparedScan
    config: Config
    gate: Gate
    watch: Stopwatch

    @property
    def least_odds(self) -> float:
        """Log odds that an accepted pose has at least."""
        return score.shipped().least_odds(self.config.verify)

    def coarse_poses(self) -> Iterator[Registration | Rejected]:
        """Hypotheses from clusters and features, then from floor plans.

        Poses that the prior excludes are skipped and not counted: in symmetric places, such as a corridor, most poses
        that fit are turned by 180 degrees or far along it.
        """
        described = self.source.description, self.target.description
        with self.watch("match"):
            ranked = segregator.hypotheses(*described, config=self.config.segregator)
        if isinstance(ranked, Rejected):
            yield ranked
        else:
            possible = [coarse for coarse in ranked if self._excluded(coarse) is None]
            yield from (possible or ranked[:1])[:MAX_HYPOTHESES]
        yield from self.plans_near()

    def plans_near(self) -> list[Registration]:
        """Poses near the prior that align the two floor plans, at most `MAX_PLAN_HYPOTHESES`."""
        with self.watch("match"):
            ranked = copy(_ranked_plans(self.source, self.target))
            return list(islice((coarse for coarse in ranked if self._excluded(coarse) is None), MAX_PLAN_HYPOTHESES))

    def _excluded(self, coarse: Registration) -> Rejected | None:
        return self.gate(coarse.T_target_source, slack_m=MAX_COARSE_FINE_M)

    def begin(self, coarse: Registration) -> Transform | Rejected:
        """The pose to which few points of the source lead from a hypothesis; `Rejected` if it is hopeless with all.

        It is if a first look at its patches gives odds far below those of an accepted pose. Takes a third of the
        time of a refinement with all points, which most wrong hypotheses do not need.
        """
        if coarse.num_inliers < MIN_INLIERS:
            return Rejected(RejectReason.TOO_FEW_INLIERS, f"{coarse.num_inliers} < {MIN_INLIERS}")
        rejected = self._excluded(coarse)
        if rejected is not None:
            return rejected
        led = self.led(coarse.T_target_source)
        if isinstance(led, Rejected):
            return led
        moved_m = geometry.distance(geometry.inverse(coarse.T_target_source) @ led.T_target_source)
        most_m = MAX_COARSE_FINE_M + FEW_OFF_M
        if moved_m > most_m:
            return Rejected(RejectReason.REFINEMENT_DIVERGED, f"moved {moved_m:.2f} m > {most_m} m with few points")
        # the patches of the target are taken to show the same
        counts = 2.0 * patches.counted(self.first_look(led.T_target_source))
        if score.shipped().log_odds(counts) < self.least_odds - FEW_NATS:
            judgement = score.shipped().judge_patches(counts)
            detail = f"{judgement.log_odds:.1f} < {self.least_odds - FEW_NATS:.1f} nats with few points"
            return Rejected(RejectReason.IMPROBABLE, detail, judgement.probability, judgement.evidence)
        return led.T_target_source

    def led(self, T_start: Transform) -> Registration | Rejected:
        """The pose to which few points of the source lead; a pose that slides need not converge."""
        config = self.config.refine
        with self.watch("refine"):
            return refinement.refine(
                few_points(self.source),
                self.target.surface,
                T_start,
                config=config,
                must_converge=False,
                precision_m=FEW_PRECISION_M,
            )

    def first_look(self, T_target_source: Transform) -> patches.Shown:
        """What the patches of the source show at this pose; takes 2 ms."""
        with self.watch("verify"):
            return patches.first_look(self.source, self.target, T_target_source)

    def refined(self, coarse: Registration, T_begun: Transform, *, must_converge: bool = True) -> Found | Rejected:
        """A hypothesis refined with all points from `T_begun`, and what the scans show there."""
        surfaces = self.source.surface, self.target.surface
        with self.watch("refine"):
            fine = refinement.refine(*surfaces, T_begun, config=self.config.refine, must_converge=must_converge)
        return fine if isinstance(fine, Rejected) else self.found(coarse, fine)

    def found(self, coarse: Registration, fine: Registration) -> Found:
        """A refined pose, and what the scans show there."""
        with self.watch("verify"):
            return Found(coarse, fine, patches.agreement(self.source, self.target, fine.T_target_source))

    def fits(self, pose: Found) -> bool:
        """True for a pose that the prior allows and that is probable enough if no other pose fits as well."""
        is_allowed = self.gate(pose.T_target_source, slack_m=0.0) is None
        return is_allowed and score.shipped().log_odds(pose.agreement.counts) >= self.least_odds


def judged(found: Found, others: Sequence[Found] | None, *, config: Config) -> Alignment | Rejected:
    """A pose with its probability; `Rejected` if it is wrong more often than `verify.max_false_share`.

    `others` that were tried: as for `score.Table.judge`.
    """
    table, shown = score.shipped(), found.agreement
    judgement = table.judge(shown, None if others is None else [other.agreement for other in others])
    least = table.least_odds(config.verify)
    if judgement.log_odds < least:
        reason = RejectReason.AMBIGUOUS if table.log_odds(shown.counts) >= least else RejectReason.IMPROBABLE
        detail = probability_text(judgement.probability, judgement.evidence)
        return Rejected(reason, detail, judgement.probability, judgement.evidence)
    observability, _ = refinement.observability(found.fine.information)
    return Alignment(
        found.coarse,
        found.fine,
        shown.overlap,
        shown.rms_m,
        shown.free_space_violation,
        observability=observability,
        probability=judgement.probability,
        evidence=judgement.evidence,
    )

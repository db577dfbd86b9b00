"""One pose between two scans: refined with few points, then with all, and verified by all gates."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from segslam.core import geometry
from segslam.core.config import Config, RefineConfig
from segslam.core.stopwatch import Stopwatch
from segslam.core.types import Alignment, Direction, Points, Registration, Rejected, RejectReason, Transform
from segslam.registration import refinement
from segslam.registration.hypotheses import Gate, Pair
from segslam.registration.prepared import PreparedScan
from segslam.verification import gates

NUM_FEW = 4
"""Number of sources of which few points are in memory."""
NUM_SAMPLED = 800
"""Chosen: number of standing points that show how well a pose fits, to 0.02."""
FEW_OFF_M = 0.5
"""Chosen: few points lead to a pose nearer than this to that of all points. Of 210 accepted poses (KITTI 00, NCLT, its
submaps, simulated 06, scenes of even seeds) none was farther off than 0.33 m."""
FEW_MARGIN = 1.05
"""Chosen: a hypothesis is dropped if a few points, refined, have a mismatch of more than so many times the largest that
the limits allow. The 210 poses had up to 0.82."""
FEW_VIOLATION = 1.5
"""Chosen: or if free space is violated there by more than so many times the limit. The 210 poses had up to 0.8; 7
rivals that made a pose ambiguous had up to 1.02 of their looser limit after the first iterations."""
EQUAL_M, EQUAL_RAD = 0.1, math.radians(0.5)
"""Chosen: a hypothesis is not refined with all points if few points lead it this close to where another was refused."""


class FewPoints(NamedTuple):
    """A few points of a source, which lead to poses and show how well they fit."""

    surface: refinement.Surface
    standing: Points


@lru_cache(NUM_FEW)
def few_points(source: PreparedScan, config: RefineConfig) -> FewPoints:
    """Some points of a source: its sparse surface, and `NUM_SAMPLED` standing points."""
    standing = source.surface.standing
    return FewPoints(
        refinement.sparse(source.surface, config=config), standing[:: max(len(standing) // NUM_SAMPLED, 1)]
    )


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

    @property
    def pair(self) -> Pair:
        """Input of the registration without initial guess."""
        return Pair(self.source, self.target, self.config, self.gate, self.watch)

    def begin(self, coarse: Registration) -> Transform | Rejected:
        """The pose to which few points of the source lead from a hypothesis; `Rejected` if it cannot pass with all.

        Takes a fifth of the time of a refinement with all points, which most wrong hypotheses do not need.
        """
        rejected = self.rejection_of_coarse(coarse)
        if rejected is not None:
            return rejected
        few, target = few_points(self.source, self.config.refine), self.target.surface
        with self.watch("refine"):
            led = refinement.refine(
                few.surface, target, coarse.T_target_source, config=self.config.refine, must_converge=False
            )
        if isinstance(led, Rejected):
            return led
        moved_m = geometry.distance(geometry.inverse(coarse.T_target_source) @ led.T_target_source)
        most_m = self.config.verify.max_coarse_fine_m + FEW_OFF_M
        if moved_m > most_m:
            return Rejected(RejectReason.REFINEMENT_DIVERGED, f"moved {moved_m:.2f} m > {most_m} m with few points")
        rejected = self.rejection_of_few(led.T_target_source)
        return led.T_target_source if rejected is None else rejected

    def rejection_of_few(self, T_target_source: Transform, *, most: float = math.inf) -> Rejected | None:
        """Rejects a pose to which few points lead, if all points would not lead to one that passes.

        `most`: largest mismatch, if smaller than that of the limits.
        """
        most = min(most, FEW_MARGIN * self.limits.most_mismatch)
        with self.watch("verify"):
            mismatch = self.mismatch_of_few(few_points(self.source, self.config.refine), T_target_source)
        if mismatch > most:
            return Rejected(RejectReason.LOW_OVERLAP, f"mismatch {mismatch:.3f} > {most:.3f} with few points")
        return self.free_space_rejection(T_target_source, factor=FEW_VIOLATION)

    def free_space_rejection(
        self, T_target_source: Transform, *, factor: float = gates.COARSE_VIOLATION
    ) -> Rejected | None:
        """Rejects a pose before refinement with all points, as `gates.early_rejection` does."""
        scans = self.source.observed, self.target.observed
        with self.watch("verify"):
            return gates.early_rejection(*scans, T_target_source, self.limits, config=self.config.verify, factor=factor)

    def rejection_of_coarse(self, coarse: Registration) -> Rejected | None:
        """Rejects a hypothesis that cannot be refined to a possible pose."""
        config = self.config.verify
        if coarse.num_inliers < config.min_inliers:
            return Rejected(RejectReason.TOO_FEW_INLIERS, f"{coarse.num_inliers} < {config.min_inliers}")
        rejected = self.gate(coarse.T_target_source, slack_m=config.max_coarse_fine_m)
        if rejected is not None:
            return rejected
        return self.free_space_rejection(coarse.T_target_source)

    def refined(self, coarse: Registration, T_begun: Transform) -> Found | Rejected:
        """A hypothesis refined with all points from `T_begun`, and verified."""
        with self.watch("refine"):
            fine = refinement.refine(self.source.surface, self.target.surface, T_begun, config=self.config.refine)
        if isinstance(fine, Rejected):
            return fine
        with self.watch("verify"):
            return self.verified(coarse, fine)

    def mismatch_of_few(self, few: FewPoints, T_target_source: Transform) -> float:
        """Mismatch of a few points of the source at this pose; takes 1 ms."""
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
        observability, _ = refinement.observability(fine.information)
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
        if not self.is_rival:
            rejected = self.violation_with_little_evidence(pose, is_narrow=is_narrow)
            if rejected is not None:
                return rejected
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

    def violation_with_little_evidence(self, pose: Found, *, is_narrow: bool) -> Rejected | None:
        """Rejects a pose that violates free space and has little else to prove it.

        If a scan sees one side of the place only (`is_narrow`), it may violate free space as little as neighbours do;
        if a direction is badly observed, by half of the limit.
        """
        found = pose.agreement
        if is_narrow and not gates.is_free(found, self.floor):
            detail = f"{found.free_space_violation:.4f}, more than neighbours, and only one side of the place is seen"
            return Rejected(RejectReason.FREE_SPACE_VIOLATED, detail)
        most = gates.VIOLATION_BADLY_OBSERVED * self.limits.max_free_space_violation
        if pose.alignment.observability < gates.BADLY_OBSERVED and found.free_space_violation > most:
            detail = f"{found.free_space_violation:.4f} > {most:.4f} where a direction is badly observed"
            return Rejected(RejectReason.FREE_SPACE_VIOLATED, detail)
        return None


def is_near(T_target_source: Transform, others: Sequence[Transform], *, within_m: float, within_rad: float) -> bool:
    """True if a pose is close to one of the others."""
    apart = [geometry.inverse(other) @ T_target_source for other in others]
    return any(geometry.distance(T) < within_m and geometry.angle(T) < within_rad for T in apart)

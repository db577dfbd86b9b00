"""Registration of two scans: hypotheses are tried in turn; the first that is probable is compared with rivals."""

import math
from collections.abc import Sequence
from dataclasses import replace

from numpy.typing import ArrayLike

from segslam.core import geometry
from segslam.core.config import Config, check_config
from segslam.core.threads import Stopwatch, at_once
from segslam.core.types import (
    Alignment,
    Registration,
    Rejected,
    RejectReason,
    Transform,
    as_labels,
    as_points,
)
from segslam.labels import geometric_labels
from segslam.registration import refinement
from segslam.registration.prepared import Observed, PreparedScan, prepare_scan
from segslam.verification.patches import agreement
from segslam.verification.rivals import rivals_of
from segslam.verification.trial import MAX_COARSE_FINE_M, Found, Gate, Trial, anywhere, judged


def register(
    source_points: ArrayLike,
    target_points: ArrayLike,
    *,
    source_labels: ArrayLike | None = None,
    target_labels: ArrayLike | None = None,
    config: Config | None = None,
) -> Alignment | Rejected:
    """The pose of one scan in another without an initial guess, each in its own sensor's frame (z up, metres).

    Points are rows of x, y, z; further columns, such as intensities, are ignored. Labels are learning ids, one per
    point; for a scan without labels, geometric labels are computed. The pose is `fine.T_target_source` of the result,
    or the result is `Rejected`. Raises SegslamError for arrays of another shape.
    """
    check_config(config)
    config = config or Config()

    def prepared(given: ArrayLike, given_labels: ArrayLike | None) -> PreparedScan:
        points = as_points(given)
        labels = as_labels(given_labels, points)
        return prepare_scan(points, geometric_labels(points) if labels is None else labels, config=config)

    source, target = at_once(
        lambda: prepared(source_points, source_labels), lambda: prepared(target_points, target_labels)
    )
    return register_prepared(source, target, config=config)


def register_prepared(
    source: PreparedScan, target: PreparedScan, *, config: Config, gate: Gate = anywhere, watch: Stopwatch | None = None
) -> Alignment | Rejected:
    """The refined and verified pose of the source in the target without an initial guess, or the reason of rejection.

    Hypotheses are tried from best to worst until one that the prior allows is probable by itself. It is compared with
    all other poses that were tried and with rivals; the best is returned if it is as probable as
    `verify.max_false_share` asks. `gate` may reject a pose before and after refinement. If no hypothesis leads
    anywhere, the rejection of the best one is returned.
    """
    trial = Trial(source, target, config, gate, watch or Stopwatch())
    tried = tried_poses(trial)
    if isinstance(tried, Rejected):
        return tried
    best, *others = tried
    return judged(best, others, config=config)


def tried_poses(trial: Trial) -> list[Found] | Rejected:
    """The best pose that the prior allows, then all that differ from it; or the rejection of the best hypothesis.

    Rivals are searched unless the best pose is improbable already.
    """
    unusable = refinement.too_few_points(trial.source.surface, trial.target.surface)
    if unusable is not None:
        return unusable
    rejections: list[Rejected] = []
    found: list[Found] = []
    for coarse in trial.coarse_poses():
        outcome = coarse if isinstance(coarse, Rejected) else _outcome(trial, coarse, found)
        if isinstance(outcome, Found):
            found.append(outcome)
            if trial.fits(outcome):
                break
        elif outcome is not None:
            rejections.append(outcome)
    excluded = [trial.gate(pose.T_target_source, slack_m=0.0) for pose in found]
    allowed = [pose for pose, rejected in zip(found, excluded, strict=True) if rejected is None]
    if not allowed:
        return [*(rejected for rejected in excluded if rejected is not None), *rejections][0]
    best = max(allowed, key=lambda pose: pose.mean_ratio)
    if trial.fits(best):
        rivals = rivals_of(best, found, trial)
        found += rivals
        better = [pose for pose in rivals if pose.mean_ratio > best.mean_ratio]
        settled = [trial.refined(pose.coarse, pose.T_target_source) for pose in better]  # rivals need not converge
        allowed += [
            pose
            for pose in settled
            if isinstance(pose, Found) and trial.gate(pose.T_target_source, slack_m=0.0) is None
        ]
        best = max(allowed, key=lambda pose: pose.mean_ratio)
    return [best, *(pose for pose in found if not refinement.is_near(pose.T_target_source, [best.T_target_source]))]


def _outcome(trial: Trial, coarse: Registration, found: Sequence[Found]) -> Found | Rejected | None:
    """A hypothesis, refined with few points, then with all; None if few points lead to a pose of `found`."""
    begun = trial.begin(coarse)
    if isinstance(begun, Rejected):
        return begun
    if refinement.is_near(begun, [pose.T_target_source for pose in found]):
        return None
    outcome = trial.refined(coarse, begun)
    if isinstance(outcome, Found):
        moved_m = geometry.distance(geometry.inverse(coarse.T_target_source) @ outcome.T_target_source)
        if moved_m > MAX_COARSE_FINE_M:
            return Rejected(RejectReason.REFINEMENT_DIVERGED, f"moved {moved_m:.2f} m > {MAX_COARSE_FINE_M} m")
    return outcome


def register_near(
    source: Observed, target: Observed, T_target_source: Transform, *, config: Config, watch: Stopwatch
) -> Alignment | Rejected:
    """The refined and verified pose near a known one; no other poses are tried.

    Rejects FAR_FROM_PRIOR if refinement leads to another pose (`refinement.is_near`).
    """
    with watch("refine"):
        fine = refinement.refine(source.surface, target.surface, T_target_source, config=config.refine)
    if isinstance(fine, Rejected):
        return fine
    if not refinement.is_near(fine.T_target_source, [T_target_source]):
        moved = geometry.inverse(T_target_source) @ fine.T_target_source
        detail = f"moved {geometry.distance(moved):.2f} m, {math.degrees(geometry.angle(moved)):.1f} degrees"
        return Rejected(RejectReason.FAR_FROM_PRIOR, detail)
    with watch("verify"):
        shown = agreement(source, target, fine.T_target_source)
    coarse = replace(fine, T_target_source=T_target_source, num_inliers=0, num_correspondences=0)
    return judged(Found(coarse, fine, shown), None, config=config)

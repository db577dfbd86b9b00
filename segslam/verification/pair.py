"""Registration of two scans: hypotheses are tried in turn; the first that passes all gates is compared with rivals."""

import math
from dataclasses import replace

from numpy.typing import ArrayLike

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.stopwatch import Stopwatch
from segslam.core.threads import at_once
from segslam.core.types import Alignment, Labels, Registration, Rejected, RejectReason, Transform, as_points
from segslam.labels import geometric_labels
from segslam.registration import refinement
from segslam.registration.hypotheses import Gate, anywhere, coarse_poses
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import gates
from segslam.verification.rivals import SPARSE_MARGIN, Searched, sparsely_refined, unless_ambiguous
from segslam.verification.trial import EQUAL_M, EQUAL_RAD, Found, Trial, is_near

KNOWN_M, KNOWN_RAD = 1.0, math.radians(3.0)
"""Chosen: largest error of a known pose. A rival this near is mostly the same pose (`rivals.SAME_POSE_M`)."""


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
        return prepare_scan(points, geometric_labels(points) if labels is None else labels, config=config)

    source, target = at_once(
        lambda: prepared(source_points, source_labels), lambda: prepared(target_points, target_labels)
    )
    return register_prepared(source, target, config=config)


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
    trial = Trial(source, target, config, gate, floor, allowed, watch or Stopwatch())
    rejections: list[Rejected] = []
    refused: list[tuple[Transform, Rejected]] = []
    for coarse in coarse_poses(trial.pair):
        outcome = coarse if isinstance(coarse, Rejected) else _outcome(trial, coarse, refused)
        if isinstance(outcome, Found):
            return unless_ambiguous(outcome, trial)
        rejections.append(outcome)
    return rejections[0]


def _outcome(trial: Trial, coarse: Registration, refused: list[tuple[Transform, Rejected]]) -> Found | Rejected:
    """A hypothesis, refined with few points, then with all, and verified; `Rejected` by the first gate that it fails.

    `refused`: poses to which few points led and all points were rejected. This one is added; one that equals
    another gets the same rejection.
    """
    begun = trial.begin(coarse)
    if isinstance(begun, Rejected):
        return begun
    for T_other, rejected in refused:
        if is_near(begun, [T_other], within_m=EQUAL_M, within_rad=EQUAL_RAD):
            return rejected
    outcome = trial.refined(coarse, begun)
    if isinstance(outcome, Rejected) and outcome.reason != RejectReason.REFINEMENT_DIVERGED:
        refused.append((begun, outcome))
    return outcome


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
    trial = Trial(source, target, config, anywhere, floor, gates.limits(floor, config=config.verify), watch)
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
    """True if `register_prepared` may find a pose with about this mismatch or less, by registering a few points."""
    trial = Trial(source, target, config, gate, floor, gates.limits(floor, config=config.verify), watch)
    most = SPARSE_MARGIN * mismatch
    ends = (
        sparsely_refined(trial, coarse, Searched(most))
        for coarse in coarse_poses(trial.pair)
        if isinstance(coarse, Registration)
    )
    return any(led is not None and trial.mismatch(led.T_target_source) <= most for led in ends)

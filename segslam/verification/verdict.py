"""Acceptance of a refined pose: its probability against the share of false loops that the user accepts."""

from collections.abc import Sequence

from segslam.core.config import Config
from segslam.core.types import Alignment, Registration, Rejected, RejectReason, probability_text
from segslam.registration import refinement
from segslam.verification import score
from segslam.verification.patches import Agreement


def judged(
    coarse: Registration,
    fine: Registration,
    found: Agreement,
    others: Sequence[Agreement] | None,
    *,
    config: Config,
    table: score.Table | None = None,
) -> Alignment | Rejected:
    """The pose `fine` with its probability; `Rejected` if it is wrong more often than `verify.max_false_share`.

    `found`: what the scans show there; `others`: at other poses, as for `score.Table.judge`.
    """
    table = table or score.shipped()
    judgement = table.judge(found, others)
    least = table.least_odds(config.verify)
    if judgement.log_odds < least:
        reason = RejectReason.AMBIGUOUS if table.log_odds(found.counts) >= least else RejectReason.IMPROBABLE
        detail = probability_text(judgement.probability, judgement.evidence)
        return Rejected(reason, detail, judgement.probability, judgement.evidence)
    observability, _ = refinement.observability(fine.information)
    return Alignment(
        coarse,
        fine,
        found.overlap,
        found.rms_m,
        found.free_space_violation,
        observability=observability,
        probability=judgement.probability,
        evidence=judgement.evidence,
    )

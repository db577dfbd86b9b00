"""Two scans to a verified pose: hypotheses of registration are refined and judged in turn, and compared with others."""

from segslam.verification.pair import may_match, register, register_near, register_prepared

__all__ = ["may_match", "register", "register_near", "register_prepared"]

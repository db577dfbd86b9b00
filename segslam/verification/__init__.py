"""Two scans to a verified pose: hypotheses of registration are refined, judged by a score, and compared with others."""

from segslam.verification.pair import register, register_near, register_prepared

__all__ = ["register", "register_near", "register_prepared"]

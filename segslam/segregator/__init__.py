"""Segregator: global registration of two labelled scans from semantic clusters and point features."""

from segslam.segregator.describe import describe
from segslam.segregator.match import hypotheses, match

__all__ = ["describe", "hypotheses", "match"]

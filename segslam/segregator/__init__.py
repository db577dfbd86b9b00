"""Segregator: global registration of two labelled scans from semantic clusters and point features."""

from segslam.segregator.describe import describe

__all__ = ["describe"]

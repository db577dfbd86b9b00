"""Segregator: global registration of two labelled scans from semantic clusters and point features."""

from segslam.registration.segregator.describe import describe
from segslam.registration.segregator.match import hypotheses, match, vertical
from segslam.registration.segregator.plan import FloorPlan, plan_hypotheses

__all__ = ["FloorPlan", "describe", "hypotheses", "match", "plan_hypotheses", "vertical"]

"""Registration of two scans: describe and prepare each scan once, then match, refine and verify the pair."""

from segslam.registration.pair import register, register_near, register_prepared
from segslam.registration.prepared import Labeller, PreparedScan, prepare_observed, prepare_scan, shape_labels
from segslam.registration.stopwatch import Stopwatch
from segslam.registration.trial import Gate, anywhere

__all__ = [
    "Gate",
    "Labeller",
    "PreparedScan",
    "Stopwatch",
    "anywhere",
    "prepare_observed",
    "prepare_scan",
    "register",
    "register_near",
    "register_prepared",
    "shape_labels",
]

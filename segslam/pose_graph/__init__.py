"""The pose graph: the only room that knows GTSAM."""

from segslam.pose_graph.batch import Optimized, Robust, optimize_graph
from segslam.pose_graph.drift import angles_along, judge
from segslam.pose_graph.g2o import G2oGraph, read_g2o, write_g2o
from segslam.pose_graph.graph import PoseGraph

__all__ = [
    "G2oGraph",
    "Optimized",
    "PoseGraph",
    "Robust",
    "angles_along",
    "judge",
    "optimize_graph",
    "read_g2o",
    "write_g2o",
]

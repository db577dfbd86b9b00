"""The pose graph: the only package that imports GTSAM."""

from segslam.pose_graph.batch import Optimized, Robust, optimize_graph
from segslam.pose_graph.g2o import G2oGraph, read_g2o, write_g2o
from segslam.pose_graph.graph import PoseGraph
from segslam.pose_graph.protocol import Graph

__all__ = [
    "G2oGraph",
    "Graph",
    "Optimized",
    "PoseGraph",
    "Robust",
    "optimize_graph",
    "read_g2o",
    "write_g2o",
]

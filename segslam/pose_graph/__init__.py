"""The pose graph: the only package that imports GTSAM."""

from segslam.pose_graph.batch import Optimized, Robust, optimize_graph
from segslam.pose_graph.edges import Edge
from segslam.pose_graph.g2o import G2oGraph, read_g2o, write_g2o
from segslam.pose_graph.graph import PoseGraph
from segslam.pose_graph.levenberg_marquardt import Unsolvable
from segslam.pose_graph.position_fixes import PositionedGraph
from segslam.pose_graph.protocol import Graph

__all__ = [
    "Edge",
    "G2oGraph",
    "Graph",
    "Optimized",
    "PoseGraph",
    "PositionedGraph",
    "Robust",
    "Unsolvable",
    "optimize_graph",
    "read_g2o",
    "write_g2o",
]

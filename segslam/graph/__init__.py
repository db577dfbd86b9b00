"""The pose graph: the only package that imports GTSAM."""

from segslam.graph.batch import Optimized, Robust, optimize_graph
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph, read_g2o, write_g2o
from segslam.graph.graph import PoseGraph
from segslam.graph.levenberg_marquardt import Unsolvable
from segslam.graph.position_fixes import PositionedGraph
from segslam.graph.protocol import Graph

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

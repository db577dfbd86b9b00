"""The pose graph: the only package that imports GTSAM."""

from segslam.graph.anchored import AnchoredGraph
from segslam.graph.batch import Optimized, Robust, optimize_graph
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph, read_g2o, write_g2o
from segslam.graph.graph import PoseGraph
from segslam.graph.levenberg_marquardt import Unsolvable
from segslam.graph.position_fixes import PositionedGraph

Graph = PoseGraph | AnchoredGraph
"""The graph of a drive: in its own frame, or in that of an existing map."""

__all__ = [
    "AnchoredGraph",
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

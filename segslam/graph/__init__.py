"""The pose graph: the only package that imports GTSAM."""

from segslam.graph.anchored import AnchoredGraph
from segslam.graph.edges import Edge
from segslam.graph.graph import PoseGraph

Graph = PoseGraph | AnchoredGraph
"""The graph of a drive: in its own frame, or in that of an existing map."""

__all__ = ["AnchoredGraph", "Edge", "Graph", "PoseGraph"]

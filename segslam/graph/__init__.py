"""The pose graph: the only package that imports GTSAM."""

from segslam.graph.anchored import AnchoredGraph
from segslam.graph.edges import Edge
from segslam.graph.graph import PoseGraph

__all__ = ["AnchoredGraph", "Edge", "PoseGraph"]

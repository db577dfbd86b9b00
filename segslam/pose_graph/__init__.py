"""The pose graph: the only room that knows GTSAM."""

from segslam.pose_graph.graph import PoseGraph

__all__ = ["PoseGraph"]

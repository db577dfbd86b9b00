"""Where labels come from."""

from segslam.semantics.geometric import geometric_labels

__all__ = ["geometric_labels"]

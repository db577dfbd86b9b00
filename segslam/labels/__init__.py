"""Point labels from files, from geometry or from a neural network."""

from segslam.labels.geometric import geometric_labels

__all__ = ["geometric_labels"]

"""`segslam simulate`."""


def simulate() -> None:
    """Write a simulated KITTI-format sequence."""

"""KISS-ICP in this process, with the interface of one in a process of its own, which takes a second to start."""

from segslam.odometry.kiss import KissOdometry


class OdometryHere(KissOdometry):
    """In place of `OdometryApart` where the process is not what is tested."""

    def __enter__(self) -> "OdometryHere":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """No effect: there is no process."""

"""Senders of scans: into a folder, or to a ROS 2 topic."""

from array import array
from collections import deque
from pathlib import Path
from time import sleep

import numpy as np

from tools.benchmarks.faults.files import write_whole


class FolderSender:
    """Writes .bin files named by their stamp in ns, and the times.txt that an offline run of the folder needs."""

    def __init__(self, folder: Path, *, keeps: int | None = None) -> None:
        """Only the last `keeps` files are kept, unless it is None."""
        folder.mkdir()
        self._folder = folder
        self._keeps = keeps
        self._files: deque[Path] = deque()

    def wait_for_listener(self) -> None:
        """No receiver to wait for."""

    def send(self, points: np.ndarray, stamp_ns: int) -> None:
        """Write a scan."""
        rows = np.column_stack([points, np.linalg.norm(points, axis=1)])
        self._files.append(write_whole(self._folder, rows, f"{stamp_ns:019d}.bin"))
        if self._keeps is not None and len(self._files) > self._keeps:
            self._files.popleft().unlink()
        with (self._folder / "times.txt").open("a") as stream:
            stream.write(f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}\n")


class RosSender:
    """Publishes PointCloud2 messages of 16 bytes a point, stamped when they are sent."""

    def __init__(self, topic: str, reliability: str) -> None:
        import rclpy
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import PointCloud2, PointField

        rclpy.init()
        self._node = rclpy.create_node("bench")
        profile = QoSProfile(depth=5, reliability=ReliabilityPolicy[reliability.upper()])
        self._publisher = self._node.create_publisher(PointCloud2, topic, profile)
        self._message = PointCloud2(height=1, point_step=16)
        self._message.header.frame_id = "lidar"
        self._message.fields = [
            PointField(name=axis, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, axis in enumerate("xyz")
        ]

    def wait_for_listener(self) -> None:
        """Until segslam has subscribed."""
        while self._publisher.get_subscription_count() == 0:
            sleep(0.05)
        sleep(0.5)

    def send(self, points: np.ndarray, stamp_ns: int) -> None:
        """Publish a scan."""
        rows = np.zeros((len(points), 4), "<f4")
        rows[:, :3] = points
        message = self._message
        message.width, message.row_step, message.data = len(rows), rows.nbytes, array("B", rows.tobytes())
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

"""A robot on ROS 2 for tests: `python -m helpers.ros_robot` publishes clouds of a simulated drive, until it is killed.

Arguments: scans as .npz, seconds between two clouds, `reliable` or `best_effort`, numbers of the first scan and the
end. If the .npz has `places` (latitude, longitude, height of each scan), they are published as fixes.
"""

import sys
from array import array
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import NavSatFix, NavSatStatus, PointCloud2, PointField

TOPIC, FIXES = "/test/points", "/test/fix"
FIELDS = [PointField(name=axis, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, axis in enumerate("xyz")]


def publish(points: Path, every_s: float, reliability: str, first: int, last: int) -> None:
    """Publish the clouds in a loop as soon as there is a subscriber."""
    clouds = np.load(points)
    rclpy.init()
    node = rclpy.create_node("robot")
    profile = QoSProfile(depth=5, reliability=ReliabilityPolicy[reliability.upper()])
    publisher = node.create_publisher(PointCloud2, TOPIC, profile)
    fixes = node.create_publisher(NavSatFix, FIXES, profile)
    while publisher.get_subscription_count() == 0:
        sleep(0.05)
    sleep(1.0)
    next_s = monotonic()
    for number in range(first, last):
        rows = clouds[f"arr_{number % len(clouds)}"].astype("<f4")
        message = PointCloud2(height=1, width=len(rows), point_step=12, row_step=rows.nbytes, fields=FIELDS)
        message.header.frame_id = "lidar_top"
        message.header.stamp = node.get_clock().now().to_msg()
        message.data = array("B", rows.tobytes())
        if "places" in clouds:
            latitude, longitude, height_m = clouds["places"][number].tolist()
            fix = NavSatFix(latitude=latitude, longitude=longitude, altitude=height_m)
            fix.status.status = NavSatStatus.STATUS_FIX
            fix.header.stamp = message.header.stamp
            fixes.publish(fix)
        publisher.publish(message)
        print(number, flush=True)
        next_s += every_s
        sleep(max(0.0, next_s - monotonic()))
    sleep(2.0)


if __name__ == "__main__":
    publish(Path(sys.argv[1]), float(sys.argv[2]), sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))

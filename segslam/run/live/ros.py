"""ROS 2 node: point clouds in; odometry, path and map out. No other module imports rclpy."""

from array import array
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path as FilePath
from threading import Event, Thread
from time import monotonic
from typing import Any, TypeVar

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.context import Context
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from rclpy.validate_full_topic_name import validate_full_topic_name
from scipy.spatial.transform import Rotation as ScipyRotation
from sensor_msgs.msg import NavSatFix, PointCloud2, PointField
from std_msgs.msg import Header

from segslam.core import geometry
from segslam.core.errors import brief
from segslam.core.types import BadScan, Labels, Points, Scan, SegslamError, Step, Transform
from segslam.gnss.fixes import Row
from segslam.gnss.reading import row_of
from segslam.run.live.live_map import DrawnMap
from segslam.run.live.waiting import Arrival, Source, Waiting
from segslam.scans.decoding import CLOUD
from segslam.scans.point_cloud2 import read_message, stamp_ns_of

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # tf2_msgs is not on PyPI
    TFMessage = None
try:
    from std_srvs.srv import Trigger
except ImportError:  # a minimal installation
    Trigger = None

SpunNode = TypeVar("SpunNode", bound="_Spun")
NAMESPACE = "segslam"
ODOM, MAP = "odom", "map"
"""Frames, as in REP 105."""
DEPTH = 10
"""Chosen: number of clouds that the middleware keeps while Python is busy, about 20 MB."""
LOOK_EVERY_S = 0.5
"""Interval of the search for publishers, which may come, go, and change their reliability."""
PATIENCE_S = 5.0
"""Time without a publisher after which the available point cloud topics are listed."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Late subscribers receive the last message."""


class TopicSource(Source):
    """The clouds of a topic; each pose is published as nav_msgs/Odometry, with the stamp of its cloud.

    The reliability of the publisher is copied: a reliable subscription does not receive from a best-effort publisher,
    and a best-effort subscription may lose large clouds of a reliable publisher. With the parameter `paused`, arriving
    clouds are ignored.
    """

    def __init__(self, topic: str, **options: Any) -> None:
        """`options` as for `Source`. Raises SegslamError for an invalid topic name. A missing first slash is added."""
        self._topic = topic if topic.startswith("/") else f"/{topic}"
        super().__init__(f"live{self._topic}", **options)
        _check_topic(self._topic, f"--topic {topic}", "`ros2 topic list` shows the topics")
        self._is_paused = False
        self._lidar_frame = "lidar"
        self._reliability: ReliabilityPolicy | None = None
        self._subscription: Any = None
        self._context: Any = None

    def open(self, tell: Callable[[str], None]) -> None:
        """Start the node `/segslam/odometry`."""
        self._tell = tell
        self._context, self._node = start_node("odometry")
        self._node.declare_parameter("paused", False)
        self._node.add_on_set_parameters_callback(self._set_parameters)
        self._odometry = self._node.create_publisher(Odometry, f"/{NAMESPACE}/odometry", DEPTH)
        self._transforms = self._node.create_publisher(TFMessage, "/tf", 100) if TFMessage else None
        if TFMessage is None:
            tell("no transforms on /tf: tf2_msgs is not installed (it comes with a ROS installation, not from PyPI)")

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Put the clouds of all publishers, until `stopped` is set."""
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self._node)
        started, next_look, has_listed = monotonic(), 0.0, False
        with suppress(ExternalShutdownException):
            while not stopped.is_set():
                if monotonic() >= next_look:
                    self._follow_publishers(waiting)
                    next_look = monotonic() + LOOK_EVERY_S
                if self._subscription is None and not has_listed and monotonic() > started + PATIENCE_S:
                    self._tell(f"{self._topic}: no publisher yet; {self._other_topics()}")
                    has_listed = True
                executor.spin_once(timeout_sec=0.1)
            executor.shutdown()
            return ""
        return "ROS was shut down"

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """Publish the pose of a cloud."""
        message = Odometry(header=_header(ODOM, arrival.sent_ns), child_frame_id=self._lidar_frame)
        message.pose.pose = _pose(T_odom_lidar)
        self._odometry.publish(message)
        if self._transforms:
            transform = _transform(T_odom_lidar, parent=ODOM, child=self._lidar_frame, stamp_ns=arrival.sent_ns)
            self._transforms.publish(TFMessage(transforms=[transform]))

    def close(self) -> None:
        """Destroy the node."""
        if self._context is not None:
            self._node.destroy_node()
            self._context.try_shutdown()

    def _follow_publishers(self, waiting: Waiting) -> None:
        """Subscribe with the reliability of the publishers, best effort if any is; again if it has changed."""
        publishers = [info for info in self._node.get_publishers_info_by_topic(self._topic) if info.topic_type == CLOUD]
        if not publishers:
            return
        offered = {info.qos_profile.reliability for info in publishers}
        best_effort = ReliabilityPolicy.BEST_EFFORT
        wanted = best_effort if best_effort in offered else ReliabilityPolicy.RELIABLE
        if wanted == self._reliability:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._reliability = wanted
        profile = QoSProfile(depth=DEPTH, reliability=wanted)
        self._subscription = self._node.create_subscription(
            PointCloud2, self._topic, lambda message: self._put(message, waiting), profile
        )
        kind = "best effort, so clouds can be lost" if wanted == best_effort else "reliable"
        self._tell(f"{self._topic}: subscribed ({kind})")

    def _other_topics(self) -> str:
        names = [name for name, types in self._node.get_topic_names_and_types() if CLOUD in types]
        others = sorted(set(names) - {self._topic, f"/{NAMESPACE}/map"})
        if others:
            return f"point clouds are on {', '.join(others)}"
        return "no topic has point clouds; is ROS_DOMAIN_ID the same on both sides?"

    def _put(self, message: PointCloud2, waiting: Waiting) -> None:
        if self._is_paused:
            return
        self._lidar_frame = message.header.frame_id or self._lidar_frame
        sent_ns = stamp_ns_of(message) or self._node.get_clock().now().nanoseconds
        waiting.put(sent_ns, lambda index, stamp_ns: self._read(message, index, stamp_ns))

    def _read(self, message: PointCloud2, index: int, stamp_ns: int) -> Scan:
        try:
            cloud = read_message(message)
        except (KeyError, TypeError, ValueError) as error:
            raise BadScan(f"{self._topic}: cloud {index} cannot be read ({error!r})") from error
        return self._scan(FilePath(self._topic), index, stamp_ns, cloud)

    def _set_parameters(self, parameters: list[Any]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "paused":
                if parameter.type_ != Parameter.Type.BOOL:
                    return SetParametersResult(successful=False, reason="paused: give true or false")
                self._is_paused = bool(parameter.value)
                self._tell(f"{self._topic}: {'paused' if self._is_paused else 'running'}")
        return SetParametersResult(successful=True)


class _Spun:
    """A node that is served in a thread of its own while the context manager is open."""

    def __init__(self, name: str) -> None:
        self._context, self._node = start_node(name)
        self._thread = Thread(target=self._spin, name=name, daemon=True)

    def __enter__(self: SpunNode) -> SpunNode:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._context.try_shutdown()
        self._thread.join()
        self._node.destroy_node()

    def _spin(self) -> None:
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self._node)
        with suppress(ExternalShutdownException):
            executor.spin()


class MappingPublisher(_Spun):
    """The node `/segslam/mapping`: publishes corrected path, map and the transform map -> odom; a context manager.

    Its service `/segslam/save_map` (std_srvs/Trigger) calls `save`.
    """

    def __init__(self, save: Callable[[], str]) -> None:
        """`save` writes the map so far and returns a message; it raises SegslamError or OSError if it cannot."""
        super().__init__("mapping")
        self._save = save
        if Trigger is not None:
            self._node.create_service(Trigger, f"/{NAMESPACE}/save_map", self._save_map)
        self._path = self._node.create_publisher(Path, f"/{NAMESPACE}/path", LATCHED)
        self._map = self._node.create_publisher(PointCloud2, f"/{NAMESPACE}/map", LATCHED)
        self._correction = self._node.create_publisher(TransformStamped, f"/{NAMESPACE}/map_to_odom", LATCHED)
        self._transforms = self._node.create_publisher(TFMessage, "/tf", 100) if TFMessage else None
        self._T_map_odom = np.eye(4)

    def note_step(self, step: Step) -> None:
        """Publish `map -> odom` after an optimisation, and on /tf at every step."""
        estimate, keyframe = step.estimate, step.keyframe
        if estimate is not None and keyframe is not None:
            last = max(estimate.T_world_keyframe)
            self._T_map_odom = estimate.T_world_keyframe[last] @ geometry.inverse(keyframe.T_odom_keyframe)
        if estimate is None and self._transforms is None:
            return
        transform = _transform(self._T_map_odom, parent=MAP, child=ODOM, stamp_ns=step.stamp_ns)
        if estimate is not None:
            self._correction.publish(transform)
        if self._transforms:
            self._transforms.publish(TFMessage(transforms=[transform]))

    def show_map(self, drawn: DrawnMap) -> None:
        """Publish a map and the path of its keyframes."""
        header = _header(MAP, drawn.stamp_ns)
        poses = [PoseStamped(header=header, pose=_pose(T)) for T in drawn.T_world_keyframe.values()]
        self._path.publish(Path(header=header, poses=poses))
        self._map.publish(point_cloud2(drawn.points, drawn.labels, frame=MAP, stamp_ns=drawn.stamp_ns))

    def _save_map(self, _: Any, response: Any) -> Any:
        try:
            response.success, response.message = True, self._save()
        except (SegslamError, OSError) as error:
            response.success, response.message = False, str(error)
        return response


class FixTopic(_Spun):
    """Collects the position fixes of a topic, sensor_msgs/NavSatFix, in its own thread; a context manager."""

    def __init__(self, topic: str) -> None:
        """Raises SegslamError for an invalid topic name."""
        self.rows: list[Row] = []
        _check_topic(topic, f"--gnss {topic}", "give it as in --gnss /fix")
        super().__init__("gnss")
        profile = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)  # receives from both kinds
        self._node.create_subscription(NavSatFix, topic, lambda message: self.rows.append(row_of(message)), profile)


def _check_topic(topic: str, option: str, remedy: str) -> None:
    try:
        validate_full_topic_name(topic)
    except (InvalidTopicNameException, ValueError) as error:
        raise SegslamError(f"{option}: not a topic name ({brief(str(error))}); {remedy}") from error


def start_node(name: str) -> tuple[Any, Any]:
    """A node in its own context, which leaves Ctrl-C to the command."""
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    return context, Node(name, namespace=NAMESPACE, context=context)


def point_cloud2(points: Points, labels: Labels, *, frame: str, stamp_ns: int) -> PointCloud2:
    """A cloud with the fields x, y, z (float32) and label (uint8)."""
    rows = np.empty(len(points), np.dtype([("xyz", "<f4", 3), ("label", "u1")]))
    rows["xyz"], rows["label"] = points, labels
    message = PointCloud2(header=_header(frame, stamp_ns), height=1, width=len(rows), is_dense=True)
    message.point_step, message.row_step = rows.itemsize, rows.nbytes
    message.fields = [
        PointField(name=axis, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, axis in enumerate("xyz")
    ]
    message.fields.append(PointField(name="label", offset=12, datatype=PointField.UINT8, count=1))
    message.data = array("B", rows.tobytes())
    return message


def _transform(T_parent_child: Transform, *, parent: str, child: str, stamp_ns: int) -> TransformStamped:
    message = TransformStamped(header=_header(parent, stamp_ns), child_frame_id=child)
    message.transform.translation = Vector3(**_xyz(T_parent_child))
    message.transform.rotation = _quaternion(T_parent_child)
    return message


def _pose(T_a_b: Transform) -> Pose:
    return Pose(position=Point(**_xyz(T_a_b)), orientation=_quaternion(T_a_b))


def _xyz(T_a_b: Transform) -> dict[str, float]:
    return dict(zip("xyz", T_a_b[:3, 3].tolist(), strict=True))


def _quaternion(T_a_b: Transform) -> Quaternion:
    return Quaternion(**dict(zip("xyzw", ScipyRotation.from_matrix(T_a_b[:3, :3]).as_quat().tolist(), strict=True)))


def _header(frame: str, stamp_ns: int) -> Header:
    return Header(frame_id=frame, stamp=Time(nanoseconds=stamp_ns).to_msg())

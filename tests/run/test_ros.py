"""ROS 2 over loopback: a robot in one process, `segslam live --topic` in another, and a subscriber in this one."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic, time_ns
from typing import Any

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import round_drive
from helpers.gnss_drive import ORIGIN, T_ENU_MAP
from helpers.live_command import LiveCommand

pytest.importorskip("rclpy", reason="no rclpy: source a ROS 2 installation, or pip install '.[ros]'")

import rclpy
from geometry_msgs.msg import TransformStamped
from helpers.ros_robot import FIXES, TOPIC
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from segslam.core import geometry
from segslam.core.types import SegslamError
from segslam.gnss import enu_from_geodetic, geodetic_from_enu
from segslam.output.log import read_log
from segslam.run.live.live_map import DrawnMap
from segslam.run.live.ros import LATCHED, MappingPublisher, TopicSource, point_cloud2
from segslam.scans.point_cloud2 import read_message

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = ("--set", "odometry.min_range_m=1")


@pytest.fixture(autouse=True)
def own_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A separate ROS domain, on this machine only."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("clouds") / "clouds.npz"
    np.savez(file, *[scan.points for scan in round_drive()[0][:12]])
    return file


class Listener:
    """Subscribes to what segslam publishes; a context manager."""

    def __init__(self) -> None:
        self._context = rclpy.context.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("listener", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.heard: dict[str, list[Any]] = {"odometry": [], "path": [], "map": [], "map_to_odom": []}
        for kind, name, profile in (
            (Odometry, "odometry", 100),
            (PathMessage, "path", LATCHED),
            (PointCloud2, "map", LATCHED),
            (TransformStamped, "map_to_odom", LATCHED),
        ):
            self._node.create_subscription(kind, f"/segslam/{name}", self.heard[name].append, profile)

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()

    def spin_until(self, condition: Callable[[], object], seconds: float = 120.0) -> None:
        """`seconds`: a hang; a busy machine takes a minute to start the processes."""
        end = monotonic() + seconds
        while not condition():
            assert monotonic() < end, {name: len(messages) for name, messages in self.heard.items()}
            self._executor.spin_once(timeout_sec=0.05)

    def call_save_map(self) -> Any:
        """The answer of the service."""
        client = self._node.create_client(Trigger, "/segslam/save_map")
        self.spin_until(client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.spin_until(answer.done)
        return answer.result()

    def num_poses_since(self, time_ns: int) -> int:
        """Poses heard whose scans were published after this time."""
        return sum(stamp_ns(message) > time_ns for message in self.heard["odometry"])


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


@pytest.fixture
def listener() -> Iterator[Listener]:
    with Listener() as listening:
        yield listening


def robot(clouds: Path, *, every_s: float, reliability: str, first: int, last: int) -> "subprocess.Popen[str]":
    words = [sys.executable, "-m", "helpers.ros_robot", str(clouds), str(every_s), reliability, str(first), str(last)]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)


@pytest.mark.slow
def test_a_publisher_is_followed_through_its_death_and_every_cloud_accounted_for(
    clouds: Path, tmp_path: Path, listener: Listener
) -> None:
    """The second publisher is best effort; a reliable subscription would not receive from it."""
    with LiveCommand("--topic", TOPIC, "--out", tmp_path / "run", *SETTINGS) as command:
        command.wait_for("waiting for scans")
        sent = 0
        for reliability, first in (("reliable", 0), ("best_effort", 6)):
            started_ns = time_ns()
            publishing = robot(clouds, every_s=0.6, reliability=reliability, first=first, last=10**6)
            assert publishing.stdout
            for _ in range(6):
                publishing.stdout.readline()
            listener.spin_until(lambda started_ns=started_ns: listener.num_poses_since(started_ns) >= 2)
            publishing.kill()
            sent += 6 + len(publishing.communicate()[0].splitlines())
        listener.spin_until(lambda: listener.heard["path"] and listener.heard["map"])
        saved = listener.call_save_map()
        command.signal(signal.SIGINT)
        status, metrics = command.ended()
    assert status == 0, command.output
    assert command.output.count("subscribed (") == 2, command.output
    assert metrics["num_scans_arrived"] == metrics["num_scans"] + metrics["num_scans_dropped"]
    assert 4 <= metrics["num_scans_arrived"] <= sent
    assert metrics["num_gaps"] >= 1  # between the two publishers
    assert saved.success, saved.message
    assert saved.message.startswith(f"{tmp_path / 'run' / 'map_so_far.ply'}: ")
    assert (tmp_path / "run" / "map_so_far.ply").read_bytes().startswith(b"ply")
    odometry = listener.heard["odometry"]
    assert (odometry[0].header.frame_id, odometry[0].child_frame_id) == ("odom", "lidar_top")
    published = [stamp_ns(message) for message in odometry]
    recorded = [step.stamp_ns for step in read_log(tmp_path / "run" / "log.mcap").steps()]
    assert set(published) <= set(recorded)
    assert listener.heard["path"][-1].header.frame_id == "map"
    points = read_message(listener.heard["map"][-1]).points
    assert len(points) > 1000


@pytest.mark.slow
def test_a_live_run_is_placed_by_the_fixes_of_a_topic(tmp_path: Path) -> None:
    scans, truth = round_drive()
    enu_m = geometry.apply(T_ENU_MAP, truth.T_world_lidar[:12, :3, 3])
    file = tmp_path / "clouds.npz"
    np.savez(file, *[scan.points for scan in scans[:12]], places=geodetic_from_enu(enu_m, ORIGIN))
    out = tmp_path / "run"
    with LiveCommand("--topic", TOPIC, "--gnss", FIXES, "--out", out, *SETTINGS) as command:
        command.wait_for("waiting for scans")
        publishing = robot(file, every_s=0.6, reliability="best_effort", first=0, last=12)
        publishing.communicate(timeout=120)
        command.signal(signal.SIGINT)
        status, metrics = command.ended()
    assert status == 0, command.output
    assert metrics["gnss_kept"] >= 10, command.output
    rows = np.loadtxt(out / "poses_geodetic.csv", delimiter=",", skiprows=1)
    distance_m, _ = cKDTree(enu_m[:, :2]).query(enu_from_geodetic(rows[:, 1:4], ORIGIN)[:, :2])
    assert distance_m.max() < 0.5, "some clouds may be dropped on a busy machine"
    assert read_log(out / "log.mcap").result() is not None


def test_a_wrong_topic_of_fixes_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("live", "--topic", TOPIC, "--gnss", "no topic", "--out", tmp_path / "run") == 2
    assert "--gnss no topic: not a topic name" in capsys.readouterr().err


def test_a_pose_and_a_map_are_published_as_they_are(listener: Listener) -> None:
    turned = np.array([[0.0, -1, 0, 3], [1, 0, 0, 2], [0, 0, 1, 1], [0, 0, 0, 1]])
    with MappingPublisher(lambda: "") as publisher:
        drawn = DrawnMap(np.full((4, 3), 1.5), np.full(4, 9, np.uint8), {0: np.eye(4), 1: turned}, 3_000_000_007)
        publisher.show_map(drawn)
        listener.spin_until(lambda: listener.heard["path"] and listener.heard["map"])
    (path,), (cloud,) = listener.heard["path"], listener.heard["map"]
    assert (path.header.stamp.sec, path.header.stamp.nanosec) == (3, 7)
    pose = path.poses[1].pose
    assert [pose.position.x, pose.position.y, pose.position.z] == [3, 2, 1]
    assert [pose.orientation.z, pose.orientation.w] == pytest.approx([np.sqrt(0.5)] * 2)
    np.testing.assert_array_equal(read_message(cloud).points, drawn.points)


def test_a_map_that_cannot_be_saved_is_reported_with_the_reason(listener: Listener) -> None:
    def save() -> str:
        raise SegslamError("there is no keyframe yet")

    with MappingPublisher(save):
        answer = listener.call_save_map()
    assert (answer.success, answer.message) == (False, "there is no keyframe yet")


def test_a_cloud_is_read_as_it_was_sent() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    message = point_cloud2(points, np.zeros(50, np.uint8), frame="lidar", stamp_ns=5)
    scan = TopicSource("/points")._read(message, 3, 5)
    np.testing.assert_array_equal(scan.points, points)
    assert (scan.index, scan.stamp_ns) == (3, 5)


def test_a_topic_is_named_from_the_root_and_checked() -> None:
    assert TopicSource("points").name == TopicSource("/points").name == "live/points"
    with pytest.raises(SegslamError, match="--topic bad topic!: not a topic name"):
        TopicSource("bad topic!")


def test_a_source_that_is_paused_takes_no_cloud() -> None:
    from rclpy.parameter import Parameter

    from segslam.run.live.waiting import Waiting

    output: list[str] = []
    source, waiting = TopicSource("/points"), Waiting()
    source.open(output.append)
    try:
        message = point_cloud2(np.ones((2, 3)), np.zeros(2, np.uint8), frame="lidar", stamp_ns=5)
        for value in (True, False):
            (result,) = source._node.set_parameters([Parameter("paused", value=value)])
            assert result.successful
            source._put(message, waiting)
        (refused,) = source._node.set_parameters([Parameter("paused", value="yes")])
    finally:
        source.close()
    assert not refused.successful
    assert waiting.tally.num_arrived == 1
    assert output[-2:] == ["/points: paused", "/points: running"]


@pytest.mark.parametrize("sources", [(), ("--topic", "/points", ".")])
def test_a_live_run_has_one_source(
    sources: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("live", *sources, "--out", tmp_path / "run", "--quiet") == 2
    assert "give one source" in capsys.readouterr().err

"""Benchmark of live runs: latency, lag, memory, dropped scans, and comparison with an offline run.

python -m tools.benchmarks.live SCANS --out DIR --every 0.5                      a folder that fills, each scan once
python -m tools.benchmarks.live SCANS --out DIR --every 0.5 --offline            and the same scans by `segslam map`
python -m tools.benchmarks.live SCANS --out DIR --every 0.1 --seconds 60 --ros reliable      a ROS 2 topic, on loopback
python -m tools.benchmarks.live SCANS --out DIR --every 1 --seconds 3600     the hour: latency and memory must be flat

With --seconds the scans are sent forwards and backwards until the time is over. Figures go to DIR/bench.json.
"""

import csv
import json
import os
import signal
import subprocess
import sys
from array import array
from collections import deque
from itertools import cycle, islice
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np

from segslam.core.evaluation import pose_errors
from segslam.core.memory import status_mb
from segslam.core.trajectory import rows_of_same_stamp
from segslam.output.finished import read_run
from segslam.output.log import read_log
from segslam.scans import Dataset, open_dataset
from tools.benchmarks import common
from tools.benchmarks.faults.files import write_whole

TOPIC = "/segslam_bench/points"
SAMPLE_S = 5.0
OWN_DOMAIN = {"ROS_DOMAIN_ID": "87", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOCALHOST_ONLY": "1"}


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

    def __init__(self, reliability: str) -> None:
        import rclpy
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import PointCloud2, PointField

        rclpy.init()
        self._node = rclpy.create_node("bench")
        profile = QoSProfile(depth=5, reliability=ReliabilityPolicy[reliability.upper()])
        self._publisher = self._node.create_publisher(PointCloud2, TOPIC, profile)
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


def rss_mb(pid: int) -> float:
    """Memory of a process and of all that it has started."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return (status_mb("VmRSS", pid) or 0.0) + sum(rss_mb(int(child)) for child in children)


def run_live(
    dataset: Dataset, sender: FolderSender | RosSender, words: list[str], every_s: float, seconds: float | None
) -> Any:
    """Exit status, figures, (seconds, MB) of the memory, and how many scans were sent."""
    command = [sys.executable, "-m", "segslam", "live", *words, "--json"]
    live = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert live.stderr
    while "waiting for scans" not in (line := live.stderr.readline()):
        assert line, "segslam live has ended"
        print(line, end="", file=sys.stderr)
    sender.wait_for_listener()
    num_sent, memory, started = 0, [], monotonic()
    next_s, next_sample = started, started
    rows = list(range(len(dataset)))
    if seconds is not None:  # forwards and backwards
        rows = list(islice(cycle(rows + rows[-2:0:-1]), int(seconds / every_s)))
    for row in rows:
        scan = dataset[row]
        sleep(max(0.0, next_s - monotonic()))
        stamp_ns = scan.stamp_ns if seconds is None else int(num_sent * every_s * 1e9)
        sender.send(scan.points, stamp_ns)
        num_sent += 1
        next_s += every_s
        if monotonic() >= next_sample and live.poll() is None:
            memory.append((monotonic() - started, rss_mb(live.pid)))
            next_sample += SAMPLE_S
    sleep(3.0)
    live.send_signal(signal.SIGTERM)  # a script's background job ignores SIGINT
    printed, told = live.communicate()
    print(told, end="", file=sys.stderr)
    return live.returncode, json.loads(printed), memory, num_sent


def compared(live: Path, offline: Path) -> dict[str, Any]:
    """The two runs: closures that only one has, and the largest distance between poses of the same stamp."""
    closures = [closures_by_stamp(folder) for folder in (live, offline)]
    here, there = (read_run(folder).result.trajectory for folder in (live, offline))
    rows = rows_of_same_stamp(here.stamp_ns, there.stamp_ns, max_difference_ns=0)
    apart_m = pose_errors(here.T_world_lidar[rows[:, 0]], there.T_world_lidar[rows[:, 1]]).translation_m
    return {
        "num_closures": [len(found) for found in closures],
        "num_only_live": len(closures[0] - closures[1]),
        "num_only_offline": len(closures[1] - closures[0]),
        "num_poses_compared": len(rows),
        "largest_apart_m": float(apart_m.max()),
    }


def closures_by_stamp(folder: Path) -> set[tuple[int, int]]:
    """Stamps of the two keyframes of each closure."""
    log = read_log(folder / "log.mcap")
    stamps = [step.stamp_ns for step in log.steps(clouds=False) if step.keyframe is not None]
    with (folder / "loops.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["outcome"] == "accepted"]
    return {(stamps[int(row["source"])], stamps[int(row["target"])]) for row in rows}


def by_fifths(values: list[float]) -> list[float]:
    """Median of each fifth of the run."""
    return [round(float(np.median(part)), 1) for part in np.array_split(values, 5) if len(part)]


def main() -> None:
    parser = common.parser(__doc__, "live")
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--every", type=float, required=True, help="seconds between two scans")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--frames")
    parser.add_argument("--ros", choices=["reliable", "best_effort"])
    parser.add_argument("--offline", action="store_true")
    common.add_settings(parser)
    chosen = parser.parse_args()
    os.environ.update(OWN_DOMAIN)
    chosen.out.mkdir(parents=True)
    settings = [word for setting in chosen.set for word in ("--set", setting)]
    dataset = open_dataset(chosen.data, frames=chosen.frames, labels="none", vertical_angle_deg=0.0)
    sender: FolderSender | RosSender
    if chosen.ros:
        sender, source = RosSender(chosen.ros), ["--topic", TOPIC]
    else:
        scans = chosen.out / "scans"
        sender, source = FolderSender(scans, keeps=100 if chosen.seconds else None), [str(scans)]
    words = [*source, "--out", str(chosen.out / "live"), *settings]
    status, metrics, memory, num_sent = run_live(dataset, sender, words, chosen.every, chosen.seconds)
    steps = list(read_log(chosen.out / "live" / "log.mcap").steps(clouds=False))
    process_ms = [1000 * sum(s for stage, s in step.stage_seconds.items() if stage != "odometry") for step in steps]
    figures = {
        "status": status,
        "every_s": chosen.every,
        "num_sent": num_sent,
        **{key: metrics[key] for key in metrics if key.startswith(("num_", "latency", "loop_lag", "longest"))},
        "process_without_odometry_ms": common.spread(process_ms),
        "odometry_ms": metrics["stage_ms"]["odometry"],
        "odometry_ms_by_fifths": by_fifths([1000 * step.stage_seconds["odometry"] for step in steps]),
        "rss_mb_by_fifths": by_fifths([mb for _, mb in memory]),
    }
    if chosen.offline:
        command = [sys.executable, "-m", "segslam", "map", str(chosen.out / "scans"), "--labels", "geometric"]
        subprocess.run([*command, "--out", str(chosen.out / "offline"), "--preset", "driving", *settings], check=True)
        figures["against_offline"] = compared(chosen.out / "live", chosen.out / "offline")
    common.write_report(chosen.out / "bench.json", figures)
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()

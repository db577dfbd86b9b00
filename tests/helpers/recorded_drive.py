"""A simulated drive as a turning sensor sees it, and its recordings, written by others' writers."""

from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from helpers.drives import intensities, round_drive
from segslam.core import geometry
from segslam.core.types import Scan, Trajectory

CLOUD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")])
"""An Ouster's point; `t` in ns since the start of the sweep."""
KINDS = {"<f4": 7, "<u4": 6}
SWEEP_NS = 100_000_000
FIRST_STAMP_NS = 1_700_000_000_123_456_789
TOPIC, OTHER_TOPIC = "/lidar/points", "/lidar/ground"
MESSAGE = "sensor_msgs/msg/PointCloud2"
DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"""


def swept(scan: Scan, T_last_now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points as the sensor reports them that has come by `T_last_now` while it turned once, and their times, 0 to 1."""
    times = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi) + 0.5
    motion = geometry.log(T_last_now)
    points = np.empty((len(times), 3))
    for slot in np.array_split(np.argsort(times), 256):  # at most 4 cm apart: one pose each
        T_seen_now = geometry.exp((1.0 - times[slot].mean()) * motion)
        points[slot] = geometry.apply(T_seen_now, scan.points[slot])
    return points, times


Drive = tuple[tuple[int, np.ndarray], ...]
"""Stamp (ns) and CLOUD rows of each sweep."""


@cache
def clouds(num_scans: int = 30) -> tuple[tuple[int, np.ndarray], ...]:
    """Stamp and CLOUD rows of each sweep; a beam in a hundred returned nothing, which is NaN."""
    scans, truth = round_drive()
    T_last_now = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[1]
    recorded = []
    for scan in scans[:num_scans]:
        points, times = swept(scan, T_last_now)
        rows = np.zeros(len(points), CLOUD)
        rows["x"], rows["y"], rows["z"] = points.T
        rows["t"] = times * SWEEP_NS
        rows["intensity"] = intensities(points)
        for name in "xyz":
            rows[name][::100] = np.nan
        recorded.append((FIRST_STAMP_NS + SWEEP_NS * scan.index, rows[::3]))
    return tuple(recorded)


def truth(num_scans: int = 30) -> Trajectory:
    _, whole = round_drive()
    return Trajectory(*(getattr(whole, name)[:num_scans] for name in ("scan_index", "stamp_ns", "T_world_lidar")))


def write_mcap(file: Path, drive: Drive = (), *, chunk_size: int = 2**20, has_stamps: bool = True) -> Path:
    """ROS 2, with a second topic of clouds. Without stamps, only the log has them."""
    with file.open("wb") as stream, McapWriter(stream, chunk_size=chunk_size) as writer:
        schema = writer.register_msgdef(MESSAGE, DEFINITION)
        for stamp_ns, rows in drive or clouds():
            for topic in (TOPIC, OTHER_TOPIC):
                kept = rows[: None if topic == TOPIC else 10]
                writer.write_message(topic, schema, _as_dict(stamp_ns if has_stamps else 0, kept), stamp_ns)
    return file


def write_bag1(file: Path, drive: Drive = ()) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    return write_bag(file, store, MESSAGE, messages(store, drive), ros=1)


def write_bag2(folder: Path, drive: Drive = ()) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    return write_bag(folder, store, MESSAGE, messages(store, drive), ros=2)


def write_bag(path: Path, store: Any, kind: str, received: Iterable[tuple[int, Any]], *, ros: int) -> Path:
    """A bag of messages of a kind, each with the time at which it was received."""
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with Bag1Writer(path) if ros == 1 else Bag2Writer(path, version=8) as writer:
        connection = writer.add_connection(TOPIC, kind, typestore=store)
        for received_ns, message in received:
            writer.write(connection, received_ns, serialize(message, kind))
    return path


def _as_dict(stamp_ns: int, rows: np.ndarray) -> dict[str, Any]:
    fields = [
        {"name": name, "offset": offset, "datatype": KINDS[kind.str], "count": 1}
        for name, (kind, offset) in CLOUD.fields.items()
    ]
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "lidar"},
        "height": 1,
        "width": len(rows),
        "fields": fields,
        "is_bigendian": False,
        "point_step": CLOUD.itemsize,
        "row_step": rows.nbytes,
        "data": rows.tobytes(),
        "is_dense": False,
    }


def messages(store: Any, drive: Drive) -> Iterator[tuple[int, Any]]:
    """When each message was received, some time after its stamp, and the message in rosbags' types."""
    types = store.types
    more = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    for stamp_ns, rows in drive or clouds():
        values = _as_dict(stamp_ns, rows)
        stamp = types["builtin_interfaces/msg/Time"](**values["header"]["stamp"])
        values["header"] = types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar", **more)
        values["fields"] = [types["sensor_msgs/msg/PointField"](**field) for field in values["fields"]]
        values["data"] = np.frombuffer(values["data"], np.uint8)
        yield stamp_ns + 7_000_000, types[MESSAGE](**values)

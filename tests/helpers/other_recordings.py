"""Recordings in other forms: as ROS 2 Humble writes them, with Livox's own messages, and of ROS 1 in MCAP."""

import re
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from helpers.recorded_drive import MESSAGE, TOPIC, Drive, messages, write_bag, write_bag2

LIVOX = "livox_ros_driver2/msg/CustomMsg"
POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
LIVOX_MESSAGE = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""


def write_humble(folder: Path) -> Path:
    """The bag without definitions of its messages, as ROS 2 Humble and before record them."""
    write_bag2(folder)
    metadata = folder / "metadata.yaml"
    text = re.sub(r"\n *type_description_hash: *\n.*", "", metadata.read_text())
    text = re.sub(r"  (ros_distro|custom_data): .*\n", "", text)
    metadata.write_text(text.replace("version: 8", "version: 5"))
    with sqlite3.connect(next(folder.glob("*.db3"))) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
        database.execute("UPDATE schema SET schema_version = 3")
    database.close()
    return folder


def write_mcap_of_ros1(file: Path) -> Path:
    """As `mcap convert` writes a bag of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    stored = ((ns, bytes(store.serialize_ros1(message, MESSAGE))) for ns, message in messages(store, ()))
    return _write_mcap(file, stored, name="sensor_msgs/PointCloud2", encodings=("ros1msg", "ros1"))


def write_livox_bag1(file: Path, drive: Drive) -> Path:
    store = _livox_store(Stores.ROS1_NOETIC)
    return write_bag(file, store, LIVOX, _livox_messages(store, drive), ros=1)


def write_livox_bag2(folder: Path, drive: Drive) -> Path:
    store = _livox_store(Stores.ROS2_HUMBLE)
    return write_bag(folder, store, LIVOX, _livox_messages(store, drive), ros=2)


def write_livox_mcap(file: Path, drive: Drive) -> Path:
    store = _livox_store(Stores.ROS2_HUMBLE)
    stored = ((ns, bytes(store.serialize_cdr(message, LIVOX))) for ns, message in _livox_messages(store, drive))
    return _write_mcap(file, stored, name=LIVOX, encodings=("ros2msg", "cdr"))


def _write_mcap(file: Path, stored: Iterable[tuple[int, bytes]], *, name: str, encodings: tuple[str, str]) -> Path:
    with file.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        schema = writer.register_schema(name, encodings[0], b"not read")
        channel = writer.register_channel(TOPIC, encodings[1], schema)
        for log_ns, data in stored:
            writer.add_message(channel, log_ns, data, log_ns)
        writer.finish()
    return file


def _livox_store(kind: Stores) -> Any:
    store = get_typestore(kind)
    store.register(get_types_from_msg(POINT, "livox_ros_driver2/msg/CustomPoint"))
    store.register(get_types_from_msg(LIVOX_MESSAGE, LIVOX))
    return store


def _livox_messages(store: Any, drive: Drive) -> Iterator[tuple[int, Any]]:
    types = store.types
    for stamp_ns, message in messages(store, drive):
        rows = next(rows for stamp, rows in drive if stamp + 7_000_000 == stamp_ns)
        points = [
            types["livox_ros_driver2/msg/CustomPoint"](
                int(row["t"]), float(row["x"]), float(row["y"]), float(row["z"]), int(row["intensity"]), 16, 3
            )
            for row in rows
        ]
        reserved = np.zeros(3, np.uint8)
        yield stamp_ns, types[LIVOX](message.header, stamp_ns, len(rows), 1, reserved, points)

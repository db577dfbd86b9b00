"""Messages of ROS from their bytes, by definitions that need not be in the recording.

Bags of ROS 2 Humble and before contain none. The standard messages that are read here have had the same fields since
the first ROS 2; Livox's, of thousands of small records, are read as a whole.
"""

import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from segslam.core.extras import how_to_install

CLOUD = "sensor_msgs/msg/PointCloud2"
LIVOX_CLOUDS = tuple(f"{name}/msg/CustomMsg" for name in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces"))
CLOUDS = (CLOUD, *LIVOX_CLOUDS)
LIVOX_FIELDS = tuple(
    SimpleNamespace(name=name, offset=offset, datatype=datatype)
    for name, offset, datatype in (
        ("offset_time", 0, 6),
        ("x", 4, 7),
        ("y", 8, 7),
        ("z", 12, 7),
        ("reflectivity", 16, 2),
        ("tag", 17, 2),
        ("line", 18, 2),
    )
)
"""Of a Livox point; `offset_time` in ns since the stamp. Types as in sensor_msgs/PointField: uint32, float32, uint8."""


def decoder(kind: str, *, is_ros1: bool) -> Callable[[bytes], Any]:
    """The function that decodes messages of a kind, as ROS 1 or ROS 2 (CDR) stores them.

    It raises what rosbags raises for damaged bytes, or struct.error. Raises ImportError if rosbags is missing.
    """
    if kind in LIVOX_CLOUDS:
        return lambda data: livox_cloud(data, is_ros1=is_ros1)
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"reading messages of ROS needs a package: {how_to_install('recordings')}") from error
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return lambda data: decode(data, kind)


def livox_cloud(data: bytes, *, is_ros1: bool) -> Any:
    """A message of Livox's driver (`CustomMsg`) with the attributes of a PointCloud2 message.

    Raises struct.error if it ends before its points.
    """
    is_bigendian = not is_ros1 and data[1:2] == b"\0"
    order = ">" if is_bigendian else "<"
    # Both have 4 bytes first, the sequence number or the representation, after which CDR aligns numbers by their size.
    sec, nanosec, length = struct.unpack_from(f"{order}3I", data, 4)
    start = 16 + length
    if not is_ros1:
        start += (4 - start) % 8
    (num_points,) = struct.unpack_from(f"{order}16xI", data, start)  # after time, number, sensor and reserved bytes
    step = 19 if is_ros1 else 20
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec)),
        height=1,
        width=num_points,
        is_bigendian=is_bigendian,
        fields=LIVOX_FIELDS,
        point_step=step,
        row_step=step * num_points,
        data=data[start + 20 :] + bytes(step - 19),  # nothing aligns the end of the last point
    )

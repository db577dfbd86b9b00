"""Clouds of ROS's PointCloud2 messages."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from segslam.scans.clouds import from_columns
from segslam.scans.dataset import Cloud
from segslam.scans.scan_files import by_name

KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of sensor_msgs/PointField by number."""


class MessageClouds:
    """Clouds of a recording that gives the log time (ns) and the decoded message of each.

    The stamp is that in the header, or the log time if the headers have none.
    """

    def __init__(self, messages: Any) -> None:
        self._messages: Sequence[tuple[int, Any]] = messages
        self.is_sequential: bool = messages.is_sequential
        stamps_ns = []  # of the first two messages: one alone may be 0, at the start of a clock
        for index in range(min(2, len(self))):
            with suppress(Exception):  # a damaged message, which is reported when its scan is read
                stamps_ns.append(stamp_ns_of(messages[index][1]))
        self._has_stamps = any(stamps_ns) or not stamps_ns

    def __len__(self) -> int:
        return len(self._messages)

    def __getitem__(self, index: int) -> Cloud:
        """Raises what the reader raises for a damaged message."""
        log_ns, message = self._messages[index]
        cloud = read_message(message)
        return cloud if self._has_stamps else replace(cloud, stamp_ns=None, logged_ns=log_ns)


def read_message(message: Any) -> Cloud:
    """The cloud of a message. Replaces kiss_icp's function, which misaligns points and times if a cloud contains a NaN.

    Raises KeyError, TypeError or ValueError for an inconsistent message or one without x, y, z. All fields must lie in
    a point, and all points in the data, one after the other: NumPy checks neither the bounds of empty data nor those
    of large offsets, and lets points overlap.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.datatype in KINDS]
    formats = [np.dtype(order + KINDS[field.datatype]) for field in fields]
    height, width, step = message.height, message.width, message.point_step
    num_bytes = (height - 1) * message.row_step + width * step if height * width else 0
    overlap = not 0 < step < 2**31 or (height > 1 and message.row_step < width * step)
    if overlap or min(height, width) < 0 or num_bytes > len(message.data):
        raise ValueError(f"{height} x {width} points of {step} bytes do not fit into {len(message.data)} bytes of data")
    for field, kind in zip(fields, formats, strict=True):
        if not 0 <= field.offset <= step - kind.itemsize:
            raise ValueError(f"the field {field.name[:40]} at {field.offset} is not in a point of {step} bytes")
    names, offsets = [str(number) for number in range(len(fields))], [field.offset for field in fields]
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    rows = np.ndarray((height, width), dtype, buffer=message.data, strides=(message.row_step, step))
    columns = by_name((field.name, rows[name].reshape(-1)) for field, name in zip(fields, names, strict=True))
    return replace(from_columns(columns), stamp_ns=stamp_ns_of(message))


def stamp_ns_of(message: Any) -> int:
    """The stamp in the header of a message; 0 if it has none."""
    stamp = message.header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)

"""Topics, channels, frames and metadata of a log, which docs/files.md describes, and the version of this format."""

import json
import os
import platform
import re
import shlex
import sys
import zlib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap_protobuf.schema import build_file_descriptor_set

from segslam.core.config import Config, config_to_yaml
from segslam.core.extras import installed_version
from segslam.core.types import GraphEstimate, LateLoops, Step, Trajectory, Transform
from segslam.output.log.records import KeyframePoints, codec
from segslam.slam.adjustment.rounds import Adjustment

VERSION = 1
"""Increased whenever readers of the previous version would misread a log."""

STEP = "/step"
ESTIMATE = "/estimate"
MEMORY = "/memory"
RESULT = "/result"
LATE_LOOPS = "/late_loops"
ADJUSTMENT = "/adjustment"
REFERENCE = "/reference"
TRANSFORMS = "/tf"
KEYFRAME = "/keyframe"
POINTS = "/points"
MAP = "/map"
ODOMETRY = "/odometry"
TRAJECTORY = "/trajectory"
TRAJECTORY_BEFORE = "/trajectory_before"
GROUND_TRUTH = "/ground_truth"
ACCEPTED, REJECTED = "/loops/accepted", "/loops/rejected"
LOG = "/log"
GRAPH = "/graph"
FIXES, POSITIONS = "/gnss/fixes", "/gnss/positions"
WORLD, ODOM, LIDAR, ANTENNA = "world", "odom", "lidar", "antenna"
"""Frames."""

RUN_METADATA = "segslam"
CONFIG_METADATA = "segslam.config"
OPTIONS_METADATA = "segslam.options"
PACKAGES_METADATA = "segslam.packages"
CHECK_METADATA = "segslam.check"
PROTOBUF_TOPICS: dict[str, Any] = {
    TRANSFORMS: FrameTransform,
    KEYFRAME: KeyframePoints,
    POINTS: PointCloud,
    MAP: PointCloud,
    ODOMETRY: PosesInFrame,
    TRAJECTORY: PosesInFrame,
    TRAJECTORY_BEFORE: PosesInFrame,
    GROUND_TRUTH: PosesInFrame,
    LOG: Log,
    ACCEPTED: SceneUpdate,
    REJECTED: SceneUpdate,
    GRAPH: SceneUpdate,
}
CPU_INFO = Path("/proc/cpuinfo")
ESCAPED = re.compile(r"\\u(dc[89a-f][0-9a-f])")
"""A byte of a file name that is not UTF-8, as Python writes it (PEP 383)."""
PACKAGES = ("segslam", "numpy", "gtsam", "kiss-icp", "open3d", "small-gicp", "numba", "scipy", "mcap")
"""Packages whose versions a log records, because results depend on them."""


def checksum(metadata: Mapping[str, Mapping[str, str]]) -> int:
    """CRC-32 of metadata records."""
    named = {name: dict(values) for name, values in metadata.items() if name != CHECK_METADATA}
    return zlib.crc32(json.dumps(named, sort_keys=True).encode())


def json_schemas() -> dict[str, dict[str, Any]]:
    """Topic -> JSON Schema of its messages, for topics without a Foxglove schema."""
    estimate = codec(GraphEstimate).schema
    keyframe_ids = {"keyframe_ids": {"type": "array", "items": {"type": "integer"}}}
    estimate = estimate | {"properties": estimate["properties"] | keyframe_ids}
    return {
        STEP: codec(Step).schema | {"title": "segslam.Step"},
        ESTIMATE: estimate | {"title": "segslam.Estimate"},
        MEMORY: {"title": "segslam.Memory", "type": "object", "properties": {"rss_mb": {"type": "number"}}},
        RESULT: codec(Trajectory).schema | {"title": "segslam.Result"},
        ADJUSTMENT: codec(Adjustment).schema | {"title": "segslam.Adjustment"},
        LATE_LOOPS: codec(LateLoops).schema | {"title": "segslam.LateLoops"},
        REFERENCE: codec(Trajectory).schema | {"title": "segslam.Reference"},
    }


def is_readable(written: dict[str, Any], own: dict[str, Any]) -> bool:
    """True if records written with one JSON Schema contain all fields that a reader of `own` needs, with equal types.

    Fields that only the writer knows are ignored. Fields that only the reader knows are optional if they have a
    default.
    """
    if any(written.get(key) != own.get(key) for key in ("type", "description")):
        return False
    given, wanted = written.get("properties", {}), own.get("properties", {})
    if any(name not in given for name in own.get("required", ())):
        return False
    pairs = [(written.get(key, {}), own[key]) for key in ("items", "additionalProperties") if key in own]
    pairs += [(given[name], wanted[name]) for name in wanted if name in given]
    return all(is_readable(theirs, ours) for theirs, ours in pairs)


class Channel(NamedTuple):
    """A topic and the encoding of its messages."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


def channels() -> list[Channel]:
    """Every topic of a log."""
    described = ((topic, build_file_descriptor_set(kind), kind.DESCRIPTOR) for topic, kind in PROTOBUF_TOPICS.items())
    protobuf = [
        Channel(topic, "protobuf", descriptor.full_name, "protobuf", files.SerializeToString())
        for topic, files, descriptor in described
    ]
    own = [
        Channel(topic, "json", values["title"], "jsonschema", json.dumps(values).encode())
        for topic, values in json_schemas().items()
    ]
    return protobuf + own


def metadata(
    config: Config, dataset: str, T_camera_lidar: Transform | None, options: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Metadata records by name, as documented in `schema`."""
    calibration = {} if T_camera_lidar is None else {"T_camera_lidar": json.dumps(T_camera_lidar.tolist())}
    program = Path(sys.argv[0]).name
    written = {
        RUN_METADATA: {
            "schema_version": str(VERSION),
            "dataset": dataset,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": shlex.join(["segslam" if program == "__main__.py" else program, *sys.argv[1:]]),
            "processor": f"{processor()}, {os.cpu_count()} cores",
            **calibration,
        },
        CONFIG_METADATA: {"yaml": config_to_yaml(config)},
        OPTIONS_METADATA: dict(options),
        PACKAGES_METADATA: {name: installed_version(name) or "not installed" for name in PACKAGES},
    }
    records = {name: {key: _printable(text) for key, text in values.items()} for name, values in written.items()}
    return {**records, CHECK_METADATA: {"crc32": str(checksum(records))}}


def _printable(text: str) -> str:
    """The text with bytes of file names that are not UTF-8, which a log cannot hold, as escapes."""
    return text.replace(r"\udc", r"\x5cudc").encode(errors="backslashreplace").decode()


def restored(values: Mapping[str, str]) -> dict[str, str]:
    """The values of a metadata record with the bytes of which `metadata` has made escapes."""
    return {
        key: ESCAPED.sub(lambda found: chr(int(found[1], 16)), text).replace(r"\x5cudc", r"\udc")
        for key, text in values.items()
    }


def processor() -> str:
    """Name of the processor from Linux; on other systems, from Python."""
    if CPU_INFO.is_file():
        for line in CPU_INFO.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()

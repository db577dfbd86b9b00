"""Channels of a log: each topic with its encoding and schema, for a file or a live connection."""

from typing import Any, NamedTuple

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap_protobuf.schema import build_file_descriptor_set

from segslam.output.log import schema
from segslam.output.log.cloud import KeyframePoints

PROTOBUF_TOPICS: dict[str, Any] = {
    schema.TRANSFORMS: FrameTransform,
    schema.KEYFRAME: KeyframePoints,
    schema.POINTS: PointCloud,
    schema.MAP: PointCloud,
    schema.ODOMETRY: PosesInFrame,
    schema.TRAJECTORY: PosesInFrame,
    schema.TRAJECTORY_BEFORE: PosesInFrame,
    schema.GROUND_TRUTH: PosesInFrame,
    schema.LOG: Log,
    schema.ACCEPTED: SceneUpdate,
    schema.REJECTED: SceneUpdate,
    schema.GRAPH: SceneUpdate,
}


class Channel(NamedTuple):
    """A topic and the encoding of its messages."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


def channels() -> list[Channel]:
    """Every topic of a log."""
    descriptions = {
        message: build_file_descriptor_set(message).SerializeToString()
        for message in dict.fromkeys(PROTOBUF_TOPICS.values())
    }
    protobuf = [
        Channel(topic, "protobuf", message.DESCRIPTOR.full_name, "protobuf", descriptions[message])
        for topic, message in PROTOBUF_TOPICS.items()
    ]
    own = [
        Channel(topic, "json", values["title"], "jsonschema", schema.schema_text(values))
        for topic, values in schema.json_schemas().items()
    ]
    return protobuf + own

"""Conversion between records and Foxglove messages: transforms, point clouds, poses, lines."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.types import Labels, Points, Transform, Vector
from segslam.labels.encodings import of_classes
from segslam.output.log.schema import WORLD

_POINT = np.dtype([("xyz", "<f4", 3), ("label", "u1"), ("rgba", "u1", 4)])
_POINT_FIELDS = [
    *(PackedElementField(name=axis, offset=4 * k, type=PackedElementField.FLOAT32) for k, axis in enumerate("xyz")),
    *(
        PackedElementField(name=name, offset=12 + k, type=PackedElementField.UINT8)
        for k, name in enumerate(("label", "red", "green", "blue", "alpha"))
    ),
]
_IDENTITY = Pose(position=Vector3(), orientation=Quaternion(w=1.0))


def frame_transform(T_parent_child: Transform, *, parent: str, child: str, stamp_ns: int) -> FrameTransform:
    """Message with the pose of frame `child` in frame `parent`."""
    [pose] = _poses(T_parent_child[None])
    return FrameTransform(
        timestamp=timestamp(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
    )


def point_cloud(points: Points, labels: Labels, *, frame: str, stamp_ns: int) -> PointCloud:
    """Message with points as float32, their labels, and the colours of the labels."""
    rows = np.empty(len(points), _POINT)
    rows["xyz"], rows["label"] = points, labels
    rows["rgba"][:, :3], rows["rgba"][:, 3] = of_classes(labels), 255
    return PointCloud(
        timestamp=timestamp(stamp_ns),
        frame_id=frame,
        pose=_IDENTITY,
        point_stride=_POINT.itemsize,
        fields=_POINT_FIELDS,
        data=rows.tobytes(),
    )


def path(T_world_each: Iterable[Transform], *, stamp_ns: int) -> PosesInFrame:
    """Message with a path in world; `transforms` recovers its poses to float64 precision."""
    stack = np.array(list(T_world_each)).reshape(-1, 4, 4)
    return PosesInFrame(timestamp=timestamp(stamp_ns), frame_id=WORLD, poses=_poses(stack))


def transforms(poses: PosesInFrame) -> list[Transform]:
    """The poses of a path as matrices."""
    if not poses.poses:
        return []
    quaternions = [[q.x, q.y, q.z, q.w] for q in (pose.orientation for pose in poses.poses)]
    positions = [[p.x, p.y, p.z] for p in (pose.position for pose in poses.poses)]
    rotations = ScipyRotation.from_quat(quaternions).as_matrix()
    return [geometry.transform(R, t) for R, t in zip(rotations, positions, strict=True)]


def lines(
    identity: str, points: Sequence[Vector], colors: Sequence[str], metadata: Mapping[str, str], *, stamp_ns: int
) -> SceneEntity:
    """Line segments in world between pairs of points, with one colour (#rrggbbaa) per segment.

    Their width on the screen is constant. They remain until an entity of the same identity replaces them; a click shows
    the metadata.
    """
    drawn = LinePrimitive(
        type=LinePrimitive.LINE_LIST,
        thickness=2.0,
        scale_invariant=True,
        pose=_IDENTITY,
        points=[Point3(x=x, y=y, z=z) for x, y, z in np.asarray(points).tolist()],
        colors=[_color(color) for color in colors for _ in range(2)],
    )
    return SceneEntity(
        timestamp=timestamp(stamp_ns),
        frame_id=WORLD,
        id=identity,
        metadata=[KeyValuePair(key=key, value=value) for key, value in metadata.items()],
        lines=[drawn],
    )


def scene(entities: Iterable[SceneEntity], *, deleted: Iterable[str] = ()) -> SceneUpdate:
    """One message with all entities; those with the identities `deleted` disappear."""
    kind = SceneEntityDeletion.MATCHING_ID
    deletions = [SceneEntityDeletion(type=kind, id=identity) for identity in deleted]
    return SceneUpdate(entities=entities, deletions=deletions)


def _poses(T_frame_each: np.ndarray) -> list[Pose]:
    quaternions = ScipyRotation.from_matrix(T_frame_each[:, :3, :3]).as_quat().tolist()
    return [
        Pose(position=Vector3(x=tx, y=ty, z=tz), orientation=Quaternion(x=x, y=y, z=z, w=w))
        for (tx, ty, tz), (x, y, z, w) in zip(T_frame_each[:, :3, 3].tolist(), quaternions, strict=True)
    ]


def timestamp(stamp_ns: int) -> Timestamp:
    """Message with a time."""
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def _color(text: str) -> Color:
    red, green, blue, alpha = (byte / 255 for byte in bytes.fromhex(text.removeprefix("#")))
    return Color(r=red, g=green, b=blue, a=alpha)

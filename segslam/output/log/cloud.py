"""Compact encoding of all points of a keyframe, about 3 bytes per point: segslam.KeyframePoints (protobuf).

Coordinates are integer multiples of `resolution_m`. Each is stored as the difference from the previous point, which is
small because the points follow the beams; mapped to non-negative numbers (0, -1, 1, -2 become 0, 1, 2, 3); and split
into planes: the lowest byte of every x, the second byte of every x, and so on to the fourth byte of every z. Planes of
similar bytes compress well; interleaved floats do not.

Intensities, if kept, take one byte each: 255 times the square root of their ratio to the maximum of the cloud. The
noise of a photon count grows with its square root, so the relative loss is the same for weak and strong returns.
"""

import numpy as np
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message import Message

from segslam.core.types import Keyframe, Labels, Points, Vector


def _message_class() -> type[Message]:
    """Built at run time: seven fields do not justify a compiler and its version."""
    kinds = {
        "resolution_m": FieldDescriptorProto.TYPE_DOUBLE,
        "num_points": FieldDescriptorProto.TYPE_UINT32,
        "folded_difference_planes": FieldDescriptorProto.TYPE_BYTES,
        "labels": FieldDescriptorProto.TYPE_BYTES,
        "intensity_greatest": FieldDescriptorProto.TYPE_DOUBLE,
        "intensity_roots": FieldDescriptorProto.TYPE_BYTES,
        "place": FieldDescriptorProto.TYPE_BYTES,
    }
    optional = FieldDescriptorProto.LABEL_OPTIONAL
    fields = [
        FieldDescriptorProto(name=name, number=number, type=kind, label=optional)
        for number, (name, kind) in enumerate(kinds.items(), start=1)
    ]
    file = FileDescriptorProto(
        name="segslam/keyframe_points.proto",
        package="segslam",
        syntax="proto3",
        message_type=[DescriptorProto(name="KeyframePoints", field=fields)],
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("segslam.KeyframePoints"))


KeyframePoints = _message_class()


def keyframe_points(keyframe: Keyframe, *, resolution_m: float) -> Message:
    """The message of a keyframe; coordinates are rounded to multiples of `resolution_m`."""
    points = keyframe.points
    steps = np.ascontiguousarray(np.rint(points.T.astype(np.float64) / resolution_m), dtype=np.int32)
    differences = np.diff(steps, axis=1, prepend=np.int32(0))
    folded = ((differences << 1) ^ (differences >> 31)).astype("<u4", order="C")
    return KeyframePoints(
        resolution_m=resolution_m,
        num_points=len(points),
        folded_difference_planes=folded.view(np.uint8).reshape(3, -1, 4).transpose(0, 2, 1).tobytes(),
        labels=keyframe.labels.tobytes(),
        **({} if keyframe.intensities is None else _roots(keyframe.intensities)),
        **({} if keyframe.place is None else {"place": keyframe.place}),
    )


def points_and_labels(message: Message) -> tuple[Points, Labels]:
    """Points (float32) and labels as written. Raises ValueError for an inconsistent message."""
    planes = np.frombuffer(message.folded_difference_planes, np.uint8).reshape(3, 4, message.num_points)
    folded = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<u4")[..., 0]
    differences = (folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32)
    points = (np.cumsum(differences, axis=1, dtype=np.int32).T * message.resolution_m).astype(np.float32)
    return points, np.frombuffer(message.labels, np.uint8).copy()


def intensities(message: Message) -> Vector | None:
    """Intensity of each point (float32), to one byte; None if intensities were not kept."""
    if not message.intensity_roots:
        return None
    shares = (np.frombuffer(message.intensity_roots, np.uint8) / 255) ** 2
    return (message.intensity_greatest * shares).astype(np.float32)


def place_of(message: Message) -> dict[str, bytes | None]:
    """The field `place` of the keyframe; None in older logs."""
    return {"place": message.place or None}


def _roots(intensities: Vector) -> dict[str, object]:
    """The two fields; 0 for intensities that are negative or not finite."""
    known = np.maximum(np.nan_to_num(intensities.astype(np.float64), posinf=0.0), 0.0)
    greatest = known.max(initial=0.0)
    roots = np.rint(255 * np.sqrt(known / (greatest or 1.0))).astype(np.uint8)
    return {"intensity_greatest": greatest, "intensity_roots": roots.tobytes()}

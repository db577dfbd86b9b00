"""A keyframe's points, every one of them, in some 3 bytes each: segslam.KeyframePoints (protobuf).

Coordinates are whole multiples of `resolution_m`. Each is written as its difference from the point before (a scan's
points follow the beam, so they are near each other), folded to be non-negative (0, -1, 1, -2 become 0, 1, 2, 3), and
split into planes: the lowest byte of every x, the second byte of every x, and so on to the fourth byte of every z.
Bytes of one kind side by side compress well, interleaved floats do not.

Intensities, of a run that keeps them, take a byte each: 255 times the root of their share of the greatest of the cloud.
The noise of a photon count grows with its root, so no more is lost of faint returns beside a reflector than of others.
"""

import numpy as np
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message import Message

from segslam.types import Keyframe, Labels, Points, Vector


def _message_class() -> type[Message]:
    """Built here rather than generated: seven fields need no compiler, and no version of one."""
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
    """The points in their order; coordinates that are no multiples of `resolution_m` go to the nearest."""
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
    """Points (float32) and labels, as they were written. Raises ValueError if the message contradicts itself."""
    planes = np.frombuffer(message.folded_difference_planes, np.uint8).reshape(3, 4, message.num_points)
    folded = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<u4")[..., 0]
    differences = (folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32)
    points = (np.cumsum(differences, axis=1, dtype=np.int32).T * message.resolution_m).astype(np.float32)
    return points, np.frombuffer(message.labels, np.uint8).copy()


def intensities(message: Message) -> Vector | None:
    """The intensity of each point (float32), to the byte; None if they were not kept."""
    if not message.intensity_roots:
        return None
    shares = (np.frombuffer(message.intensity_roots, np.uint8) / 255) ** 2
    return (message.intensity_greatest * shares).astype(np.float32)


def place_of(message: Message) -> dict[str, bytes | None]:
    """The field `place` of the keyframe; None in logs of older versions."""
    return {"place": message.place or None}


def _roots(intensities: Vector) -> dict[str, object]:
    """The two fields; what is no number, or negative, is 0."""
    known = np.maximum(np.nan_to_num(intensities.astype(np.float64), posinf=0.0), 0.0)
    greatest = known.max(initial=0.0)
    roots = np.rint(255 * np.sqrt(known / (greatest or 1.0))).astype(np.uint8)
    return {"intensity_greatest": greatest, "intensity_roots": roots.tobytes()}

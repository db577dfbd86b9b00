"""What a log holds: topics, frames, metadata, and the version of all that."""

import json
from typing import Any

from segslam.log.records import codec
from segslam.types import GraphEstimate, LateLoops, Step, Trajectory

VERSION = 1
"""Raised whenever a reader of the version before would misread a log."""

STEP = "/step"
"""segslam.Step (JSON): all of a step but what `records.BULK` names, written after all other messages of the step."""
ESTIMATE = "/estimate"
"""segslam.Estimate (JSON): what an optimisation gave, and the keyframes whose poses the /trajectory before it holds.
After every optimisation, in a long run with many loops after every second or third one."""
MEMORY = "/memory"
"""segslam.Memory (JSON): `rss_mb`, memory of the process at each step, if the system reports it."""
RESULT = "/result"
"""segslam.Result (JSON): the trajectory of every scan, once, after the last step and the last estimate."""
LATE_LOOPS = "/late_loops"
"""segslam.LateLoops (JSON): loops tried after the last scan, once, after the last estimate; absent if none was."""
REFERENCE = "/reference"
"""segslam.Reference (JSON): the true poses of the scans, where they are known, before the first step."""
TRANSFORMS = "/tf"
"""foxglove.FrameTransform: lidar in odom at every scan, odom in world after every optimisation."""
KEYFRAME = "/keyframe"
"""segslam.KeyframePoints (protobuf): all points of the step's keyframe, for replay. See `cloud`."""
POINTS = "/points"
"""foxglove.PointCloud: some of each keyframe's points in the lidar frame, with labels and their colours, to look at."""
MAP = "/map"
"""foxglove.PointCloud: some of the points of all keyframes in world, by the last estimate, once, before the result."""
ODOMETRY = "/odometry"
"""foxglove.PosesInFrame: the keyframes by odometry alone, in a world that starts where odom does."""
TRAJECTORY = "/trajectory"
"""foxglove.PosesInFrame: the keyframes in world, as often as /estimate."""
GROUND_TRUTH = "/ground_truth"
"""foxglove.PosesInFrame: the reference in world, moved so that it starts where odom does."""
ACCEPTED = "/loops/accepted"
REJECTED = "/loops/rejected"
"""foxglove.SceneUpdate: a line from each keyframe tried to the one it was tried against; a click shows the outcome."""
GRAPH = "/graph"
"""foxglove.SceneUpdate: all closures, as often as /estimate, green where trusted, red where switched off."""

WORLD, ODOM, LIDAR = "world", "odom", "lidar"
"""Frames."""

RUN_METADATA = "segslam"
"""Metadata record: schema_version, dataset, python, platform, started (UTC), command, processor, and, for
KITTI, T_camera_lidar (JSON)."""
CONFIG_METADATA = "segslam.config"
"""Metadata record: the effective settings under the key `yaml`."""
OPTIONS_METADATA = "segslam.options"
"""Metadata record: what was chosen beside the settings, such as where labels come from; empty for a replay."""
PACKAGES_METADATA = "segslam.packages"
"""Metadata record: package -> version."""


def json_schemas() -> dict[str, dict[str, Any]]:
    """Topic -> JSON Schema of its messages, for those that are no schema of Foxglove's."""
    estimate = codec(GraphEstimate).schema
    keyframe_ids = {"keyframe_ids": {"type": "array", "items": {"type": "integer"}}}
    estimate = estimate | {"properties": estimate["properties"] | keyframe_ids}
    return {
        STEP: codec(Step).schema | {"title": "segslam.Step"},
        ESTIMATE: estimate | {"title": "segslam.Estimate"},
        MEMORY: {"title": "segslam.Memory", "type": "object", "properties": {"rss_mb": {"type": "number"}}},
        RESULT: codec(Trajectory).schema | {"title": "segslam.Result"},
        LATE_LOOPS: codec(LateLoops).schema | {"title": "segslam.LateLoops"},
        REFERENCE: codec(Trajectory).schema | {"title": "segslam.Reference"},
    }


def schema_text(schema: dict[str, Any]) -> bytes:
    """The bytes of a JSON Schema in the file."""
    return json.dumps(schema).encode()


def is_readable(written: dict[str, Any], own: dict[str, Any]) -> bool:
    """Whether records written by one JSON Schema have all that a reader by `own` needs, in the same types.

    Fields that only the writer knows are skipped, and so may be those that only the reader knows and has a default for.
    """
    if any(written.get(key) != own.get(key) for key in ("type", "description")):
        return False
    parts = [(written, own, key) for key in ("items", "additionalProperties") if key in own]
    given = written.get("properties", {})
    for name in own.get("properties", {}):
        if name in given:
            parts.append((given, own["properties"], name))
        elif name in own.get("required", ()):
            return False
    return all(key in theirs and is_readable(theirs[key], ours[key]) for theirs, ours, key in parts)

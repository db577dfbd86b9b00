"""What a log holds: topics, frames, metadata, and the version of all that."""

import json
from typing import Any

from segslam.log.records import codec
from segslam.types import AngleSamples, GraphEstimate, Step, Trajectory

VERSION = 1
"""Raised whenever a reader of the version before would misread a log."""

STEP = "/step"
"""segslam.Step (JSON): all of a step but what `records.BULK` names, written after all other messages of the step."""
ESTIMATE = "/estimate"
"""segslam.Estimate (JSON): what an optimisation gave, and the keyframes whose poses the /trajectory before it holds.
After every optimisation, in a long run with many loops after every second or third one."""
MEMORY = "/memory"
"""segslam.Memory (JSON): `rss_mb`, what the process held at each step, where the system tells it."""
RESULT = "/result"
"""segslam.Result (JSON): the trajectory of every scan, once, after the last step and the last estimate."""
ANGLES = "/angles"
"""segslam.Angles (JSON): what pairs of scans told of leftover angles, between the last estimate and the result."""
REFERENCE = "/reference"
"""segslam.Reference (JSON): the true poses of the scans, where they are known, before the first step."""
TRANSFORMS = "/tf"
"""foxglove.FrameTransform: lidar in odom at every scan, odom in world after every optimisation."""
KEYFRAME = "/keyframe"
"""segslam.KeyframePoints (protobuf): all points of the step's keyframe, for replay. See `cloud`."""
POINTS = "/points"
"""foxglove.PointCloud: some of each keyframe's points in the lidar frame, with labels, to look at."""
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
"""Metadata record: schema_version, dataset, python, platform, and T_camera_lidar (JSON) for KITTI."""
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
        ANGLES: codec(AngleSamples).schema | {"title": "segslam.Angles"},
        REFERENCE: codec(Trajectory).schema | {"title": "segslam.Reference"},
    }


def schema_text(schema: dict[str, Any]) -> bytes:
    """The bytes of a JSON Schema in the file; a log whose bytes differ is of another version."""
    return json.dumps(schema).encode()

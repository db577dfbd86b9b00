"""What Foxglove finds in a log, and what the layout makes of it."""

import json
import re
import resource
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from helpers.made_logs import CONFIG, decoded, made_result, made_steps, write_log
from mcap.reader import make_reader
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from segslam.core import geometry
from segslam.core.types import Rejected, RejectReason, Step
from segslam.labels.encodings import of_classes
from segslam.output.log import LogWriter, drawing, schema
from segslam.output.log.drawing import MAP_RANGE_M, REJECTED_COLORS, Drawing, weight_color
from segslam.output.log.records import BULK, codec


@pytest.mark.long
def test_own_messages_agree_with_the_json_schemas_in_the_file(steps: list[Step], tmp_path: Path) -> None:
    estimate, trajectory = made_result(steps)
    with LogWriter(tmp_path / "log.mcap", config=CONFIG, reference=trajectory) as log:
        for step in steps:
            log.write(step)
        log.write_result(estimate, trajectory)
    topics = set()
    with (tmp_path / "log.mcap").open("rb") as stream:
        for found, channel, message in make_reader(stream).iter_messages():
            if found.encoding == "jsonschema":
                jsonschema.validate(json.loads(message.data), json.loads(found.data))
                topics.add(channel.topic)
    assert topics == {schema.STEP, schema.ESTIMATE, schema.RESULT, schema.REFERENCE, schema.MEMORY}


def test_fields_left_out_of_the_json_exist() -> None:
    for record, names in BULK.items():
        assert names <= {field.name for field in fields(record)}
        assert not names & set(codec(record).schema["properties"])


def test_schemas_keep_to_what_foxglove_parses() -> None:
    """Its parser wants `properties` in every object, and arrays of numbers, texts or objects only."""

    def check(values: dict[str, Any]) -> None:
        assert values["type"] in {"boolean", "integer", "number", "string", "object", "array"}
        if values["type"] == "object":
            for inner in values["properties"].values():
                check(inner)
        if values["type"] == "array":
            assert values["items"]["type"] != "array"
            check(values["items"])

    for values in schema.json_schemas().values():
        assert values["type"] == "object"
        check(values)


def test_transforms_chain_from_world_through_odom_to_the_lidar(steps: list[Step], whole: Path) -> None:
    """After an optimisation the newest keyframe stands in world where the graph has it."""
    step = [step for step in steps if step.estimate is not None][-1]
    frames: dict[tuple[str, str], np.ndarray] = {}
    for message in decoded(whole, schema.TRANSFORMS):
        if message.timestamp.ToNanoseconds() > step.stamp_ns:
            break
        q, t = message.rotation, message.translation
        rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        frames[message.parent_frame_id, message.child_frame_id] = geometry.transform(rotation, [t.x, t.y, t.z])
    T_lidar_keyframe = geometry.inverse(step.T_odom_lidar) @ step.keyframe.T_odom_keyframe
    T_world_keyframe = frames["world", "odom"] @ frames["odom", "lidar"] @ T_lidar_keyframe
    expected = step.estimate.T_world_keyframe[step.keyframe.id]
    np.testing.assert_allclose(T_world_keyframe, expected, rtol=0, atol=1e-11)  # products of coordinates near 1e3


def _rows(cloud: Any) -> np.ndarray:
    """The points of a cloud."""
    return np.frombuffer(cloud.data, np.dtype([("xyz", "<f4", 3), ("label", "u1"), ("rgba", "u1", 4)]))


def test_one_cloud_of_the_whole_drive_lies_in_world_where_the_last_estimate_has_it(
    steps: list[Step], tmp_path: Path
) -> None:
    estimate, trajectory = made_result(steps)
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in steps:
            log.write(step)
        log.write_result(estimate, trajectory)
    [cloud] = decoded(tmp_path / "log.mcap", schema.MAP)
    assert cloud.frame_id == schema.WORLD
    every, expected = drawing.VIEW_EVERY, []
    for keyframe in (step.keyframe for step in steps if step.keyframe is not None):
        some = keyframe.points[::every]
        near = np.linalg.norm(some, axis=1) < MAP_RANGE_M
        expected.append(geometry.apply(estimate.T_world_keyframe[keyframe.id], some[near].astype(float)))
    expected_points = np.concatenate(expected)
    found = _rows(cloud)["xyz"]
    assert 0 < len(found) <= len(expected_points)
    assert cKDTree(expected_points).query(found)[0].max() < 0.03  # rounded to 3 cm
    assert cKDTree(found).query(expected_points)[0].max() < 0.4  # a voxel's diagonal


def test_the_cloud_to_look_at_is_a_share_of_the_keyframe_within_its_rounding(steps: list[Step], whole: Path) -> None:
    keyframe, cloud = steps[0].keyframe, decoded(whole, schema.POINTS)[0]
    rows = _rows(cloud)
    of_label = {"x": 0, "y": 4, "z": 8, "label": 12, "red": 13, "green": 14, "blue": 15, "alpha": 16}
    assert {field.name: field.offset for field in cloud.fields} == of_label
    np.testing.assert_array_equal(rows["rgba"][:, :3], of_classes(rows["label"]))
    assert (rows["rgba"][:, 3] == 255).all()
    every = drawing.VIEW_EVERY
    np.testing.assert_array_equal(rows["label"], keyframe.labels[::every])
    assert np.abs(rows["xyz"] - keyframe.points[::every]).max() <= 2.0**-6


def test_each_attempt_is_a_line_between_its_keyframes_with_its_outcome(steps: list[Step], whole: Path) -> None:
    attempts = [(step, attempt) for step in steps for attempt in step.attempts]
    rejected = [(s, a) for s, a in attempts if isinstance(a.outcome, Rejected)]
    entities = [entity for message in decoded(whole, schema.REJECTED) for entity in message.entities]
    assert len(entities) == len(rejected) > 0
    for entity in entities:
        metadata = {pair.key: pair.value for pair in entity.metadata}
        assert metadata["outcome.Rejected.reason"] == "low_overlap"
        assert metadata["outcome.Rejected.detail"] == "0.31 < 0.5"
        assert len(entity.lines[0].points) == 2
    accepted = [entity for message in decoded(whole, schema.ACCEPTED) for entity in message.entities]
    assert len(accepted) == len(attempts) - len(rejected) > 0
    assert {pair.key: pair.value for pair in accepted[0].metadata}["outcome.LoopClosure.alignment.overlap"] == "0.71"
    step = next(step for step in steps if step.estimate is not None)
    ends = [[point.x, point.y, point.z] for point in accepted[0].lines[0].points]
    source_id = step.attempts[0].candidate.source_id
    np.testing.assert_array_equal(ends[0], step.estimate.T_world_keyframe[source_id][:3, 3])


def test_a_rejected_line_disappears_when_its_loop_is_accepted(steps: list[Step]) -> None:
    step = next(step for step in steps if step.estimate is not None)
    (accepted,) = step.attempts
    waiting = replace(accepted, outcome=Rejected(RejectReason.UNCONFIRMED, "0 of 2"))
    drawing = Drawing()
    for one in steps[: steps.index(step)]:
        list(drawing.draw(one))
    assert not _deleted(drawing, replace(step, attempts=()))
    assert not _deleted(drawing, replace(step, keyframe=None, attempts=(waiting,)))
    pair = f"{accepted.candidate.source_id} to {accepted.candidate.target_id}"
    assert _deleted(drawing, replace(step, keyframe=None)) == [pair]
    assert not _deleted(drawing, replace(step, keyframe=None))


def _deleted(drawing: Drawing, step: Step) -> list[str]:
    """Lines of rejected loops that a step removes."""
    drawn = [message for topic, message in drawing.draw(step) if topic == schema.REJECTED]
    return [deletion.id for message in drawn for deletion in message.deletions]


def test_every_reason_has_a_colour_of_its_own() -> None:
    assert set(REJECTED_COLORS) == set(RejectReason)
    assert len(set(REJECTED_COLORS.values())) == len(RejectReason)


def test_closures_turn_from_red_to_green_with_their_weight() -> None:
    assert weight_color(0.0).startswith("#ff00")
    assert weight_color(1.0).startswith("#00ff")


@pytest.mark.long
def test_all_versions_of_the_odometry_path_together_stay_linear_in_its_length(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", list(made_steps(800)))
    lengths = [len(message.poses) for message in decoded(path, schema.ODOMETRY)]
    assert lengths[-1] >= 400 / 1.06
    assert sum(lengths) < 30 * 400  # a path in each keyframe's message would be 200 * 400


LAYOUT = json.loads((Path(__file__).parents[3] / "configs" / "foxglove_layout.json").read_text())


def _panels(node: str | dict[str, Any]) -> list[str]:
    return [node] if isinstance(node, str) else _panels(node["first"]) + _panels(node["second"])


def test_the_layout_shows_each_of_its_panels_once() -> None:
    assert sorted(_panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_the_layout_draws_all_that_the_log_has_to_draw(whole: Path) -> None:
    with whole.open("rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    frames = {schema.WORLD, schema.ODOM, schema.LIDAR}
    topics = {channel.topic for channel in channels if channel.message_encoding == "protobuf"}
    panel = LAYOUT["configById"]["3D!segslam"]
    assert set(panel["topics"]) == topics - {schema.TRANSFORMS, schema.KEYFRAME, schema.LOG}
    assert LAYOUT["configById"]["RosOut!log"]["topicToRender"] == schema.LOG
    assert {name.removeprefix("frame:") for name in panel["transforms"]} == frames
    assert panel["followTf"] in frames


def test_the_layout_plots_the_stages_that_a_scan_has() -> None:
    """Those that the pipeline times: a stage of another name would never show."""
    paths = [path["value"] for path in LAYOUT["configById"]["Plot!stages"]["paths"]]
    package = Path(schema.__file__).parents[2]
    files = [package / name for name in ("odometry/tracker.py", "slam/slam.py", "slam/loops.py")]
    files += [file for room in ("registration", "verification") for file in sorted((package / room).glob("*.py"))]
    source = "".join(file.read_text() for file in files)
    stages = {*re.findall(r'(?:watch|own)\("(\w+)"\)', source)}
    assert {path.rpartition(".")[2] for path in paths} == stages


def test_the_layout_plots_numbers_that_the_log_has() -> None:
    schemas = schema.json_schemas()
    plots = [panel for name, panel in LAYOUT["configById"].items() if name.startswith("Plot!")]
    for path in (path["value"] for panel in plots for path in panel["paths"]):
        topic, *keys = path.split(".")
        values = schemas[topic]
        for key in keys:
            name, is_array, _ = key.partition("[:]")
            values = values["properties"].get(name) or values["additionalProperties"]
            values = values["items"] if is_array else values
        assert values["type"] in {"number", "integer"}


def test_memory_at_each_step_is_what_the_process_holds(steps: list[Step], whole: Path) -> None:
    with whole.open("rb") as stream:
        values = [
            json.loads(message.data)["rss_mb"] for _, _, message in make_reader(stream).iter_messages(["/memory"])
        ]
    assert len(values) == len(steps)
    assert 10 < values[-1] <= resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 + 1


def test_the_displayed_map_does_not_depend_on_the_number_of_keyframes_in_a_batch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(1)
    clouds = {
        number: (rng.uniform(-3, 3, (400, 3)).astype(np.float32), rng.integers(0, 20, 400, dtype=np.uint8))
        for number in range(7)
    }
    poses = {number: geometry.transform(np.eye(3), [float(number), 0.0, 0.0]) for number in clouds}
    points, labels = drawing.map_points(poses, clouds.__getitem__)
    monkeypatch.setattr(drawing, "MAP_BATCH", 3)
    points_in_batches, labels_in_batches = drawing.map_points(poses, clouds.__getitem__)
    assert 100 < len(points) < 7 * 200
    np.testing.assert_array_equal(points_in_batches, points)
    np.testing.assert_array_equal(labels_in_batches, labels)

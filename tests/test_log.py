"""The log gives back what was written, up to where it was cut, and other tools can read it."""

import json
import resource
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from segslam import geometry
from segslam.config import Config
from segslam.log import LogWriter, read_log, schema
from segslam.log.cloud import keyframe_points, points_and_labels
from segslam.log.drawing import REJECTED_COLORS, weight_color
from segslam.log.output import Output
from segslam.log.records import BULK, codec
from segslam.types import (
    Alignment,
    GraphEstimate,
    Keyframe,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Registration,
    Rejected,
    RejectReason,
    SegslamError,
    Step,
    Trajectory,
)

CONFIG = Config()
RESOLUTION_M = CONFIG.keyframes.resolution_m


def _pose(rng: np.random.Generator) -> np.ndarray:
    return geometry.transform(Rotation.random(random_state=rng).as_matrix(), rng.normal(scale=100.0, size=3))


def _registration(rng: np.random.Generator) -> Registration:
    return Registration(_pose(rng), 120, 17, float(rng.random()), rng.random((6, 6)), 900)


def _closure(rng: np.random.Generator, source_id: int, target_id: int) -> LoopClosure:
    alignment = Alignment(_registration(rng), _registration(rng), 0.71, 0.083, 0.02)
    return LoopClosure(source_id, target_id, _pose(rng), rng.random((6, 6)), alignment)


def _keyframe(rng: np.random.Generator, keyframe_id: int, scan_index: int, stamp_ns: int) -> Keyframe:
    steps = rng.integers(-25_000, 25_000, size=(200, 3))
    points = (steps * RESOLUTION_M).astype(np.float32)
    labels = rng.integers(0, 20, size=200).astype(np.uint8)
    return Keyframe(keyframe_id, scan_index, stamp_ns, _pose(rng), 1.7 * keyframe_id, points, labels)


def _steps(num_steps: int, seed: int = 0) -> Iterator[Step]:
    """A keyframe every other scan; from the tenth keyframe on an attempt each, every third accepted and optimised."""
    rng = np.random.default_rng(seed)
    poses: dict[int, np.ndarray] = {}
    weights: dict[tuple[int, int], float] = {}
    for index in range(num_steps):
        stamp_ns = 1_700_000_000_123_456_789 + 100_000_007 * index
        keyframe, attempts, estimate = None, (), None
        if index % 2 == 0:
            keyframe = _keyframe(rng, index // 2, index, stamp_ns)
            poses[keyframe.id] = _pose(rng)
        if keyframe is not None and keyframe.id >= 10:
            pair = (keyframe.id, keyframe.id - 10)
            candidate = LoopCandidate(*pair, _pose(rng), 3.3, 7.1)
            accepted = keyframe.id % 3 == 0
            outcome = _closure(rng, *pair) if accepted else Rejected(RejectReason.LOW_OVERLAP, "0.31 < 0.5")
            attempts = (LoopAttempt(candidate, outcome, {"match": 0.021, "refine": 0.032}),)
            if accepted:
                weights[pair] = float(rng.random())
                estimate = GraphEstimate(dict(poses), float(rng.random()), dict(weights))
        yield Step(index, stamp_ns, _pose(rng), keyframe, attempts, estimate, {"odometry": 0.041})


def _result(steps: list[Step]) -> tuple[GraphEstimate, Trajectory]:
    keyframes = [step.keyframe for step in steps if step.keyframe is not None]
    estimate = GraphEstimate({keyframe.id: keyframe.T_odom_keyframe for keyframe in keyframes}, 2.5, {(10, 0): 0.0})
    scan_index, stamp_ns = (np.array([getattr(step, name) for step in steps]) for name in ("scan_index", "stamp_ns"))
    return estimate, Trajectory(scan_index, stamp_ns, np.stack([step.T_odom_lidar for step in steps]))


def _write(path: Path, steps: list[Step], config: Config = CONFIG) -> Path:
    with LogWriter(path, config=config, dataset="kitti/00") as log:
        for step in steps:
            log.write(step)
    return path


def _assert_same(a: Any, b: Any) -> None:
    """Equal to the last bit, but for the poses of estimates: they travel as quaternions."""
    assert type(a) is type(b)
    if isinstance(a, GraphEstimate):
        assert list(a.T_world_keyframe) == list(b.T_world_keyframe)
        for T_a, T_b in zip(a.T_world_keyframe.values(), b.T_world_keyframe.values(), strict=True):
            np.testing.assert_allclose(T_a, T_b, rtol=0, atol=4e-15)
        a, b = replace(a, T_world_keyframe={}), replace(b, T_world_keyframe={})
    if is_dataclass(a):
        for field in fields(a):
            _assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple):
        for item_a, item_b in zip(a, b, strict=True):
            _assert_same(item_a, item_b)
    else:
        assert a == b


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return list(_steps(60))


@pytest.fixture(scope="module")
def whole(steps: list[Step], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _write(tmp_path_factory.mktemp("log") / "log.mcap", steps)


def test_steps_read_again_are_those_written(steps: list[Step], whole: Path) -> None:
    read = list(read_log(whole).steps())
    assert len(read) == len(steps)
    for a, b in zip(steps, read, strict=True):
        _assert_same(a, b)


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_other_compressions_hold_the_same(steps: list[Step], tmp_path: Path, compression: str) -> None:
    config = Config.model_validate({"log": {"compression": compression}})
    read = list(read_log(_write(tmp_path / "log.mcap", steps, config)).steps())
    _assert_same(tuple(steps), tuple(read))


def test_result_read_again_is_that_written(steps: list[Step], tmp_path: Path) -> None:
    estimate, trajectory = _result(steps)
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in steps:
            log.write(step)
        log.write_result(estimate, trajectory)
    log = read_log(tmp_path / "log.mcap")
    _assert_same((estimate, trajectory), log.result())
    assert len(list(log.steps())) == len(steps)


def test_a_run_without_an_end_has_no_result(whole: Path) -> None:
    assert read_log(whole).result() is None


def test_the_reference_and_the_calibration_are_kept_for_a_replay(steps: list[Step], tmp_path: Path) -> None:
    _, reference = _result(steps)
    T_camera_lidar = steps[3].T_odom_lidar
    with LogWriter(tmp_path / "log.mcap", config=CONFIG, reference=reference, T_camera_lidar=T_camera_lidar) as log:
        log.write(steps[0])
    log = read_log(tmp_path / "log.mcap")
    _assert_same(reference, log.reference())
    np.testing.assert_array_equal(T_camera_lidar, log.T_camera_lidar)
    path = _decoded(tmp_path / "log.mcap", schema.GROUND_TRUTH)[0].poses
    assert len(path) == len(reference)
    first = path[0].position
    np.testing.assert_allclose([first.x, first.y, first.z], 0, atol=1e-12)


def test_a_log_without_ground_truth_has_no_reference_and_no_calibration(whole: Path) -> None:
    assert read_log(whole).reference() is None
    assert read_log(whole).T_camera_lidar is None


def test_steps_are_counted_with_an_index_and_without(steps: list[Step], whole: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: _boundaries(whole)[22] + 5])
    assert (read_log(whole).num_steps(), read_log(cut).num_steps()) == (len(steps), 23)


def test_settings_and_versions_are_in_the_metadata(steps: list[Step], tmp_path: Path) -> None:
    config = Config.model_validate({"verify": {"min_overlap": 0.37}})
    log = read_log(_write(tmp_path / "log.mcap", steps[:1], config))
    assert log.config == config
    assert log.run["dataset"] == "kitti/00"
    assert log.packages["numpy"] == np.__version__


@given(st.lists(st.tuples(*[st.integers(-(2**29), 2**29)] * 3), max_size=50), st.sampled_from([0.004, 2.0**-8, 1.0]))
def test_points_on_the_grid_come_back_exactly(steps: list[tuple[int, int, int]], resolution_m: float) -> None:
    points = (np.array(steps).reshape(-1, 3) * resolution_m).astype(np.float32)
    on_grid = np.abs(points / np.float32(resolution_m)) < 2**22  # float32 tells neighbours on the grid apart
    points = points[on_grid.all(axis=1)]
    labels = np.arange(len(points), dtype=np.uint8)
    again, labels_again = points_and_labels(keyframe_points(points, labels, resolution_m=resolution_m))
    np.testing.assert_array_equal(points, again)
    np.testing.assert_array_equal(labels, labels_again)
    assert again.dtype == np.float32


def test_points_off_the_grid_move_by_half_a_step_at_most() -> None:
    points = np.random.default_rng(0).uniform(-120, 120, size=(1000, 3)).astype(np.float32)
    again, _ = points_and_labels(keyframe_points(points, np.zeros(1000, np.uint8), resolution_m=0.004))
    assert np.abs(points - again).max() <= 0.002 + 1e-5  # float32 at 120 m resolves 8e-6 m


def test_any_mcap_reader_finds_the_index_and_the_checksums_in_order(steps: list[Step], whole: Path) -> None:
    with whole.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        statistics = reader.get_summary().statistics
        assert statistics.message_count == sum(1 for _ in reader.iter_messages())
        assert statistics.chunk_count == len(steps)
        assert [message.log_time for _, channel, message in reader.iter_messages(topics=[schema.STEP])] == [
            step.stamp_ns for step in steps
        ]
    with whole.open("rb") as stream:
        assert sum(1 for _ in StreamReader(stream, validate_crcs=True).records) > statistics.message_count


def test_own_messages_agree_with_the_json_schemas_in_the_file(steps: list[Step], tmp_path: Path) -> None:
    estimate, trajectory = _result(steps)
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
    assert topics == {schema.STEP, schema.ESTIMATE, schema.RESULT, schema.REFERENCE}


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


def _decoded(path: Path, topic: str) -> list[Any]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [item.decoded_message for item in reader.iter_decoded_messages(topics=[topic], log_time_order=False)]


def test_transforms_chain_from_world_through_odom_to_the_lidar(steps: list[Step], whole: Path) -> None:
    """After an optimisation the newest keyframe stands in world where the graph has it."""
    step = [step for step in steps if step.estimate is not None][-1]
    frames: dict[tuple[str, str], np.ndarray] = {}
    for message in _decoded(whole, schema.TRANSFORMS):
        if message.timestamp.ToNanoseconds() > step.stamp_ns:
            break
        q, t = message.rotation, message.translation
        rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        frames[message.parent_frame_id, message.child_frame_id] = geometry.transform(rotation, [t.x, t.y, t.z])
    T_lidar_keyframe = geometry.inverse(step.T_odom_lidar) @ step.keyframe.T_odom_keyframe
    T_world_keyframe = frames["world", "odom"] @ frames["odom", "lidar"] @ T_lidar_keyframe
    expected = step.estimate.T_world_keyframe[step.keyframe.id]
    np.testing.assert_allclose(T_world_keyframe, expected, rtol=0, atol=1e-11)  # products of coordinates near 1e3


def test_the_cloud_to_look_at_is_a_share_of_the_keyframe_within_its_rounding(steps: list[Step], whole: Path) -> None:
    keyframe, cloud = steps[0].keyframe, _decoded(whole, schema.POINTS)[0]
    rows = np.frombuffer(cloud.data, np.dtype([("xyz", "<f4", 3), ("label", "u1")]))
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8), ("label", 12)]
    every = CONFIG.log.view_every
    np.testing.assert_array_equal(rows["label"], keyframe.labels[::every])
    assert np.abs(rows["xyz"] - keyframe.points[::every]).max() <= 2.0**-6


def test_each_attempt_is_a_line_between_its_keyframes_with_its_outcome(steps: list[Step], whole: Path) -> None:
    attempts = [(step, attempt) for step in steps for attempt in step.attempts]
    rejected = [(s, a) for s, a in attempts if isinstance(a.outcome, Rejected)]
    entities = [entity for message in _decoded(whole, schema.REJECTED) for entity in message.entities]
    assert len(entities) == len(rejected) > 0
    for entity in entities:
        metadata = {pair.key: pair.value for pair in entity.metadata}
        assert metadata["outcome.Rejected.reason"] == "low_overlap"
        assert metadata["outcome.Rejected.detail"] == "0.31 < 0.5"
        assert len(entity.lines[0].points) == 2
    accepted = [entity for message in _decoded(whole, schema.ACCEPTED) for entity in message.entities]
    assert len(accepted) == len(attempts) - len(rejected) > 0
    assert {pair.key: pair.value for pair in accepted[0].metadata}["outcome.LoopClosure.alignment.overlap"] == "0.71"
    step = next(step for step in steps if step.estimate is not None)
    ends = [[point.x, point.y, point.z] for point in accepted[0].lines[0].points]
    source_id = step.attempts[0].candidate.source_id
    np.testing.assert_array_equal(ends[0], step.estimate.T_world_keyframe[source_id][:3, 3])


def test_every_reason_has_a_colour_of_its_own() -> None:
    assert set(REJECTED_COLORS) == set(RejectReason)
    assert len(set(REJECTED_COLORS.values())) == len(RejectReason)


def test_closures_turn_from_red_to_green_with_their_weight() -> None:
    assert weight_color(0.0).startswith("#ff00")
    assert weight_color(1.0).startswith("#00ff")


def test_all_versions_of_the_odometry_path_together_stay_linear_in_its_length(tmp_path: Path) -> None:
    path = _write(tmp_path / "log.mcap", list(_steps(800)))
    lengths = [len(message.poses) for message in _decoded(path, schema.ODOMETRY)]
    assert lengths[-1] >= 400 / 1.06
    assert sum(lengths) < 30 * 400  # a path in each keyframe's message would be 200 * 400


def _boundaries(path: Path) -> list[int]:
    """Where each step ends in the file."""
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    return [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]


def test_a_cut_log_gives_every_complete_step_wherever_it_is_cut(
    steps: list[Step], whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data, ends = whole.read_bytes(), _boundaries(whole)
    rng = np.random.default_rng(1)
    cuts = {*rng.integers(ends[0] - 500, len(data) - 1, 40).tolist(), *ends[:5], *(end - 1 for end in ends[5:10])}
    for size in sorted(cuts):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:size])
        caplog.clear()
        read = list(read_log(path).steps())
        assert len(read) == sum(end <= size for end in ends)
        _assert_same(tuple(steps[: len(read)]), tuple(read))
        if size < ends[-1]:
            assert f"kept the {len(read)} steps before" in caplog.text


def test_a_damaged_log_gives_the_steps_before_the_damage(
    steps: list[Step], whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A lost page reads as zeros after a power failure; a flipped bit fails the checksum or the decompression."""
    data, ends = whole.read_bytes(), _boundaries(whole)
    flipped = bytearray(data)
    flipped[ends[19] + 300] ^= 1
    zeroed = data[: ends[19]] + bytes(len(data) - ends[19])
    for name, content in (("flipped", bytes(flipped)), ("zeroed", zeroed)):
        path = tmp_path / name
        path.write_bytes(content)
        assert len(list(read_log(path).steps())) == 20
        assert "kept the 20 steps before" in caplog.text


@contextmanager
def _largest_file(size: int) -> Iterator[None]:
    """The operating system refuses to let files grow beyond this size: a full disk that a test can have."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_stops_with_the_file_named_and_the_log_still_opens(steps: list[Step], tmp_path: Path) -> None:
    path, written = tmp_path / "log.mcap", []

    def write_all() -> None:
        for step in steps:
            log.write(step)
            written.append(step)

    with LogWriter(path, config=CONFIG) as log, _largest_file(60_000):
        with pytest.raises(SegslamError, match=r"log\.mcap: cannot go on writing the log .* make room"):
            write_all()
        with pytest.raises(SegslamError, match="closed"):
            log.write(steps[0])
    read = list(read_log(path).steps())
    assert 0 < len(read) == len(written) < len(steps)
    assert path.stat().st_size == _end_of_data(path)


def _end_of_data(path: Path) -> int:
    """Where the last whole record ends."""
    data, offset = path.read_bytes(), 8
    while offset + 9 <= len(data):
        offset += 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
    return offset


def test_ctrl_c_in_mid_record_waits_until_the_step_is_complete(
    steps: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        log.write(steps[0])
        write = Output.write

        def interrupted_write(output: Output, data: bytes) -> int:
            signal.raise_signal(signal.SIGINT)
            return write(output, data)

        monkeypatch.setattr(Output, "write", interrupted_write)
        with pytest.raises(KeyboardInterrupt):
            log.write(steps[1])
        monkeypatch.undo()
        log.write(steps[2])
    _assert_same(tuple(steps[:3]), tuple(read_log(tmp_path / "log.mcap").steps()))


def test_a_step_that_cannot_be_encoded_leaves_no_half_of_itself(steps: list[Step], tmp_path: Path) -> None:
    broken = next(step for step in steps if step.estimate is not None)
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        log.write(steps[0])
        with pytest.raises(ValueError, match="JSON"):
            log.write(replace(broken, stage_seconds={"odometry": float("nan")}))
        log.write(steps[1])
    _assert_same(tuple(steps[:2]), tuple(read_log(tmp_path / "log.mcap").steps()))


def test_a_log_can_be_written_from_another_thread(steps: list[Step], tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as thread:
        path = thread.submit(_write, tmp_path / "log.mcap", steps[:5]).result()
    assert len(list(read_log(path).steps())) == 5


def test_a_log_that_cannot_be_written_names_the_path(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="nowhere"):
        LogWriter(tmp_path / "nowhere" / "log.mcap", config=CONFIG)


@pytest.mark.parametrize("content", [b"", b"not a log", b"\x89MCAP0\r\n"], ids=["empty", "text", "magic only"])
def test_a_file_that_is_no_log_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(SegslamError, match=r"log\.mcap: no log of segslam"):
        read_log(tmp_path / "log.mcap")


def test_a_missing_log_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.mcap", tmp_path):
        with pytest.raises(SegslamError, match="cannot read the log"):
            read_log(path)


def _foreign(path: Path, metadata: dict[str, dict[str, str]], step_schema: bytes = b"{}") -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for name, values in metadata.items():
            writer.add_metadata(name, values)
        channel = writer.register_channel(
            schema.STEP, "json", writer.register_schema("segslam.Step", "jsonschema", step_schema)
        )
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    return path


def test_somebody_elses_mcap_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="no log of segslam"):
        read_log(_foreign(tmp_path / "other.mcap", {"ros": {"distribution": "jazzy"}}))


def test_another_schema_version_is_refused_with_the_version_that_reads_it(tmp_path: Path) -> None:
    metadata = {
        "segslam": {"schema_version": "0"},
        "segslam.config": {"yaml": ""},
        "segslam.packages": {"segslam": "7.8"},
    }
    with pytest.raises(SegslamError, match=r"schema version 0.*use segslam 7\.8"):
        read_log(_foreign(tmp_path / "old.mcap", metadata))


def test_records_that_changed_without_a_new_version_are_refused_not_misread(tmp_path: Path) -> None:
    metadata = {"segslam": {"schema_version": str(schema.VERSION)}, "segslam.config": {"yaml": ""}}
    log = read_log(_foreign(tmp_path / "changed.mcap", metadata))
    with pytest.raises(SegslamError, match=r"its segslam\.Step is not what this version reads"):
        list(log.steps())


def test_a_step_that_contradicts_its_schema_is_refused(tmp_path: Path) -> None:
    metadata = {"segslam": {"schema_version": str(schema.VERSION)}, "segslam.config": {"yaml": ""}}
    step_schema = schema.schema_text(schema.json_schemas()[schema.STEP])
    log = read_log(_foreign(tmp_path / "broken.mcap", metadata, step_schema))
    with pytest.raises(SegslamError, match="not as segslam writes it"):
        list(log.steps())


LAYOUT = json.loads((Path(__file__).parents[1] / "configs" / "foxglove_layout.json").read_text())


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
    assert set(panel["topics"]) == topics - {schema.TRANSFORMS, schema.KEYFRAME}
    assert {name.removeprefix("frame:") for name in panel["transforms"]} == frames
    assert panel["followTf"] in frames


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

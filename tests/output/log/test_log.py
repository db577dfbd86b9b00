"""The log gives back what was written, and other tools can read it."""

import os
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message
from helpers.made_logs import CONFIG, assert_same, boundaries, decoded, made_result, made_steps, write_log
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from segslam.core.config import Config
from segslam.core.types import Keyframe, LoopCandidate, SegslamError, Step
from segslam.output.log import LogWriter, read_log, schema, writer
from segslam.output.log.records import codec, intensities, keyframe_points, points_and_labels


def test_steps_read_again_are_those_written(steps: list[Step], whole: Path) -> None:
    read = list(read_log(whole).steps())
    assert len(read) == len(steps)
    for a, b in zip(steps, read, strict=True):
        assert_same(a, b)


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_other_compressions_of_earlier_versions_hold_the_same(
    steps: list[Step], tmp_path: Path, compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = {"compression": CompressionType[compression.upper()]}
    monkeypatch.setattr(writer, "Writer", lambda *args, **options: Writer(*args, **options | other))
    read = list(read_log(write_log(tmp_path / "log.mcap", steps)).steps())
    assert_same(tuple(steps), tuple(read))


def test_a_step_is_in_the_file_when_write_returns(steps: list[Step], tmp_path: Path) -> None:
    """So that a slow disk slows the run: what waited in memory would grow there."""
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for number, step in enumerate(steps[:9], start=1):
            log.write(step)
            assert read_log(tmp_path / "log.mcap").num_steps() == number


def test_a_keyframe_s_cloud_is_read_back_while_the_log_grows(steps: list[Step], tmp_path: Path) -> None:
    keyframes = []
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in steps:
            if step.keyframe is not None:
                keyframes.append(step.keyframe)
                log.keep(step.keyframe)
            for keyframe in keyframes[-1:] + keyframes[:2]:
                assert_same((keyframe.points, keyframe.labels), log.cloud(keyframe.id))
            log.write(step)
    assert len(keyframes) > 5


def test_a_cloud_is_read_while_another_thread_brings_the_next_keyframe(steps: list[Step], tmp_path: Path) -> None:
    """The writer looks up its newest keyframe once."""
    first, second = [step.keyframe for step in steps if step.keyframe is not None][:2]

    class Replaced:
        """The first keyframe, which is no longer the newest after one look."""

        id = first.id

        @property
        def points(self) -> np.ndarray:
            log._newest = second
            return first.points

        labels = first.labels

    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        log._newest = Replaced()
        assert_same(log.cloud(first.id), (first.points, first.labels))


def test_a_cloud_asked_for_after_the_log_is_closed_is_an_error_of_our_own(steps: list[Step], tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in steps[:4]:
            log.write(step)
    with pytest.raises(SegslamError, match="the log is closed"):
        log.cloud(0)


def test_a_cloud_asked_for_after_another_program_changed_the_log_is_an_error_of_our_own(
    steps: list[Step], tmp_path: Path
) -> None:
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in steps[:4]:
            log.write(step)
        os.truncate(tmp_path / "log.mcap", (tmp_path / "log.mcap").stat().st_size // 2)
        for place in (lambda: log.cloud(0), lambda: log.cloud(1)):
            with pytest.raises(SegslamError, match="the log was changed while it was open"):
                place()


def test_the_poses_of_all_estimates_stay_in_proportion_to_the_keyframes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some steps then come back without theirs, and otherwise whole."""
    monkeypatch.setattr("segslam.output.log.writer.POSES_PER_KEYFRAME", 8)
    steps = list(made_steps(260))
    read = list(read_log(write_log(tmp_path / "log.mcap", steps)).steps())
    logged = [len(step.estimate.T_world_keyframe) for step in read if step.estimate is not None]
    assert 0.8 * 8 * 130 < sum(logged) <= 8 * 130 < sum(len(s.estimate.T_world_keyframe) for s in steps if s.estimate)
    assert len(logged) <= len(decoded(tmp_path / "log.mcap", schema.TRAJECTORY)) < len(logged) + 80
    for step, again in zip(steps, read, strict=True):
        assert_same(step if again.estimate is not None else replace(step, estimate=None), again)


def test_result_read_again_is_that_written(steps: list[Step], tmp_path: Path) -> None:
    estimate, trajectory = made_result(steps)
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in steps:
            log.write(step)
        log.write_result(estimate, trajectory)
    log = read_log(tmp_path / "log.mcap")
    assert_same((estimate, trajectory), log.result())
    assert len(list(log.steps())) == len(steps)


def test_a_log_of_an_older_version_with_a_channel_more_is_read(
    steps: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Logs of older versions contain samples of residual sensor angles before the result."""
    result = made_result(steps)
    angles = {"title": "segslam.Angles", "type": "object", "properties": {"travel_m": {"type": "number"}}}
    own = schema.json_schemas()
    with monkeypatch.context() as older:
        older.setattr(schema, "json_schemas", lambda: own | {"/angles": angles})
        log = LogWriter(tmp_path / "log.mcap", config=CONFIG)
        for step in steps:
            log.write(step)
        log._write([("/angles", b'{"travel_m": 1.0}')], stamp_ns=steps[-1].stamp_ns)
        log.write_result(*result)
        log.close()
    recorded = read_log(tmp_path / "log.mcap")
    assert_same(tuple(steps), tuple(recorded.steps()))
    assert_same(result, recorded.result())


def test_a_log_whose_records_have_other_fields_and_reasons_is_read(
    steps: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Older records lack what has a default by now, and have reasons and fields that have gone."""
    own = schema.json_schemas()
    older = deepcopy(own[schema.STEP])
    candidate = older["properties"]["attempts"]["items"]["properties"]["candidate"]
    del candidate["properties"]["near_probability"]
    candidate["properties"]["shape"] = {"type": "string"}
    assert "near_probability" not in candidate["required"]
    outcomes = older["properties"]["attempts"]["items"]["properties"]["outcome"]["properties"]
    outcomes["Rejected"]["properties"]["reason"]["enum"].append("inconsistent")
    with monkeypatch.context() as writing:
        writing.setattr(schema, "json_schemas", lambda: own | {schema.STEP: older})
        write_log(tmp_path / "log.mcap", steps)
    assert_same(tuple(steps), tuple(read_log(tmp_path / "log.mcap").steps()))


def test_a_default_stands_for_a_field_that_a_log_does_not_have() -> None:
    written = codec(LoopCandidate).encode(LoopCandidate(5, 1, np.eye(4), 3.0, near_probability=0.4))
    assert codec(LoopCandidate).decode(written, {}).near_probability == 0.4
    del written["near_probability"]
    assert codec(LoopCandidate).decode(written, {}).near_probability == 1.0


@pytest.mark.parametrize(
    ("written", "readable"),
    [
        ({"type": "object", "properties": {"a": {"type": "integer"}, "c": {"type": "string"}}}, True),
        ({"type": "object", "properties": {"c": {"type": "string"}}}, False),
        ({"type": "object", "properties": {"a": {"type": "number"}}}, False),
        ({"type": "object"}, False),
        ({"type": "array", "items": {"type": "integer"}}, False),
        ({}, False),
    ],
)
def test_a_schema_is_readable_if_it_has_all_that_is_needed(written: dict, readable: bool) -> None:
    own = {"type": "object", "properties": {"a": {"type": "integer"}, "b": {"type": "number"}}, "required": ["a"]}
    assert schema.is_readable(written, own) == readable
    assert schema.is_readable({"type": "array", "items": written}, {"type": "array", "items": own}) == readable


@pytest.mark.parametrize("chunk_bytes", [100, 4_000_000])
def test_a_result_is_found_by_the_index_however_many_chunks_it_takes(
    steps: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk_bytes: int
) -> None:
    """The steps before it are not read: here they cannot be."""
    monkeypatch.setattr("segslam.output.log.writer.CHUNK_BYTES", chunk_bytes)
    estimate, trajectory = made_result(steps)
    path = tmp_path / "log.mcap"
    with LogWriter(path, config=CONFIG) as log:
        for step in steps:
            log.write(step)
        end_of_steps = path.stat().st_size
        log.write_result(estimate, trajectory)
    content = bytearray(path.read_bytes())
    content[end_of_steps // 2 : end_of_steps] = bytes(end_of_steps - end_of_steps // 2)
    path.write_bytes(content)
    log = read_log(path)
    assert_same((estimate, trajectory), log.result())
    assert 0 < len(list(log.steps())) < len(steps)


def test_steps_without_clouds_are_the_same_but_for_the_points(steps: list[Step], whole: Path) -> None:
    for step, again in zip(steps, read_log(whole).steps(clouds=False), strict=True):
        if step.keyframe is not None:
            assert again.keyframe is not None
            assert again.keyframe.points.shape == (0, 3)
            none = {"points": again.keyframe.points, "labels": again.keyframe.labels, "intensities": None}
            step = replace(step, keyframe=replace(step.keyframe, **none))
        assert_same(step, again)


def test_a_run_without_an_end_has_no_result(whole: Path) -> None:
    assert read_log(whole).result() is None


def test_the_reference_and_the_calibration_are_kept_for_a_replay(steps: list[Step], tmp_path: Path) -> None:
    _, reference = made_result(steps)
    T_camera_lidar = steps[3].T_odom_lidar
    with LogWriter(tmp_path / "log.mcap", config=CONFIG, reference=reference, T_camera_lidar=T_camera_lidar) as log:
        log.write(steps[0])
    log = read_log(tmp_path / "log.mcap")
    assert_same(reference, log.reference())
    np.testing.assert_array_equal(T_camera_lidar, log.T_camera_lidar)
    path = decoded(tmp_path / "log.mcap", schema.GROUND_TRUTH)[0].poses
    assert len(path) == len(reference)
    first = path[0].position
    np.testing.assert_allclose([first.x, first.y, first.z], 0, atol=1e-12)


def test_a_log_without_ground_truth_has_no_reference_and_no_calibration(whole: Path) -> None:
    assert read_log(whole).reference() is None
    assert read_log(whole).T_camera_lidar is None


def test_steps_are_counted_with_an_index_and_without(steps: list[Step], whole: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: boundaries(whole)[22] + 5])
    assert (read_log(whole).num_steps(), read_log(cut).num_steps()) == (len(steps), 23)


def test_settings_and_versions_are_in_the_metadata(steps: list[Step], tmp_path: Path) -> None:
    config = Config.model_validate({"verify": {"max_false_share": 0.037}})
    log = read_log(write_log(tmp_path / "log.mcap", steps[:1], config))
    assert log.config == config
    assert log.run["dataset"] == "kitti/00"
    assert log.packages["numpy"] == np.__version__


@given(st.lists(st.tuples(*[st.integers(-(2**29), 2**29)] * 3), max_size=50), st.sampled_from([0.004, 2.0**-8, 1.0]))
def test_points_on_the_grid_come_back_exactly(steps: list[tuple[int, int, int]], resolution_m: float) -> None:
    points = (np.array(steps).reshape(-1, 3) * resolution_m).astype(np.float32)
    on_grid = np.abs(points / np.float32(resolution_m)) < 2**22  # float32 resolves neighbours on the grid
    points = points[on_grid.all(axis=1)]
    labels = np.arange(len(points), dtype=np.uint8)
    again, labels_again = points_and_labels(keyframe_points(_keyframe(points, labels), resolution_m=resolution_m))
    np.testing.assert_array_equal(points, again)
    np.testing.assert_array_equal(labels, labels_again)
    assert again.dtype == np.float32


def test_points_off_the_grid_move_by_half_a_step_at_most() -> None:
    points = np.random.default_rng(0).uniform(-120, 120, size=(1000, 3)).astype(np.float32)
    again, _ = points_and_labels(keyframe_points(_keyframe(points, np.zeros(1000, np.uint8)), resolution_m=0.004))
    assert np.abs(points - again).max() <= 0.002 + 1e-5  # float32 at 120 m resolves 8e-6 m


@pytest.mark.parametrize("greatest", [0.99, 255.0, 65535.0], ids=["KITTI", "a byte", "photons"])
def test_intensities_come_back_to_the_byte_and_stay_so(greatest: float) -> None:
    """A step of the root is 1/255 of that of the greatest; of faint returns it is a small step."""
    sent = (greatest * np.random.default_rng(1).random(5000) ** 3).astype(np.float32)
    sent[0] = greatest
    once = intensities(_sent(sent))
    assert np.abs(np.sqrt(once / greatest) - np.sqrt(sent / greatest)).max() <= 0.5 / 255 + 1e-6
    np.testing.assert_array_equal(intensities(_sent(once)), once)  # a replay of a replay loses nothing more


def test_intensities_that_are_negative_or_not_finite_are_zero() -> None:
    np.testing.assert_array_equal(intensities(_sent(np.array([np.nan, -3.0, np.inf, 4.0]))), [0.0, 0.0, 0.0, 4.0])
    np.testing.assert_array_equal(intensities(_sent(np.zeros(3))), np.zeros(3))


def test_a_cloud_without_intensities_holds_no_byte_for_them() -> None:
    """So it was written before there were any, and so it is read."""
    without = keyframe_points(_keyframe(np.ones((7, 3), np.float32), np.zeros(7, np.uint8)), resolution_m=0.004)
    assert {field.name for field, _ in without.ListFields()} == {
        "resolution_m",
        "num_points",
        "folded_difference_planes",
        "labels",
    }
    assert intensities(without) is None


def test_steps_with_intensities_are_read_again(steps: list[Step], tmp_path: Path) -> None:
    known = np.array([0.0, 1.0, 16.0, 255.0] * 50, np.float32)  # whole 255ths of the root
    known = (255 * np.rint(255 * np.sqrt(known / 255)) ** 2 / 255**2).astype(np.float32)
    sent = replace(steps[0], keyframe=replace(steps[0].keyframe, intensities=known))
    assert_same(sent, next(read_log(write_log(tmp_path / "log.mcap", [sent])).steps()))


def _keyframe(points: np.ndarray, labels: np.ndarray, intensities: np.ndarray | None = None) -> Keyframe:
    return Keyframe(0, 0, 0, np.eye(4), 0.0, points, labels, intensities)


def _sent(intensities: np.ndarray) -> Message:
    points, labels = np.ones((len(intensities), 3), np.float32), np.zeros(len(intensities), np.uint8)
    return keyframe_points(_keyframe(points, labels, intensities), resolution_m=0.004)


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


def test_a_negative_stamp_is_refused_before_anything_of_its_step_is_written(steps: list[Step], tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        log.write(steps[0])
        with pytest.raises(SegslamError, match="stamp -1 ns is negative"):
            log.write(replace(steps[1], stamp_ns=-1))
        log.write(steps[2])
    assert len(list(read_log(tmp_path / "log.mcap").steps())) == 2


def test_any_exception_within_a_step_leaves_the_whole_steps_before_it(
    steps: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = LogWriter(tmp_path / "log.mcap", config=CONFIG)
    log.write(steps[0])
    add = log._mcap.add_message
    monkeypatch.setattr(log._mcap, "add_message", lambda *given: (add(*given), 1 / 0))
    with pytest.raises(ZeroDivisionError):
        log.write(steps[1])
    log.close()
    assert_same((steps[0],), tuple(read_log(tmp_path / "log.mcap").steps()))

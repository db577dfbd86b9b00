"""Logs that are cut, damaged or of another version; failing disks and Ctrl-C."""

import json
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.made_logs import CONFIG, assert_same, boundaries, largest_file, write_log
from mcap.writer import Writer

from segslam.core.types import SegslamError, Step, WorkFailed
from segslam.output.log import LogWriter, read_log, schema
from segslam.output.log.writer import Output


@pytest.mark.long
def test_a_cut_log_gives_every_complete_step_wherever_it_is_cut(
    steps: list[Step], whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data, ends = whole.read_bytes(), boundaries(whole)
    rng = np.random.default_rng(1)
    cuts = {*rng.integers(ends[0] - 500, len(data) - 1, 40).tolist(), *ends[:5], *(end - 1 for end in ends[5:10])}
    for size in sorted(cuts):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:size])
        caplog.clear()
        read = list(read_log(path).steps())
        assert len(read) == sum(end <= size for end in ends)
        assert_same(tuple(steps[: len(read)]), tuple(read))
        if size < ends[-1]:
            assert f"kept the first {len(read)} steps" in caplog.text


def test_a_damaged_log_gives_the_steps_before_the_damage(
    steps: list[Step], whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A lost page reads as zeros after a power failure; a flipped bit fails the checksum or the decompression."""
    data, ends = whole.read_bytes(), boundaries(whole)
    flipped = bytearray(data)
    flipped[ends[19] + 300] ^= 1
    zeroed = data[: ends[19]] + bytes(len(data) - ends[19])
    for name, content in (("flipped", bytes(flipped)), ("zeroed", zeroed)):
        path = tmp_path / name
        path.write_bytes(content)
        assert len(list(read_log(path).steps())) == 20
        assert "kept the first 20 steps" in caplog.text


def test_a_full_disk_stops_with_the_file_named_and_the_log_still_opens(steps: list[Step], tmp_path: Path) -> None:
    path, written = tmp_path / "log.mcap", []

    def write_all() -> None:
        for step in steps:
            log.write(step)
            written.append(step)

    with LogWriter(path, config=CONFIG) as log, largest_file(60_000):
        with pytest.raises(WorkFailed, match=r"log\.mcap: cannot continue writing the log .* free space"):
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


@pytest.mark.usefixtures("ctrl_c_works")
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
    assert_same(tuple(steps[:3]), tuple(read_log(tmp_path / "log.mcap").steps()))


def test_a_step_that_cannot_be_encoded_leaves_no_half_of_itself(steps: list[Step], tmp_path: Path) -> None:
    broken = next(step for step in steps if step.estimate is not None)
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        log.write(steps[0])
        with pytest.raises(ValueError, match="JSON"):
            log.write(replace(broken, stage_seconds={"odometry": float("nan")}))
        log.write(steps[1])
    assert_same(tuple(steps[:2]), tuple(read_log(tmp_path / "log.mcap").steps()))


def test_a_log_can_be_written_from_another_thread(steps: list[Step], tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as thread:
        path = thread.submit(write_log, tmp_path / "log.mcap", steps[:5]).result()
    assert len(list(read_log(path).steps())) == 5


def test_a_log_that_cannot_be_written_names_the_path(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="nowhere"):
        LogWriter(tmp_path / "nowhere" / "log.mcap", config=CONFIG)


@pytest.mark.parametrize("content", [b"", b"not a log", b"\x89MCAP0\r\n"], ids=["empty", "text", "magic only"])
def test_a_file_that_is_no_log_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(SegslamError, match=r"log\.mcap: not a log of segslam"):
        read_log(tmp_path / "log.mcap")


def test_a_log_that_ends_before_its_first_step_has_its_settings_and_no_step(tmp_path: Path) -> None:
    """What a kill leaves while the first scan is mapped."""
    with LogWriter(tmp_path / "log.mcap", config=CONFIG, options={"data": "scans"}):
        head = (tmp_path / "log.mcap").read_bytes()
    (tmp_path / "log.mcap").write_bytes(head)
    log = read_log(tmp_path / "log.mcap")
    assert dict(log.options) == {"data": "scans"}
    assert list(log.steps()) == []
    (tmp_path / "log.mcap").write_bytes(head[:-1])
    with pytest.raises(SegslamError, match="truncated at its start"):
        read_log(tmp_path / "log.mcap")


def test_a_missing_log_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.mcap", tmp_path):
        with pytest.raises(SegslamError, match=r"\.mcap: no such file; give the log\.mcap of a run"):
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


def test_an_mcap_of_another_program_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="not a log of segslam"):
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
    with pytest.raises(SegslamError, match=r"its segslam\.Step has another format than this version reads"):
        list(log.steps())


def test_a_step_that_contradicts_its_schema_is_refused(tmp_path: Path) -> None:
    metadata = {"segslam": {"schema_version": str(schema.VERSION)}, "segslam.config": {"yaml": ""}}
    step_schema = json.dumps(schema.json_schemas()[schema.STEP]).encode()
    log = read_log(_foreign(tmp_path / "broken.mcap", metadata, step_schema))
    with pytest.raises(SegslamError, match="not written by segslam"):
        list(log.steps())


def test_a_record_with_an_impossible_length_ends_the_log(whole: Path, tmp_path: Path, steps: list[Step]) -> None:
    data = bytearray(whole.read_bytes())
    offset = 8  # after the magic bytes
    while offset < len(data) // 2:  # to a record in the middle: opcode, length, body
        offset += 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
    data[offset + 1 : offset + 9] = b"\xff" * 8
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    assert 0 < len(list(read_log(damaged).steps())) < len(steps)

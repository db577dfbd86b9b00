"""Recordings of which a part is damaged: the rest is read, and what cannot be read is named."""

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.ouster_packets import NUM_COLUMNS, metadata, record
from helpers.recorded_drive import CLOUD, TOPIC, write_bag1, write_bag2, write_mcap
from mcap.writer import Writer

from segslam.cli.console import FirstOfEachKind
from segslam.core.types import BadScan, SegslamError
from segslam.scans import open_dataset
from segslam.scans.messages import InOrder

SECOND = 10**9


def _drive(first_ns: int = 10 * SECOND, num: int = 6) -> tuple[tuple[int, np.ndarray], ...]:
    rng = np.random.default_rng(0)
    made = []
    for number in range(num):
        rows = np.zeros(30, CLOUD)
        for name in "xyz":
            rows[name] = rng.uniform(-20, 20, 30)
        made.append((first_ns + number * SECOND // 2, rows))
    return tuple(made)


def _flipped(file: Path, share: float) -> Path:
    content = bytearray(file.read_bytes())
    content[int(share * len(content))] ^= 8
    file.write_bytes(content)
    return file


@pytest.mark.parametrize("write", [write_mcap, write_bag1, write_bag2])
def test_a_recording_whose_clock_starts_at_0_is_read_whole(tmp_path: Path, write) -> None:
    data = write(tmp_path / {write_mcap: "a.mcap", write_bag1: "a.bag", write_bag2: "a"}[write], _drive(first_ns=0))
    stamps = [scan.stamp_ns for scan in open_dataset(data, topic=TOPIC)]
    assert stamps == [number * SECOND // 2 for number in range(6)]


@pytest.mark.parametrize("suffix", [".BAG", ".DB3"])
def test_a_bag_whose_extension_is_in_capitals_is_to_be_renamed(tmp_path: Path, suffix: str) -> None:
    write_bag1(tmp_path / "a.bag", _drive(num=1)).rename(tmp_path / f"a{suffix}")
    with pytest.raises(SegslamError, match=rf"in small letters; rename it: a\{suffix.lower()}"):
        open_dataset(tmp_path / f"a{suffix}", topic=TOPIC)


def test_an_ouster_clock_that_starts_at_0_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("helpers.ouster_packets.START_NS", 0)
    data = record(tmp_path, "RNG15_RFL8_NIR8_DUAL", [np.full((NUM_COLUMNS, 2), 3000)] * 2)
    assert [scan.stamp_ns for scan in open_dataset(data)] == [0, 100_000_000]


def test_damage_in_one_chunk_costs_its_scans_only(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a.mcap", _drive(), chunk_size=1000)
    scans = list(open_dataset(whole, topic=TOPIC))
    dataset = open_dataset(_flipped(whole, 0.3), topic=TOPIC)
    rows = [scan.index for scan in dataset]
    assert 0 < len(rows) < len(dataset) == 6
    for index in rows:
        np.testing.assert_array_equal(dataset[index].points, scans[index].points)
        assert dataset[index].stamp_ns == scans[index].stamp_ns
    (lost,) = set(range(6)) - set(rows)
    with pytest.raises(BadScan, match=r"a\.mcap.*cannot be read"):
        dataset[lost]


def _until_the_damage() -> Iterator[int]:
    yield from range(3)
    raise OSError("bad sector")


def test_messages_before_the_damage_are_read_again_and_again() -> None:
    """A reader that raised has ended: without more, the messages after it would be missing without a reason."""
    messages = InOrder(_until_the_damage, 5, num_bytes=1000)
    for _ in range(2):
        assert [messages[index] for index in range(3)] == [0, 1, 2]
        with pytest.raises(OSError, match="bad sector"):
            messages[3]
        with pytest.raises(ValueError, match="the recording is damaged after 3 messages: OSError"):
            messages[4]
        assert messages[1] == 1


def test_messages_that_the_index_invents_are_missed() -> None:
    messages = InOrder(lambda: iter(range(3)), 5, num_bytes=1000)
    with pytest.raises(ValueError, match="ends after 3 of 5 messages"):
        messages[4]
    with pytest.raises(ValueError, match="it claims 1000000000000 messages in 1000 bytes"):
        InOrder(lambda: iter(range(3)), 10**12, num_bytes=1000)


@pytest.mark.parametrize("share", [0.0, 0.4, 0.99])
@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".pcap"])
def test_a_recording_that_cannot_be_opened_is_one_line_with_its_name(tmp_path: Path, suffix: str, share: float) -> None:
    file = tmp_path / f"drive{suffix}"
    content = b""
    if suffix == ".bag":
        content = write_bag1(file, _drive()).read_bytes()
    elif suffix == ".mcap":
        content = write_mcap(file, _drive()).read_bytes()
    else:
        (tmp_path / "drive.json").write_text("{}" if share else str(metadata("LEGACY")).replace("'", '"'))
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(SegslamError, match=rf"^{re.escape(str(file))}: [^\n]*cannot be opened as [^\n]*$"):
        open_dataset(file, topic=TOPIC if suffix != ".pcap" else "")


@pytest.mark.parametrize(
    ("key", "value"), [("columns_per_frame", 10**9), ("columns_per_packet", 0), ("columns_per_packet", 10**12)]
)
def test_a_sensor_that_cannot_exist_is_refused_without_memory_for_it(tmp_path: Path, key: str, value: int) -> None:
    data = record(tmp_path, "LEGACY", [np.full((NUM_COLUMNS, 2), 3000)])
    text = (tmp_path / "drive.json").read_text()
    (tmp_path / "drive.json").write_text(re.sub(rf'"{key}": \d+', f'"{key}": {value}', text))
    with pytest.raises(SegslamError, match=r"drive\.json is not the metadata of an Ouster sensor"):
        open_dataset(data)


def test_a_ros_2_bag_that_a_crash_left_without_metadata_is_refused_with_what_makes_it(tmp_path: Path) -> None:
    whole = open_dataset(write_bag2(tmp_path / "drive"), topic=TOPIC)
    (tmp_path / "drive" / "metadata.yaml").unlink()
    (file,) = (tmp_path / "drive").glob("*.db3")
    with pytest.raises(SegslamError, match=r"drive: no metadata\.yaml.*ros2 bag reindex .*drive\.db3"):
        open_dataset(tmp_path / "drive")
    np.testing.assert_array_equal(open_dataset(file, topic=TOPIC)[1].points, whole[1].points)


def test_a_warning_while_a_recording_is_opened_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Standard error of foreign readers is not."""
    data = record(tmp_path, "RNG15_RFL8_NIR8_DUAL", [np.full((NUM_COLUMNS, 2), 3000)] * 2)
    data.write_bytes(data.read_bytes()[:-10])
    logger, shown = logging.getLogger("segslam"), FirstOfEachKind()
    logger.addHandler(shown)
    try:
        open_dataset(data)
    finally:
        logger.removeHandler(shown)
    assert "the recording is cut short" in capsys.readouterr().err


def _written_by_mcap(file: Path, *, name: str, message_encoding: str, schema_encoding: str, is_repeated: bool) -> Path:
    with file.open("wb") as stream:
        writer = Writer(stream, repeat_channels=is_repeated, repeat_schemas=is_repeated)
        writer.start()
        schema = writer.register_schema(name, schema_encoding, b"uint8[] data")
        channel = writer.register_channel("/points", message_encoding, schema)
        writer.add_message(channel, log_time=SECOND, publish_time=SECOND, data=bytes(64))
        writer.finish()
    return file


def test_clouds_of_another_encoding_in_mcap_are_named_so(tmp_path: Path) -> None:
    how = {"name": "sensor_msgs/PointCloud2", "message_encoding": "json", "schema_encoding": "jsonschema"}
    file = _written_by_mcap(tmp_path / "a.mcap", **how, is_repeated=True)
    with pytest.raises(
        SegslamError, match=r"a\.mcap: messages on /points are encoded as json, not as .*; give the bag from which"
    ):
        open_dataset(file)


def test_an_index_without_schemas_is_named_so(tmp_path: Path) -> None:
    how = {"name": "sensor_msgs/msg/PointCloud2", "message_encoding": "cdr", "schema_encoding": "ros2msg"}
    file = _written_by_mcap(tmp_path / "a.mcap", **how, is_repeated=False)
    with pytest.raises(SegslamError, match=r"a\.mcap: .* lacks channels or schemas; `mcap recover` adds them\); see"):
        open_dataset(file)

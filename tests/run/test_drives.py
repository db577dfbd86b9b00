"""The list of drives of a fleet."""

import re
from dataclasses import replace
from pathlib import Path

import onnx
import pytest
from helpers.made_networks import made_network

from segslam.core.types import SegslamError
from segslam.run.fleets.drives import Drive, drives_of, read_drives

LIST = """
drives:
  - monday.mcap
  - data: week/friday
    name: last
    sequence: 00
    frames: "0:240"
    set: [odometry.max_range_m=60]
  - {data: week/monday, preset: campus}
"""


def _written(folder: Path, text: str) -> Path:
    file = folder / "drives é.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_list_has_paths_relative_to_it_and_the_options_of_map(tmp_path: Path) -> None:
    first, second, third = read_drives(_written(tmp_path, LIST))
    assert first == Drive("monday-1", str(tmp_path / "monday.mcap"))
    settings = ("odometry.max_range_m=60",)
    assert second == Drive("last", str(tmp_path / "week" / "friday"), sequence="00", frames="0:240", set=settings)
    assert (third.name, third.preset) == ("monday-2", "campus")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a list of drives"),
        ("- 1", "drive 1: expected a path or options with data"),
        ("- a\n- {name: b}", "drive 2: expected a path or options with data"),
        ("- {name: b, data: }", "drive 1: expected a path or options with data"),
        ("- a\n- ''", "drive 2: expected a path or options with data"),
        ("- {data: a, frame: '0:3'}", "drive 1: unknown option 'frame'; known: name, data"),
        ("- ~unknown-user/a", "there is no user with this name"),
        ("- {data: a, set: 3}", "drive 1: set: expected texts"),
        ("- {data: a, name: ../b}", "drive 1: name '../b': use letters"),
        ("- {data: a, topic: [1]}", "drive 1: topic: expected a text"),
        ("- a\n- b\n- ./a", "a: given twice with the same options"),
        ("- {data: a, name: b}\n- {data: c, name: b}\n- {data: d, name: b-2}", "b-2: two drives have this name"),
        ("- [", "not valid YAML"),
    ],
)
def test_a_wrong_list_is_one_line_with_the_entry(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SegslamError, match=re.escape(message)) as raised:
        read_drives(_written(tmp_path, text))
    assert "\n" not in str(raised.value)


def test_the_key_changes_with_recording_options_and_version_but_not_with_the_name(tmp_path: Path) -> None:
    scan = tmp_path / "000000.bin"
    scan.write_bytes(bytes(16))
    (drive,) = drives_of([tmp_path])
    key = drive.key("1")
    assert Drive("other", drive.data).key("1") == key
    assert drive.key("2") != key
    assert replace(drive, set=("odometry.max_range_m=60",)).key("1") != key
    scan.write_bytes(bytes(32))
    assert drive.key("1") != key


@pytest.mark.parametrize(
    ("data", "changed"),
    [
        ("linked", "whole/velodyne/0.bin"),
        ("whole/velodyne", "whole/labels/0.label"),
        ("whole/velodyne", "whole/times.txt"),
        ("whole/velodyne", "whole/poses.txt"),
        ("sequences/00", "poses/00.txt"),
        ("os1.pcap", "os1.json"),
    ],
)
def test_the_key_changes_with_linked_folders_and_what_is_beside_the_data(
    data: str, changed: str, tmp_path: Path
) -> None:
    for file in ("whole/velodyne/0.bin", "whole/labels/0.label", "whole/times.txt", "whole/poses.txt"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes(b"1")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "velodyne").symlink_to(tmp_path / "whole" / "velodyne")
    (tmp_path / "whole" / "velodyne" / "again").symlink_to(tmp_path / "linked")  # a circle
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    for name in ("poses/00.txt", "os1.pcap", "os1.json"):
        (tmp_path / name).write_bytes(b"1")
    (drive,) = drives_of([tmp_path / data])
    key = drive.key("1")
    assert drive.key("1") == key
    (tmp_path / changed).write_bytes(b"12")
    assert drive.key("1") != key


def test_a_drive_is_checked_as_in_a_list(tmp_path: Path) -> None:
    """Its paths are absolute on return, because workers have other folders."""
    drive = Drive("last", str(tmp_path), config=str(tmp_path / "c.yaml"), set=("odometry.max_range_m=60",))
    assert drives_of([drive]) == [drive]
    assert drives_of([replace(drive, data="a", labels="network:m.onnx")]) == [
        replace(drive, data=str(Path("a").resolve()), labels=f"network:{Path('m.onnx').resolve()}")
    ]
    for name in ("../b", "a/b", ".a"):
        with pytest.raises(SegslamError, match=re.escape(f"{tmp_path}: name {name!r}: use letters")):
            drives_of([replace(drive, name=name)])


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="nothing: no such file"):
        drives_of([tmp_path / "nothing"])[0].key("1")


def test_a_network_is_relative_to_the_list_and_labels_elsewhere_change_the_key(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "labels").mkdir()
    (tmp_path / "m.onnx").write_bytes(b"1")
    entries = "- {data: a, labels: 'network:m.onnx'}\n- {data: a, labels: " + str(tmp_path / "labels") + "}\n"
    (tmp_path / "drives.yaml").write_text(entries)
    drives = read_drives(tmp_path / "drives.yaml")
    assert drives[0].labels == f"network:{tmp_path.resolve() / 'm.onnx'}"
    before = [drive.key("1") for drive in drives]
    (tmp_path / "m.onnx").write_bytes(b"12")
    (tmp_path / "labels" / "0.label").write_bytes(b"1")
    assert all(one != drive.key("1") for one, drive in zip(before, drives, strict=True))


def test_the_settings_of_a_network_change_the_key(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    model = tmp_path / "m.onnx"
    model.write_bytes(b"1")
    (drive,) = read_drives(_written(tmp_path, f"- {{data: a, labels: 'network:{model}'}}"))
    shared = "field_of_view_deg: [-20, 20]\nheight: 4\nwidth: 8\nchannels: [range]\nmean: [10]\nstd: [5]\n"
    keys = []
    for classes in ("car, road", "road, car", "road, car"):
        model.with_suffix(".yaml").write_text(f"{shared}classes: [{classes}]\n")
        keys.append(drive.key("1"))
    assert keys[0] != keys[1] == keys[2]


def test_weights_in_a_separate_file_change_the_key(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    model = made_network(tmp_path)
    onnx.save(onnx.load(model), model, save_as_external_data=True, location="weights of it", size_threshold=0)
    (drive,) = read_drives(_written(tmp_path, f"- {{data: a, labels: 'network:{model}'}}"))
    key = drive.key("1")
    assert drive.key("1") == key
    with (tmp_path / "weights of it").open("ab") as stream:
        stream.write(b"1")
    assert drive.key("1") != key

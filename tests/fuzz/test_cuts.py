"""Files cut at every byte, as by a full disk or a copy that was interrupted: none is taken for whole."""

import logging
from pathlib import Path

import numpy as np
import pytest

from fuzz import seeds
from segslam.core.types import BadScan, SegslamError
from segslam.scans import open_dataset
from segslam.scans.clouds import read_file

FEW = 6


def _clouds() -> list[tuple[str, bytes, int]]:
    """Suffix, content, and number of bytes at the end that may be missing: the end of the last line, other elements."""
    made = []
    for dtype in (seeds.ROW, seeds.LONG_ROW):
        rows = seeds.rows(dtype, FEW)
        made += [(".ply", seeds.ply(rows, form), 0) for form in seeds.FORMATS]
        made += [(".pcd", seeds.pcd(rows, form), 0) for form in seeds.ENCODINGS]
    face = b"element face 1\nproperty list uchar int vertex_indices\n", b"\x03" + bytes(12)
    made.append((".ply", seeds.ply(seeds.rows(seeds.ROW, FEW), seeds.FORMATS[1], after=face), len(face[1])))
    made += [(".npy", seeds.npy(np.ones((FEW, 4), kind)), 0) for kind in (np.float32, np.float64)]
    return made


@pytest.mark.parametrize(("suffix", "content", "spare"), _clouds())
def test_a_cloud_cut_anywhere_is_refused(tmp_path: Path, suffix: str, content: bytes, spare: int) -> None:
    file = tmp_path / f"0{suffix}"
    file.write_bytes(content)
    whole = read_file(file).points
    for size in range(len(content)):
        file.write_bytes(content[:size])
        if size >= len(content) - spare:
            np.testing.assert_array_equal(read_file(file).points, whole)
            continue
        with pytest.raises(BadScan, match=r"0\.[a-z]+: "):
            read_file(file)


def test_a_bin_cut_within_a_point_is_refused(tmp_path: Path) -> None:
    """Between two points nothing in the file tells how many there were."""
    content = seeds.rows(seeds.ROW, FEW).tobytes()
    file = tmp_path / "0.bin"
    for size in range(len(content)):
        file.write_bytes(content[:size])
        if size % 16:
            with pytest.raises(BadScan, match="truncated"):
                read_file(file)


@pytest.mark.parametrize("kind", ["mcap", "chunked mcap", "bag"])
def test_a_recording_cut_anywhere_is_refused(tmp_path: Path, kind: str) -> None:
    content = {
        "mcap": lambda: seeds.mcap(tmp_path, 2**20),
        "chunked mcap": lambda: seeds.mcap(tmp_path, 1),
        "bag": lambda: seeds.bag1(tmp_path),
    }[kind]()
    file = tmp_path / ("cut.bag" if kind == "bag" else "cut.mcap")
    for size in range(0, len(content), 13):
        file.write_bytes(content[:size])
        with pytest.raises(SegslamError, match=r"cut\.(mcap|bag): cannot be opened"):
            open_dataset(file, topic="/lidar/points")


def test_packets_before_a_cut_are_read_and_a_cut_packet_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Between two packets nothing in the file tells how many there were."""
    content, _ = seeds.pcap(tmp_path)
    file = tmp_path / "drive.pcap"
    ends = [24]
    while ends[-1] < len(content):
        ends.append(ends[-1] + 16 + int.from_bytes(content[ends[-1] + 8 : ends[-1] + 12], "little"))
    for size in range(0, len(content), 11):
        file.write_bytes(content[:size])
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            refused = _refusal(file)
        assert "drive.pcap" in refused or (not refused and (size in ends or "cut short" in caplog.text))


def _refusal(data: Path) -> str:
    try:
        open_dataset(data)
    except SegslamError as error:
        return str(error)
    return ""

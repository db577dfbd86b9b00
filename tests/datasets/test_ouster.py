"""Ouster's packets in a pcap file, written byte by byte according to its manual, and read as scans."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from segslam.datasets import open_dataset
from segslam.types import SegslamError

NUM_COLUMNS, PER_PACKET = 16, 4
ALTITUDE_DEG = [0.0, 30.0]
CHANNEL_BYTES = {
    "LEGACY": 12,
    "RNG19_RFL8_SIG16_NIR16": 12,
    "RNG19_RFL8_SIG16_NIR16_DUAL": 16,
    "RNG15_RFL8_NIR8_DUAL": 8,
}
REFLECTIVITY = 201
START_NS = 1_700_000_000_123_456_789


def _metadata(profile: str, **changes: object) -> dict:
    half_turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.0, 0, 0, 0, 1]
    return {
        "beam_intrinsics": {
            "beam_altitude_angles": ALTITUDE_DEG,
            "beam_azimuth_angles": [0.0, 0.0],
            "lidar_origin_to_beam_origin_mm": 15.0,
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": half_turn},
        "lidar_data_format": {
            "columns_per_frame": NUM_COLUMNS,
            "columns_per_packet": PER_PACKET,
            "udp_profile_lidar": profile,
        },
        "config_params": {"udp_port_lidar": 7502},
    } | changes


def _column(profile: str, frame: int, number: int, ranges_mm: np.ndarray, *, valid: bool = True) -> bytes:
    stamp_ns = START_NS + frame * 100_000_000 + number * 1_000_000
    channels = b""
    for range_mm in ranges_mm:
        if profile.startswith("RNG15"):
            beam = struct.pack("<HBB", int(range_mm) // 8 | 0x8000, REFLECTIVITY, 7)
        elif profile.endswith("DUAL"):
            beam = struct.pack("<I", int(range_mm) | 0xF80000 | REFLECTIVITY << 24)
        else:
            size = "H" if profile == "LEGACY" else "Bx"
            beam = struct.pack(f"<I{size}", int(range_mm) | 0xFFF00000, REFLECTIVITY)
        channels += beam.ljust(CHANNEL_BYTES[profile], b"\xff")
    if profile == "LEGACY":
        header = struct.pack("<QHHI", stamp_ns, number, frame, 0)
        return header + channels + (b"\xff" * 4 if valid else b"\0" * 4)
    return struct.pack("<QHH", stamp_ns, number, int(valid)) + channels


def _frames(profile: str, ranges_mm: list[np.ndarray]) -> Iterator[bytes]:
    """The packets of some frames, each frame (columns, beams) ranges; columns of negative range are not valid."""
    around = b"" if profile == "LEGACY" else b"\xee" * 32
    for frame, image in enumerate(ranges_mm):
        for first in range(0, NUM_COLUMNS, PER_PACKET):
            rows = range(first, first + PER_PACKET)
            columns = [_column(profile, frame, row, abs(image[row]), valid=image[row].min() >= 0) for row in rows]
            yield around + b"".join(columns) + around


def _datagrams(
    payload: bytes, *, port: int = 7502, number: int = 1, mtu: int = 1500, vlan: bool = False
) -> list[bytes]:
    """Ethernet frames that carry the payload, in as many fragments as it takes."""
    datagram = struct.pack(">HHHH", 40_000, port, 8 + len(payload), 0) + payload
    step = (mtu - 20) // 8 * 8
    frames = []
    for offset in range(0, len(datagram), step):
        piece = datagram[offset : offset + step]
        flags = offset // 8 | (0x2000 if offset + step < len(datagram) else 0)
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(piece), number, flags, 64, 17, 0) + b"\x0a\0\0\1\x0a\0\0\2"
        link = b"\0" * 12 + (b"\x81\0\0\x05\x08\0" if vlan else b"\x08\0")
        frames.append(link + ip + piece + b"\0" * 4)  # padded, as short frames are
    return frames


def _write(folder: Path, packets: list[bytes], metadata: dict | None = None, *, link: int = 1) -> Path:
    folder.mkdir(exist_ok=True)
    header = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    records = b"".join(struct.pack("<IIII", 1, 0, len(packet), len(packet)) + packet for packet in packets)
    (folder / "drive.pcap").write_bytes(header + records)
    if metadata is not None:
        (folder / "drive.json").write_text(json.dumps(metadata))
    return folder / "drive.pcap"


def _record(folder: Path, profile: str, ranges_mm: list[np.ndarray], **how: Any) -> Path:
    packets = [_datagrams(packet, number=i, **how) for i, packet in enumerate(_frames(profile, ranges_mm))]
    return _write(folder, [frame for frames in packets for frame in frames], _metadata(profile))


def _one_return(column: int, beam: int, range_mm: int) -> np.ndarray:
    image = np.zeros((NUM_COLUMNS, 2))
    image[column, beam] = range_mm
    return image


@pytest.mark.parametrize("profile", CHANNEL_BYTES)
def test_beam_directions_are_those_of_the_manual(tmp_path: Path, profile: str) -> None:
    """The turned sensor looks along +x at the middle of its turn, which goes clockwise; beams leave 15 mm out."""
    file = _record(tmp_path, profile, [_one_return(8, 0, 2000), _one_return(12, 0, 2000), _one_return(8, 1, 2000)])
    ahead, right, up = open_dataset(file)
    np.testing.assert_allclose(ahead.points, [[2.0, 0.0, 0.036]], atol=1e-6)
    np.testing.assert_allclose(right.points, [[0.0, -2.0, 0.036]], atol=1e-6)
    along, height = 1.985 * np.cos(np.pi / 6) + 0.015, 1.985 * 0.5 + 0.036
    np.testing.assert_allclose(up.points, [[along, 0.0, height]], atol=1e-6)
    assert [scan.intensities for scan in open_dataset(file, intensities=True)] == [REFLECTIVITY] * 3


def test_stamps_and_times_are_the_sensors(tmp_path: Path) -> None:
    image = np.full((NUM_COLUMNS, 2), 3000)
    scans = list(open_dataset(_record(tmp_path, "RNG19_RFL8_SIG16_NIR16", [image, image])))
    assert [scan.stamp_ns for scan in scans] == [START_NS, START_NS + 100_000_000]
    np.testing.assert_allclose(scans[1].times, np.repeat(np.arange(16) / 15, 2))


@pytest.mark.parametrize("how", [{"mtu": 64}, {"vlan": True}, {"mtu": 64, "vlan": True}])
def test_split_and_tagged_packets_give_the_same_points(tmp_path: Path, how: dict) -> None:
    image = np.arange(1000, 1000 + 2 * NUM_COLUMNS).reshape(NUM_COLUMNS, 2) * 8
    whole = open_dataset(_record(tmp_path / "whole", "RNG15_RFL8_NIR8_DUAL", [image] * 2))
    other = open_dataset(_record(tmp_path / "other", "RNG15_RFL8_NIR8_DUAL", [image] * 2, **how))
    assert len(whole) == len(other) == 2
    np.testing.assert_array_equal(whole[1].points, other[1].points)
    assert len(whole[1].points) == 2 * NUM_COLUMNS


def test_other_packets_and_lost_ones_are_left_out(tmp_path: Path) -> None:
    """Inertial packets, another sensor's, a datagram that lost a fragment, and a column marked as not valid."""
    image = np.full((NUM_COLUMNS, 2), 3000)
    image[0] = -3000
    packets = list(_frames("LEGACY", [image, image]))
    frames = [_datagrams(b"inertia" * 7, port=7503), *(_datagrams(p, number=i) for i, p in enumerate(packets))]
    frames.append(_datagrams(packets[0], port=7600))
    split = _datagrams(packets[5], number=5, mtu=64)
    frames[6] = split[:1] + split[2:]
    dataset = open_dataset(_write(tmp_path, [frame for group in frames for frame in group], _metadata("LEGACY")))
    assert [len(scan.points) for scan in dataset] == [2 * 15, 2 * 11]


def test_recording_cut_short_is_read_up_to_the_cut(tmp_path: Path) -> None:
    file = _record(tmp_path, "LEGACY", [np.full((NUM_COLUMNS, 2), 3000)] * 2)
    file.write_bytes(file.read_bytes()[:-10])
    assert [len(scan.points) for scan in open_dataset(file)] == [32, 24]


def test_older_metadata_without_sections_are_read_as_well(tmp_path: Path) -> None:
    file = _record(tmp_path, "LEGACY", [_one_return(8, 0, 2000)])
    flat = {key: value for section in _metadata("LEGACY").values() for key, value in section.items()}
    del flat["udp_profile_lidar"], flat["udp_port_lidar"]
    (tmp_path / "drive.json").write_text(json.dumps(flat))
    np.testing.assert_allclose(open_dataset(file)[0].points, [[2.0, 0.0, 0.036]], atol=1e-6)


@pytest.mark.parametrize(
    ("metadata", "start", "message"),
    [
        (None, b"", r"metadata are missing: put them beside the recording as drive\.json"),
        (_metadata("RGB"), b"", "packets of profile RGB; known: LEGACY"),
        (_metadata("LEGACY", lidar_intrinsics={}), b"", "has no key 'lidar_to_sensor_transform'"),
        (_metadata("RNG19_RFL8_SIG16_NIR16"), b"", "finds no scan in it"),
        (_metadata("LEGACY"), b"\x0a\x0d\x0d\x0a", "not the classic pcap format; convert it with `editcap"),
        (_metadata("LEGACY"), b"nonsense", "not the classic pcap format"),
    ],
)
def test_unusable_recordings_are_refused_with_the_reason(
    tmp_path: Path, metadata: dict | None, start: bytes, message: str
) -> None:
    file = _record(tmp_path, "LEGACY", [_one_return(8, 0, 2000)])
    file.write_bytes(start + file.read_bytes()[len(start) :])
    (tmp_path / "drive.json").unlink()
    if metadata is not None:
        (tmp_path / "drive.json").write_text(json.dumps(metadata))
    with pytest.raises(SegslamError, match=message):
        open_dataset(file)


def test_unknown_link_and_empty_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="unknown link type 9"):
        open_dataset(_write(tmp_path, [], _metadata("LEGACY"), link=9))
    (tmp_path / "drive.pcap").write_bytes(b"")
    with pytest.raises(SegslamError, match=r"drive\.pcap: cannot be opened as ouster data"):
        open_dataset(tmp_path / "drive.pcap")

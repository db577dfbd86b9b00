"""Ouster's packets in a pcap file, read as scans."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.ouster_packets import (
    CHANNEL_BYTES,
    NUM_COLUMNS,
    REFLECTIVITY,
    START_NS,
    datagrams,
    frames,
    metadata,
    one_return,
    record,
    write,
)

from segslam.core.types import SegslamError
from segslam.scans import open_dataset
from segslam.scans.pcap import REASSEMBLY_BYTES, udp_payloads


@pytest.mark.parametrize("profile", CHANNEL_BYTES)
def test_beam_directions_are_those_of_the_manual(tmp_path: Path, profile: str) -> None:
    """The turned sensor looks along +x at the middle of its turn, which goes clockwise; beams leave 15 mm out."""
    file = record(tmp_path, profile, [one_return(8, 0, 2000), one_return(12, 0, 2000), one_return(8, 1, 2000)])
    ahead, right, up = open_dataset(file)
    np.testing.assert_allclose(ahead.points, [[2.0, 0.0, 0.036]], atol=1e-6)
    np.testing.assert_allclose(right.points, [[0.0, -2.0, 0.036]], atol=1e-6)
    along, height = 1.985 * np.cos(np.pi / 6) + 0.015, 1.985 * 0.5 + 0.036
    np.testing.assert_allclose(up.points, [[along, 0.0, height]], atol=1e-6)
    assert [scan.intensities for scan in open_dataset(file, intensities=True)] == [REFLECTIVITY] * 3


def test_stamps_and_times_are_the_sensors(tmp_path: Path) -> None:
    image = np.full((NUM_COLUMNS, 2), 3000)
    scans = list(open_dataset(record(tmp_path, "RNG19_RFL8_SIG16_NIR16", [image, image])))
    assert [scan.stamp_ns for scan in scans] == [START_NS, START_NS + 100_000_000]
    np.testing.assert_allclose(scans[1].times, np.repeat(np.arange(16) / 15, 2))


@pytest.mark.parametrize("profile", ["LEGACY", "RNG15_RFL8_NIR8_DUAL"])
def test_frames_of_a_sensor_with_an_azimuth_window_are_separated(tmp_path: Path, profile: str) -> None:
    half_turn = np.full((NUM_COLUMNS // 2, 2), 3000)
    scans = list(open_dataset(record(tmp_path, profile, [half_turn] * 3)))
    assert [(scan.stamp_ns - START_NS, len(scan.points)) for scan in scans] == [
        (frame * 100_000_000, NUM_COLUMNS) for frame in range(3)
    ]


def test_a_late_packet_belongs_to_its_frame(tmp_path: Path) -> None:
    profile = "RNG19_RFL8_SIG16_NIR16"
    packets = [datagrams(p, number=i) for i, p in enumerate(frames(profile, [np.full((NUM_COLUMNS, 2), 3000)] * 2))]
    packets[3], packets[4] = packets[4], packets[3]
    dataset = open_dataset(write(tmp_path, [frame for group in packets for frame in group], metadata(profile)))
    assert [len(scan.points) for scan in dataset] == [2 * NUM_COLUMNS] * 2


def test_the_header_of_functional_safety_numbers_frames_elsewhere(tmp_path: Path) -> None:
    profile = "RNG19_RFL8_SIG16_NIR16"
    packets = [
        p[:2] + b"\0\0" + (70_000 + number // 4).to_bytes(4, "little") + p[8:]
        for number, p in enumerate(frames(profile, [np.full((NUM_COLUMNS, 2), 3000)] * 2))
    ]
    known = metadata(profile)
    known["lidar_data_format"]["header_type"] = "FUSA"
    sent = [frame for number, p in enumerate(packets) for frame in datagrams(p, number=number)]
    assert [len(scan.points) for scan in open_dataset(write(tmp_path, sent, known))] == [2 * NUM_COLUMNS] * 2
    known["lidar_data_format"]["header_type"] = "OTHER"
    with pytest.raises(SegslamError, match="headers of type OTHER; known: STANDARD, FUSA"):
        open_dataset(write(tmp_path, sent, known))


@pytest.mark.parametrize("how", [{"mtu": 64}, {"vlan": True}, {"mtu": 64, "vlan": True}])
def test_split_and_tagged_packets_give_the_same_points(tmp_path: Path, how: dict) -> None:
    image = np.arange(1000, 1000 + 2 * NUM_COLUMNS).reshape(NUM_COLUMNS, 2) * 8
    whole = open_dataset(record(tmp_path / "whole", "RNG15_RFL8_NIR8_DUAL", [image] * 2))
    other = open_dataset(record(tmp_path / "other", "RNG15_RFL8_NIR8_DUAL", [image] * 2, **how))
    assert len(whole) == len(other) == 2
    np.testing.assert_array_equal(whole[1].points, other[1].points)
    assert len(whole[1].points) == 2 * NUM_COLUMNS


def test_other_packets_and_lost_ones_are_left_out(tmp_path: Path) -> None:
    """Inertial packets, another sensor's, a datagram that lost a fragment, and a column marked as not valid."""
    image = np.full((NUM_COLUMNS, 2), 3000)
    image[0] = -3000
    packets = list(frames("LEGACY", [image, image]))
    sent = [datagrams(b"inertia" * 7, port=7503), *(datagrams(p, number=i) for i, p in enumerate(packets))]
    sent.append(datagrams(packets[0], port=7600))
    split = datagrams(packets[5], number=5, mtu=64)
    sent[6] = split[:1] + split[2:]
    dataset = open_dataset(write(tmp_path, [frame for group in sent for frame in group], metadata("LEGACY")))
    assert [len(scan.points) for scan in dataset] == [2 * 15, 2 * 11]


def test_recording_cut_short_is_read_up_to_the_cut(tmp_path: Path) -> None:
    file = record(tmp_path, "LEGACY", [np.full((NUM_COLUMNS, 2), 3000)] * 2)
    file.write_bytes(file.read_bytes()[:-10])
    assert [len(scan.points) for scan in open_dataset(file)] == [32, 24]


def test_older_metadata_without_sections_are_read_as_well(tmp_path: Path) -> None:
    file = record(tmp_path, "LEGACY", [one_return(8, 0, 2000)])
    flat = {key: value for section in metadata("LEGACY").values() for key, value in section.items()}
    del flat["udp_profile_lidar"], flat["udp_port_lidar"]
    (tmp_path / "drive.json").write_text(json.dumps(flat))
    np.testing.assert_allclose(open_dataset(file)[0].points, [[2.0, 0.0, 0.036]], atol=1e-6)


@pytest.mark.parametrize(
    ("metadata", "start", "message"),
    [
        (None, b"", r"metadata are missing: put them beside the recording as drive\.json.* of sensors other than"),
        (metadata("RGB"), b"", "packets of profile RGB; known: LEGACY"),
        (metadata("LEGACY", lidar_intrinsics={}), b"", "has no key 'lidar_to_sensor_transform'"),
        (metadata("RNG19_RFL8_SIG16_NIR16"), b"", "finds no scan in it"),
        (metadata("LEGACY"), b"\x0a\x0d\x0d\x0a", "not the classic pcap format; convert it with `editcap"),
        (metadata("LEGACY"), b"nonsense", "not the classic pcap format"),
    ],
)
def test_unusable_recordings_are_refused_with_the_reason(
    tmp_path: Path, metadata: dict | None, start: bytes, message: str
) -> None:
    file = record(tmp_path, "LEGACY", [one_return(8, 0, 2000)])
    file.write_bytes(start + file.read_bytes()[len(start) :])
    (tmp_path / "drive.json").unlink()
    if metadata is not None:
        (tmp_path / "drive.json").write_text(json.dumps(metadata))
    with pytest.raises(SegslamError, match=message):
        open_dataset(file)


def test_unknown_link_and_empty_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="unknown link type 9"):
        open_dataset(write(tmp_path, [], metadata("LEGACY"), link=9))
    (tmp_path / "drive.pcap").write_bytes(b"")
    with pytest.raises(SegslamError, match=r"drive\.pcap: cannot be opened as ouster data"):
        open_dataset(tmp_path / "drive.pcap")


def test_a_lost_fragment_does_no_harm_to_the_next_datagram_of_its_number() -> None:
    num_bytes, head = 2000, b"\xd4\xc3\xb2\xa1" + struct.pack("<HHIIII", 2, 4, 0, 0, 65535, 101)

    def fragment(offset: int, more: bool, body: bytes) -> bytes:
        place = (0x2000 if more else 0) | offset // 8
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), 5, place, 64, 17, 0, b"\x0a\0\0\1", b"\x0a\0\0\2")
        return struct.pack("<IIII", 0, 0, len(ip + body), len(ip + body)) + ip + body

    def first(fill: bytes) -> bytes:
        return fragment(0, True, struct.pack(">HHHH", 7502, 7502, num_bytes + 8, 0) + fill * 1472)

    def rest(fill: bytes) -> bytes:
        return fragment(1480, False, fill * (num_bytes - 1472))

    others = fragment(8, True, bytes(1400)) * (REASSEMBLY_BYTES // 1400 + 1)  # of a datagram that stays incomplete
    content = head + rest(b"a") + others.replace(b"\x0a\0\0\1", b"\x0a\0\0\3") + first(b"b") + rest(b"b")
    content += rest(b"c") + first(b"c")
    found = [
        b"".join(content[piece] for piece in pieces) for pieces in udp_payloads(content, num_bytes=num_bytes, port=None)
    ]
    assert found == [b"b" * num_bytes, b"c" * num_bytes]

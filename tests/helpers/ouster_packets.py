"""Ouster's packets in a pcap file, written byte by byte according to its manual."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

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


def metadata(profile: str, **changes: object) -> dict:
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


def column(profile: str, frame: int, number: int, ranges_mm: np.ndarray, *, valid: bool = True) -> bytes:
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


def frames(profile: str, ranges_mm: list[np.ndarray]) -> Iterator[bytes]:
    """The packets of some frames, each frame (columns, beams) ranges; columns of negative range are not valid.

    A frame may have fewer columns, as that of a sensor with an azimuth window.
    """
    for frame, image in enumerate(ranges_mm):
        header = b"" if profile == "LEGACY" else struct.pack("<HH", 1, 65_535 + frame & 0xFFFF).ljust(32, b"\xee")
        for first in range(0, len(image), PER_PACKET):
            rows = range(first, first + PER_PACKET)
            columns = [column(profile, frame, row, abs(image[row]), valid=image[row].min() >= 0) for row in rows]
            yield header + b"".join(columns) + b"\xee" * len(header)


def datagrams(payload: bytes, *, port: int = 7502, number: int = 1, mtu: int = 1500, vlan: bool = False) -> list[bytes]:
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


def write(folder: Path, packets: list[bytes], metadata: dict | None = None, *, link: int = 1) -> Path:
    folder.mkdir(exist_ok=True)
    header = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    records = b"".join(struct.pack("<IIII", 1, 0, len(packet), len(packet)) + packet for packet in packets)
    (folder / "drive.pcap").write_bytes(header + records)
    if metadata is not None:
        (folder / "drive.json").write_text(json.dumps(metadata))
    return folder / "drive.pcap"


def record(folder: Path, profile: str, ranges_mm: list[np.ndarray], **how: Any) -> Path:
    packets = [datagrams(packet, number=i, **how) for i, packet in enumerate(frames(profile, ranges_mm))]
    return write(folder, [frame for frames in packets for frame in frames], metadata(profile))


def one_return(column: int, beam: int, range_mm: int) -> np.ndarray:
    image = np.zeros((NUM_COLUMNS, 2))
    image[column, beam] = range_mm
    return image

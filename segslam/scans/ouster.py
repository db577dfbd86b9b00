"""Ouster recordings: a pcap of the sensor's UDP packets, and the JSON metadata of the same session beside it.

kiss_icp's reader requires one release of ouster-sdk, which supports Python 3.11 and 3.12 only and requires versions
of rosbags, kiss-icp and numpy that conflict with those of this package. The packet format is documented in Ouster's
firmware manual, sections "Lidar Data" and "Coordinate Frames and XYZ Calculation".
"""

import json
import mmap
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from segslam.scans.dataset import Cloud
from segslam.scans.pcap import udp_payloads


class _Channel(NamedTuple):
    """Format of the data per beam in a packet: the first range, and its reflectivity."""

    num_bytes: int
    range_type: str
    range_bits: int
    mm_per_count: int
    reflectivity_type: str
    reflectivity_offset: int

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(
            {
                "names": ["range", "reflectivity"],
                "formats": [self.range_type, self.reflectivity_type],
                "offsets": [0, self.reflectivity_offset],
                "itemsize": self.num_bytes,
            }
        )


CHANNELS = {
    "LEGACY": _Channel(12, "<u4", 20, 1, "<u2", 4),
    "RNG19_RFL8_SIG16_NIR16": _Channel(12, "<u4", 19, 1, "u1", 4),
    "RNG19_RFL8_SIG16_NIR16_DUAL": _Channel(16, "<u4", 19, 1, "u1", 3),
    "RNG15_RFL8_NIR8": _Channel(4, "<u2", 15, 8, "u1", 2),
    "RNG15_RFL8_NIR8_DUAL": _Channel(8, "<u2", 15, 8, "u1", 2),
    "FUSA_RNG15_RFL8_NIR8_DUAL": _Channel(8, "<u2", 15, 8, "u1", 2),
}
"""By profile name."""
HEADER_BYTES = 32
"""Bytes before and after the columns of a packet, except in the legacy profile."""
FRAME_IDS = {"STANDARD": ("<u2", 2), "FUSA": ("<u4", 4)}
"""Type of the frame's number in the header of a packet, and its offset; the legacy profile has it in each column."""
MAX_COLUMNS, MAX_BEAMS = 4096, 256
"""Largest numbers in metadata. Chosen: the largest sensors have 4096 columns and 128 beams."""


@dataclass(frozen=True, slots=True)
class _Sensor:
    """The sensor's metadata, from either of the two layouts."""

    profile: str
    header: str
    """Key of FRAME_IDS."""
    port: int | None
    columns_per_frame: int
    columns_per_packet: int
    altitude_rad: np.ndarray
    azimuth_rad: np.ndarray
    beam_origin_mm: float
    """Distance of the beam origins in front of their axis of rotation."""
    T_sensor_lidar_mm: np.ndarray

    @property
    def column_dtype(self) -> np.dtype:
        channels = ("channels", CHANNELS[self.profile].dtype, len(self.altitude_rad))
        stamped = [("stamp_ns", "<u8"), ("measurement", "<u2")]
        if self.profile == "LEGACY":
            return np.dtype([*stamped, ("frame", "<u2"), ("encoder", "<u4"), channels, ("status", "<u4")])
        return np.dtype([*stamped, ("status", "<u2"), channels])

    @property
    def header_bytes(self) -> int:
        return 0 if self.profile == "LEGACY" else HEADER_BYTES

    def __post_init__(self) -> None:
        """Raises ValueError for values that no sensor has."""
        numbers = (self.altitude_rad, self.azimuth_rad, self.T_sensor_lidar_mm, np.array(self.beam_origin_mm))
        if not 1 <= self.columns_per_packet <= self.columns_per_frame <= MAX_COLUMNS:
            raise ValueError(f"{self.columns_per_frame} columns per frame, {self.columns_per_packet} per packet")
        if self.altitude_rad.shape != self.azimuth_rad.shape or not 1 <= self.altitude_rad.size <= MAX_BEAMS:
            raise ValueError(f"{self.altitude_rad.size} elevations and {self.azimuth_rad.size} azimuths of beams")
        if self.altitude_rad.ndim != 1 or not all(np.isfinite(each).all() for each in numbers):
            raise ValueError("angles or distances that are not numbers")


class OusterFrames:
    """The frames of a recording: points in the sensor's frame. Replaces kiss_icp's reader.

    Raises ValueError if the file is not a pcap or the metadata do not match its packets, FileNotFoundError if there are
    no metadata.
    """

    def __init__(self, file: Path) -> None:
        self._sensor = _read_sensor(_metadata_of(file))
        with file.open("rb") as stream:
            self._content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self._frames = self._find_frames()

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Cloud:
        """The beams that returned; times (s) count from the first column, whose stamp is that of the cloud."""
        columns = np.concatenate([self._columns(payload) for payload in self._frames[index]])
        columns = columns[(columns["status"] & 1).astype(bool)]
        if len(columns) == 0:
            raise ValueError("no valid column in this frame")
        first_ns = columns["stamp_ns"].min()
        channel = CHANNELS[self._sensor.profile]
        counts = columns["channels"]["range"] & ((1 << channel.range_bits) - 1)
        ranges_mm = counts.astype(np.float64) * channel.mm_per_count
        column, beam = np.nonzero(ranges_mm)
        rays, origins = self._rays_and_origins
        measured = columns["measurement"][column].astype(np.intp)
        points_mm = rays[measured, beam] * ranges_mm[column, beam, None] + origins[measured, beam]
        return Cloud(
            points_mm * 1e-3,
            ((columns["stamp_ns"] - first_ns) * 1e-9)[column],
            columns["channels"]["reflectivity"][column, beam].astype(np.float64),
            int(first_ns),
        )

    def _find_frames(self) -> list[list[list[slice]]]:
        """Payloads by frame, as their packets are numbered; a packet of the frame before may arrive late."""
        sensor = self._sensor
        frames: list[list[list[slice]]] = []
        recent: dict[int, list[list[slice]]] = {}
        num_bytes = 2 * sensor.header_bytes + sensor.columns_per_packet * sensor.column_dtype.itemsize
        for payload in udp_payloads(self._content, num_bytes=num_bytes, port=sensor.port):
            number = self._frame_number(payload)
            if number not in recent:
                frames.append([])
                recent = dict([*recent.items()][-1:]) | {number: frames[-1]}
            recent[number].append(payload)
        return frames

    def _frame_number(self, payload: list[slice]) -> int:
        if self._sensor.profile == "LEGACY":
            return int(self._columns(payload)["frame"][0])
        kind, offset = FRAME_IDS[self._sensor.header]
        return int(np.frombuffer(self._packet(payload), kind, 1, offset)[0])

    def _packet(self, payload: list[slice]) -> bytes:
        return b"".join(self._content[piece] for piece in payload)

    def _columns(self, payload: list[slice]) -> np.ndarray:
        sensor, packet = self._sensor, self._packet(payload)
        return np.frombuffer(packet, sensor.column_dtype, sensor.columns_per_packet, offset=sensor.header_bytes)

    @cached_property
    def _rays_and_origins(self) -> tuple[np.ndarray, np.ndarray]:
        """(columns, beams, 3) each: a point (mm) of the sensor's frame is its range (mm) times ray plus origin."""
        sensor = self._sensor
        encoder = 2 * np.pi * (1 - np.arange(sensor.columns_per_frame) / sensor.columns_per_frame)[:, None]
        heading = encoder - sensor.azimuth_rad
        level = np.cos(sensor.altitude_rad)
        ray = np.cos(heading) * level, np.sin(heading) * level, np.sin(sensor.altitude_rad)
        rays = np.stack(np.broadcast_arrays(*ray), axis=-1)
        axis = np.stack([np.cos(encoder), np.sin(encoder), np.zeros_like(encoder)], axis=-1)
        rotation, shift = sensor.T_sensor_lidar_mm[:3, :3], sensor.T_sensor_lidar_mm[:3, 3]
        return rays @ rotation.T, (axis - rays) * sensor.beam_origin_mm @ rotation.T + shift


def _metadata_of(file: Path) -> Path:
    """The JSON file in the same folder whose name starts like the recording's, or the only JSON file."""
    beside = sorted(file.resolve().parent.glob("*.json"))
    alike = [path for path in beside if path.stem.startswith(file.stem) or file.stem.startswith(path.stem)]
    found = alike or beside
    if len(found) != 1 and file.with_suffix(".json") not in found:
        missing = f"the sensor's metadata are missing: put them beside the recording as {file.stem}.json"
        raise FileNotFoundError(f"{missing}; of sensors other than Ouster's, give a bag with point clouds, not packets")
    return found[0] if len(found) == 1 else file.with_suffix(".json")


def _read_sensor(file: Path) -> _Sensor:
    """Raises ValueError, naming the file, for metadata that no sensor has."""
    try:
        values = _flat(json.loads(file.read_text(encoding="utf-8")))
        profile = str(values.get("udp_profile_lidar", "LEGACY"))
        if profile not in CHANNELS:
            raise ValueError(f"packets of profile {profile}; known: {', '.join(CHANNELS)}")
        by_profile = "FUSA" if profile.startswith("FUSA") else "STANDARD"
        header = str(values.get("header_type", by_profile))  # since firmware 3.2
        if header not in FRAME_IDS:
            raise ValueError(f"packets with headers of type {header}; known: {', '.join(FRAME_IDS)}")
        return _Sensor(
            profile=profile,
            header=header,
            port=int(values.get("udp_port_lidar") or 0) or None,
            columns_per_frame=int(values["columns_per_frame"]),
            columns_per_packet=int(values["columns_per_packet"]),
            altitude_rad=np.radians(values["beam_altitude_angles"]),
            azimuth_rad=np.radians(values["beam_azimuth_angles"]),
            beam_origin_mm=float(values["lidar_origin_to_beam_origin_mm"]),
            T_sensor_lidar_mm=np.asarray(values["lidar_to_sensor_transform"], dtype=float).reshape(4, 4),
        )
    except KeyError as error:
        raise ValueError(f"{file.name} has no key {error}; it must be the metadata of an Ouster sensor") from error
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{file.name} is not the metadata of an Ouster sensor ({error})") from error


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    """The keys of all sections in one mapping; older metadata have no sections."""
    flat = {key: value for key, value in values.items() if not isinstance(value, dict)}
    for section in values.values():
        flat |= _flat(section) if isinstance(section, dict) else {}
    return flat

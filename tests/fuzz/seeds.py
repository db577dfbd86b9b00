"""Small valid files of each format, which the mutations damage."""

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from helpers.made_networks import made_network
from helpers.ouster_packets import NUM_COLUMNS, metadata, record
from helpers.recorded_drive import CLOUD, write_bag1, write_bag2, write_mcap

NUM_POINTS = 40
PROFILE = "RNG19_RFL8_SIG16_NIR16"
ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
LONG_ROW = np.dtype([("t", "<f8"), ("z", "<f4"), ("ring", "<u2"), ("y", "<f4"), ("x", "<f4"), ("intensity", "u1")])
PLY_TYPES = {"<f4": "float", "<f8": "double", "<u2": "ushort", "<u4": "uint", "|u1": "uchar", "<i2": "short"}
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
ENCODINGS = ("ascii", "binary", "binary_compressed")


def rows(dtype: np.dtype, num: int = NUM_POINTS, seed: int = 0) -> np.ndarray:
    """Points in a structured array, each field with numbers that fit its type."""
    rng = np.random.default_rng(seed)
    made = np.zeros(num, dtype)
    for name in dtype.names or ():
        whole = dtype[name].kind in "iu"
        made[name] = rng.integers(0, 120, num) if whole else rng.uniform(-60, 60, num)
    return made


def text(values: np.ndarray) -> bytes:
    """One line per row; every number is read back as it was."""
    columns = [values[name] for name in values.dtype.names or ()]
    return b"".join(" ".join(map(str, row)).encode() + b"\n" for row in zip(*columns, strict=True))


def ply(
    values: np.ndarray, form: str, *, before: tuple[bytes, bytes] = (b"", b""), after: tuple[bytes, bytes] = (b"", b"")
) -> bytes:
    """A PLY file; `before` and `after` the vertices: header lines and data of other elements."""
    assert values.dtype.names is not None
    properties = "".join(f"property {PLY_TYPES[values.dtype[name].str]} {name}\n" for name in values.dtype.names)
    header = f"ply\nformat {form} 1.0\ncomment made\n".encode() + before[0]
    header += f"element vertex {len(values)}\n{properties}".encode() + after[0] + b"end_header\n"
    swapped = values.astype(values.dtype.newbyteorder(">")) if form.endswith("big_endian") else values
    return header + before[1] + (text(values) if form == "ascii" else swapped.tobytes()) + after[1]


def pcd(values: np.ndarray, form: str) -> bytes:
    """A PCD file."""
    names = values.dtype.names or ()
    kinds = [values.dtype[name] for name in names]
    columns = {
        "FIELDS": names,
        "SIZE": [kind.itemsize for kind in kinds],
        "TYPE": [kind.kind.upper() for kind in kinds],
        "COUNT": [1] * len(names),
        "WIDTH": [len(values)],
        "HEIGHT": [1],
        "VIEWPOINT": [0, 0, 0, 1, 0, 0, 0],
        "POINTS": [len(values)],
        "DATA": [form],
    }
    lines = ["# .PCD v0.7", "VERSION 0.7", *(f"{key} {' '.join(map(str, words))}" for key, words in columns.items())]
    data = {"ascii": text, "binary": np.ndarray.tobytes, "binary_compressed": _compressed}[form](values)
    return ("\n".join(lines) + "\n").encode() + data


def _compressed(values: np.ndarray) -> bytes:
    data = b"".join(values[name].tobytes() for name in values.dtype.names or ())
    packed = lzf(data)
    return struct.pack("<II", len(packed), len(data)) + packed


def lzf(data: bytes) -> bytes:
    """The data compressed: repetitions of the three bytes before, and the bytes themselves for all else."""
    packed, waiting, at = b"", b"", 0
    while at < len(data):
        if at >= 3 and data[at : at + 3] == data[at - 3 : at] and len(data) >= at + 3:
            packed += _literal(waiting) + bytes([1 << 5, 2])
            waiting, at = b"", at + 3
        else:
            waiting, at = waiting + data[at : at + 1], at + 1
    return packed + _literal(waiting)


def _literal(data: bytes) -> bytes:
    return b"".join(bytes([len(data[k : k + 32]) - 1]) + data[k : k + 32] for k in range(0, len(data), 32))


def npy(values: np.ndarray) -> bytes:
    """A .npy file."""
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def plys() -> list[bytes]:
    face = b"element face 1\nproperty list uchar int vertex_indices\n", b"\x03" + struct.pack("<3i", 0, 1, 2)
    camera = b"element camera 2\nproperty double a\nproperty uchar b\n", b"0.5 1\n1.5 2\n"
    whole = [ply(rows(dtype), form) for dtype in (ROW, LONG_ROW) for form in FORMATS]
    return [*whole, ply(rows(ROW), FORMATS[1], after=face), ply(rows(ROW), FORMATS[0], before=camera)]


def pcds() -> list[bytes]:
    return [pcd(rows(dtype), form) for dtype in (ROW, LONG_ROW) for form in ENCODINGS]


def small_drive() -> tuple[tuple[int, np.ndarray], ...]:
    """Three sweeps of a few points."""
    return tuple((10**9 * (10 + k), rows(CLOUD, 30, seed=k)) for k in range(3))


def mcap(folder: Path, chunk_size: int) -> bytes:
    return write_mcap(folder / "seed.mcap", small_drive(), chunk_size=chunk_size).read_bytes()


def bag1(folder: Path) -> bytes:
    file = folder / "seed.bag"
    file.unlink(missing_ok=True)
    return write_bag1(file, small_drive()).read_bytes()


def bag2(folder: Path) -> Path:
    """A folder with a database and metadata.yaml."""
    return write_bag2(folder / "seed_bag", small_drive())


def pcap(folder: Path) -> tuple[bytes, bytes]:
    """The packets, and the metadata beside them."""
    ranges = [np.random.default_rng(k).uniform(1e3, 5e4, (NUM_COLUMNS, 2)) for k in range(3)]
    return record(folder, PROFILE, ranges).read_bytes(), json.dumps(metadata(PROFILE)).encode()


def network(folder: Path) -> tuple[bytes, bytes]:
    """A model, and its settings."""
    model = made_network(folder)
    return model.read_bytes(), model.with_suffix(".yaml").read_bytes()


FIXES = (
    b"time,latitude,longitude,height,sigma\n1.5,48.98,8.39,115.2,0.5\n2.5,48.9801,8.3902,115.4,0.5\n",
    b"$GNRMC,023317.50,A,4858.8,N,00823.4,E,0.1,,170521,,,A*6A\r\n"
    b"$GNGGA,023317.50,4858.8,N,00823.4,E,4,12,0.8,67.0,M,48.0,M,,*44\r\n",
    b"%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn sde sdu\n"
    b"2158 95599.0 48.98 8.39 115.2 1 9 0.4 0.5 0.9 0 0 0 0 0\n"
    b"2021/05/17 02:33:36.5 48.98 8.39 115.4 1 9 0.4 0.5 0.9\n",
    b"%  UTC  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx sdy sdz\n"
    b"2021/05/17 02:33:17 4149480.1 611982.2 4789370.5 5 9 0.4 0.5 0.9 0 0 0 0 0\n",
)
KITTI_POSES = b"1 0 0 0.5 0 1 0 0 0 0 1 0\n0.8 -0.6 0 1.5 0.6 0.8 0 2e-3 0 0 1 -4\n" * 2
TUM_POSES = b"# seconds\n1317354880.1 1 2 3 0 0 0 1\n1317354880.2 1.5 2 3 0 0 0.6 0.8\n"
TIMES = b"0.0\n1.036e-01\n2.072e-01\n1317354880.25\n"
CALIB = b"P0: 7 0 6 0 0 7 1 0 0 0 1 0\nTr: 0 -1 0 0.1 0 0 -1 -0.07 1 0 0 -0.27\n"
_INFORMATION = " ".join(str(100 if row == column else 0) for row in range(6) for column in range(row, 6))
G2O = "\n".join(
    [
        *(f"VERTEX_SE3:QUAT {k} {k} 0.{k} 0 0 0 0 1" for k in range(6)),
        "FIX 0",
        *(f"EDGE_SE3:QUAT {k} {k + 1} 1 0.1 0 0 0 0 1 {_INFORMATION}" for k in range(5)),
        f"EDGE_SE3:QUAT 0 5 5 0.5 0 0 0 0 1 {_INFORMATION}\nEDGE_SE3:QUAT 4 1 -3 -0.3 0 0 0 0 1 {_INFORMATION}\n",
    ]
).encode()
CONFIG = b"odometry:\n  max_range_m: 50\n  deskew: true\nrefine:\n  correspondence_m: [2, 0.7]\n"
OVERRIDES = (b"odometry.max_range_m=50", b"map.color=class", b"refine.correspondence_m=[1,2]")
SETTINGS = (
    b"field_of_view_deg: [-25, 3]\nheight: 64\nwidth: 1024\nmean: [0, 0, 0, 0, 0]\nstd: [1, 1, 1, 1, 1]\n"
    b"classes: [unlabelled, car, road]\nvotes: {window: 5, neighbours: 5, sigma_px: 1.0, cutoff_m: 1.0}\n"
)
ARCHITECTURE = (
    b"dataset:\n  sensor:\n    fov_up: 3\n    fov_down: -25\n    img_prop: {width: 1024, height: 64}\n"
    b"    img_means: [0, 0, 0, 0, 0]\n    img_stds: [1, 1, 1, 1, 1]\npost:\n"
    b"  KNN: {use: true, params: {knn: 5, search: 5, sigma: 1.0, cutoff: 1.0}}\n"
)
CLASS_MAP = b"labels: {0: unlabeled, 10: car, 40: road}\nlearning_map_inv: {0: 0, 1: 10, 2: 40}\n"


def labels() -> bytes:
    return np.array([0, 10, 40, 50 | 7 << 16, 252] * 8, "<u4").tobytes()


def message(values: np.ndarray, **changed: Any) -> dict[str, Any]:
    """The numbers of a PointCloud2 message."""
    kinds = {"<f4": 7, "<f8": 8, "<u2": 4, "<u4": 6, "|u1": 2, "<i2": 3}
    named: Sequence[tuple[str, Any]] = list((values.dtype.fields or {}).items())
    fields = [{"name": name, "offset": kind[1], "datatype": kinds[kind[0].str], "count": 1} for name, kind in named]
    return {
        "height": 1,
        "width": len(values),
        "point_step": values.dtype.itemsize,
        "row_step": values.nbytes,
        "data": values.tobytes(),
        "fields": fields,
        "is_bigendian": False,
    } | changed

"""Points of PCD files, format 0.7 of the Point Cloud Library: text, binary and compressed."""

import struct

import numpy as np

from segslam.core.kernels import kernel
from segslam.scans.scan_files import (
    MAX_SCAN_BYTES,
    Columns,
    Field,
    binary_columns,
    check_size,
    number,
    read_header,
    text_columns,
)

TYPES = [(kind, size) for kind, sizes in {"F": "48", "I": "1248", "U": "1248"}.items() for size in sizes]
KEYS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
MAX_RATIO = 88
"""Three bytes of LZF stand for at most 264."""


def parse_pcd(content: bytes) -> Columns:
    """The fields of the points. The viewpoint is not applied.

    Raises ValueError for an inconsistent header, and for points that are not all in the file.
    """
    lines, start = read_header(content, "DATA")
    header = {words[0]: words[1:] for words in lines if not words[0].startswith("#")}
    unknown = [key for key in header if key not in KEYS]
    if unknown:
        raise ValueError(f"its header has the unknown line {unknown[0][:40]!r}")
    fields = _fields(header)
    num_points = _num_points(header)
    match [word.lower() for word in header["DATA"]]:
        case ["ascii"]:
            return text_columns(content, start, num_points, fields, is_last=True)
        case ["binary"]:
            return binary_columns(content, start, num_points, fields, is_last=True)
        case ["binary_compressed"]:
            return _compressed_columns(content, start, num_points, fields)
    raise ValueError(f"its header has DATA {' '.join(header['DATA'])[:40]!r}, not ascii, binary or binary_compressed")


def _fields(header: dict[str, list[str]]) -> list[Field]:
    names = header.get("FIELDS") or header.get("COLUMNS") or []
    sizes, types = header.get("SIZE", []), header.get("TYPE", [])
    counts = header.get("COUNT") or ["1"] * len(names)
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError("its header needs lines FIELDS, SIZE, TYPE and COUNT with one entry per field")
    fields = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if (kind, size) not in TYPES:
            raise ValueError(f"its field {name[:40]} has the unknown type {kind[:10]} of {size[:10]} bytes")
        fields.append(Field(name, np.dtype(f"<{kind.lower()}{size}"), number(count)))
    return fields


def _num_points(header: dict[str, list[str]]) -> int:
    """POINTS, or width times height; some programs write zeros for these two."""
    size = _count(header, "WIDTH") * _count(header, "HEIGHT")
    num_points = _count(header, "POINTS") if "POINTS" in header else size
    if size not in (0, num_points):
        raise ValueError(f"its header contradicts itself: POINTS is {num_points}, WIDTH x HEIGHT {size}")
    return num_points


def _count(header: dict[str, list[str]], key: str) -> int:
    match header.get(key):
        case [text]:
            return number(text)
    raise ValueError(f"its header needs a line {key} with one number")


def _compressed_columns(content: bytes, start: int, num_points: int, fields: list[Field]) -> Columns:
    """The fields of data that are compressed field by field, after their size and that after decompression (bytes)."""
    expected = num_points * sum(field.dtype.itemsize * field.num_values for field in fields)
    if len(content) - start < 8:
        raise ValueError("it is truncated: nothing follows its header")
    num_compressed, num_bytes = struct.unpack_from("<II", content, start)
    start += 8
    if num_bytes != expected or num_bytes > MAX_SCAN_BYTES:
        raise ValueError(f"its header claims {expected} bytes, at most {MAX_SCAN_BYTES}, but its data {num_bytes}")
    check_size(len(content) - start, num_compressed, num_points, tolerated=num_compressed)
    data = decompress(memoryview(content)[start : start + num_compressed], num_bytes)
    columns: Columns = {}
    begin = 0
    for field in (one for one in fields if one.num_values):
        end = begin + num_points * field.dtype.itemsize * field.num_values
        columns |= binary_columns(data[begin:end], 0, num_points, [field], is_last=True)
        begin = end
    return columns


def decompress(data: bytes | memoryview, num_bytes: int) -> memoryview:
    """The original `num_bytes` of data compressed by LZF (Lehmann 2005).

    Raises ValueError if the data are damaged or stand for another number of bytes.
    """
    target = np.zeros(num_bytes if num_bytes <= MAX_RATIO * len(data) else 0, np.uint8)
    if num_bytes > len(target) or _decompress(np.frombuffer(bytearray(data), np.uint8), target) != num_bytes:
        raise ValueError("its compressed points are damaged")
    return target.data


@kernel("int64(uint8[::1], uint8[::1])")
def _decompress(source, target):
    """Number of bytes written to `target`; -1 for data that do not fit, or refer to bytes that do not exist."""
    at, to = 0, 0
    while at < len(source):
        control = int(source[at])
        at += 1
        if control < 32:  # the next `control` + 1 bytes themselves
            num = control + 1
            if at + num > len(source) or to + num > len(target):
                return -1
            target[to : to + num] = source[at : at + num]
            at += num
            to += num
            continue
        num = (control >> 5) + 2  # as many bytes again that are already in `target`
        if num == 9:
            if at >= len(source):
                return -1
            num += int(source[at])
            at += 1
        if at >= len(source):
            return -1
        begin = to - ((control & 31) << 8) - int(source[at]) - 1
        at += 1
        if begin < 0 or to + num > len(target):
            return -1
        for k in range(num):
            target[to + k] = target[begin + k]
        to += num
    return to

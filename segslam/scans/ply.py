"""Points of PLY files (Turk 1994): text, and binary in both byte orders."""

import numpy as np

from segslam.scans.scan_files import Columns, Field, binary_columns, number, read_header, text_columns

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
LIST = Field("list", np.dtype("V1"), 0)
"""Stands for a property whose values are counted in each row, such as the corners of a face."""


def parse_ply(content: bytes) -> Columns:
    """The properties of the vertices. Elements after the vertices are not read.

    Raises ValueError for another format, an inconsistent header, and vertices that are not all in the file.
    """
    if not content.startswith((b"ply\n", b"ply\r\n")):
        raise ValueError("it does not begin with the line ply")
    lines, start = read_header(content, "end_header")
    order, elements = _elements(lines)
    for at, (name, num_rows, fields) in enumerate(elements):
        if LIST in fields and num_rows:
            raise ValueError(f"its element {name} has lists; remove this element, or put it after the vertices")
        is_last = at == len(elements) - 1
        read = text_columns if order == "ascii" else binary_columns
        if name == "vertex":
            return read(content, start, num_rows, fields, is_last=is_last)
        start = _after(content, start, num_rows, fields, is_text=order == "ascii")
    raise ValueError("its header has no element vertex")


def _elements(lines: list[list[str]]) -> tuple[str, list[tuple[str, int, list[Field]]]]:
    """The format, and each element's name, number of rows and properties."""
    formats = [words[1] for words in lines if words[0] == "format" and len(words) == 3]
    if len(formats) != 1 or formats[0] not in BYTE_ORDERS:
        raise ValueError(f"its header needs one line `format`, with one of {', '.join(BYTE_ORDERS)}")
    elements: list[tuple[str, int, list[Field]]] = []
    for words in lines:
        match words:
            case ["element", name, count]:
                elements.append((name, number(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1][2].append(LIST)
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append(Field(name, np.dtype(BYTE_ORDERS[formats[0]] + TYPES[kind])))
            case ["ply" | "format" | "comment" | "obj_info" | "end_header", *_]:
                pass
            case _:
                raise ValueError(f"its header has the unknown line {' '.join(words)[:80]!r}")
    return formats[0], elements


def _after(content: bytes, start: int, num_rows: int, fields: list[Field], *, is_text: bool) -> int:
    """Position after an element without lists that is not needed."""
    if not is_text:
        return start + num_rows * sum(field.dtype.itemsize for field in fields)
    for _ in range(min(num_rows, len(content))):
        start = content.find(b"\n", start) + 1
        if start == 0:
            raise ValueError(f"it is truncated: its header claims {num_rows} rows before the vertices")
    return start

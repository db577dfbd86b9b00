"""Damaged copies of valid files."""

import random
import re
import struct
from collections.abc import Callable

WORDS = (
    *(b"nan", b"-inf", b"1e999", b"1e308", b"1e-400", b"-1", b"0", b"", b"9" * 30, b"0x10", b"1_0", b"1:60", b"0x_"),
    *(b"1000000000000", b"2147483648", b"4294967295", b"18446744073709551616", b"2001-99-99", b"true", b"~"),
    *(b"null", b"NaN", b"[]", b"{}", b"[" * 3000),
    *(b"\xff\xfe", b"\x00", b"'", b'"', b"[", b"]", b"{", b"}", b":", b"#", b"&a", b"*a", b"<<: *a", b"- ", b"\r\n"),
)
"""What has confused readers of text."""
WORD = re.compile(rb"[^\s,=]+")
INTEGERS = (0, 1, 10**12, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


def mutate(rng: random.Random, data: bytes, *, is_text: bool) -> bytes:
    """A copy with one to eight changes; `is_text`: also of words and lines."""
    damaged = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        damaged = rng.choice(BYTE_CHANGES + TEXT_CHANGES if is_text else BYTE_CHANGES)(rng, damaged or bytearray(1))
    return bytes(damaged)


def _span(rng: random.Random, data: bytearray) -> tuple[int, int]:
    begin = rng.randrange(len(data))
    return begin, min(len(data), begin + rng.choice((1, 2, 4, 8, 16, 64, 1024)))


def _flip(rng: random.Random, data: bytearray) -> bytearray:
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def _remove(rng: random.Random, data: bytearray) -> bytearray:
    begin, end = _span(rng, data)
    del data[begin:end]
    return data


def _cut(rng: random.Random, data: bytearray) -> bytearray:
    return data[: rng.randrange(len(data))]


def _repeat(rng: random.Random, data: bytearray) -> bytearray:
    begin, end = _span(rng, data)
    data[begin:begin] = data[begin:end]
    return data


def _overwrite(rng: random.Random, data: bytearray) -> bytearray:
    begin, end = _span(rng, data)
    data[begin:end] = rng.randbytes(end - begin)
    return data


def _move(rng: random.Random, data: bytearray) -> bytearray:
    begin, end = _span(rng, data)
    data[begin:end] = data[rng.randrange(len(data)) :][: end - begin]
    return data


def _integer(rng: random.Random, data: bytearray) -> bytearray:
    begin = rng.randrange(len(data))
    number, size = rng.choice((*INTEGERS, 1 << rng.randrange(64))), rng.choice((4, 8))
    data[begin : begin + size] = struct.pack("<Q", number)[:size]
    return data


def replaced(rng: random.Random, data: bytes, word: re.Pattern[bytes]) -> bytes:
    """A copy with one of the words replaced."""
    words = [found.span() for found in word.finditer(data)]
    if not words:
        return data
    begin, end = rng.choice(words)
    return data[:begin] + rng.choice(WORDS) + data[end:]


def _word(rng: random.Random, data: bytearray) -> bytearray:
    return bytearray(replaced(rng, bytes(data), WORD))


def _line(rng: random.Random, data: bytearray) -> bytearray:
    lines = bytes(data).split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, rng.choice(lines))
        case 2:
            lines[at] = rng.choice(WORDS)
        case _:
            rng.shuffle(lines)
    return bytearray(b"\n".join(lines))


Change = Callable[[random.Random, bytearray], bytearray]
BYTE_CHANGES: tuple[Change, ...] = (_flip, _remove, _cut, _repeat, _overwrite, _move, _integer)
TEXT_CHANGES: tuple[Change, ...] = (_word, _word, _line)

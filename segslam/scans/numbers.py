"""Numbers in text, read by compiled code."""

import numpy as np

from segslam.core.kernels import kernel

POWERS = 10.0 ** np.arange(23)
"""The powers of ten that doubles represent exactly."""
HARD_AT_ONCE = 256


def parse_numbers(text: bytes, begin: int, num: int) -> tuple[np.ndarray, int]:
    """Up to `num` numbers between blanks, equal to those of `float`, and the position after the last.

    Raises ValueError for text that is not a number.
    """
    numbers, hard = np.empty(num), np.empty((HARD_AT_ONCE, 3), np.int64)
    source = np.frombuffer(text, np.uint8)
    count = 0
    while True:
        begin, count, num_hard = _parse(source, begin, numbers, count, hard, POWERS)
        for start, end, row in hard[:num_hard].tolist():
            word = text[start:end]
            numbers[row] = _number(word)
        if num_hard < HARD_AT_ONCE:
            return numbers[:count], begin


def _number(word: bytes) -> float:
    try:
        return float(word.replace(b"_", b"no number"))
    except ValueError as error:
        raise ValueError(f"{word[:40]!r} is not a number") from error


@kernel(
    "UniTuple(int64, 3)(Array(uint8, 1, 'C', True), int64, float64[::1], int64, int64[:, ::1], Array(float64, 1, 'C'))"
)
def _parse(text, at, numbers, count, hard, powers):
    """Position, count of numbers, and count of hard words, when one of the three arrays ends.

    An integer of at most 2^53, times or divided by an exact power of ten, is rounded once, as `float` rounds (Clinger,
    "How to read floating point numbers accurately", PLDI 1990). All other words are `hard`: start, end, and row.
    """
    num_hard = 0
    while count < len(numbers) and num_hard < len(hard):
        while at < len(text) and (text[at] == 32 or 9 <= text[at] <= 13):
            at += 1
        if at == len(text):
            break
        start = at
        mantissa, scale, exponent = 0, 0, 0
        sign, exponent_sign = 1.0, 1
        num_digits, part, plain = 0, 0, True  # part: 0 before the point, 1 after it, 2 exponent
        while at < len(text) and not (text[at] == 32 or 9 <= text[at] <= 13):
            byte = int(text[at])
            if 48 <= byte <= 57 and part < 2:
                plain &= mantissa < 10**16
                mantissa = (mantissa * 10 + byte - 48) if plain else 0
                num_digits += 1
                scale -= part
            elif 48 <= byte <= 57:
                plain &= exponent < 1000
                exponent = (exponent * 10 + byte - 48) if plain else 0
                num_digits += 1
            elif byte == 46 and part == 0:
                part = 1
            elif (byte == 101 or byte == 69) and part < 2 and num_digits > 0:
                part, num_digits = 2, 0
            elif (byte == 45 or byte == 43) and at == start:
                sign = -1.0 if byte == 45 else 1.0
            elif (byte == 45 or byte == 43) and part == 2 and num_digits == 0 and text[at - 1] > 57:
                exponent_sign = -1 if byte == 45 else 1
            else:
                plain = False
            at += 1
        scale += exponent_sign * exponent
        if plain and num_digits > 0 and mantissa <= 2**53 and -22 <= scale <= 22:
            numbers[count] = sign * (mantissa * powers[scale] if scale >= 0 else mantissa / powers[-scale])
        else:
            hard[num_hard, 0], hard[num_hard, 1], hard[num_hard, 2] = start, at, count
            num_hard += 1
        count += 1
    return at, count, num_hard

"""LZF compression (Lehmann 2005), which PCD files use."""

import numpy as np

from segslam.core.kernels import kernel

MAX_RATIO = 88
"""Three bytes stand for at most 264."""


def decompress(data: bytes | memoryview, num_bytes: int) -> memoryview:
    """The original `num_bytes`. Raises ValueError if the data are damaged or stand for another number of bytes."""
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

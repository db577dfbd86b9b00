"""Adjacency matrices as bits, shared by consistency graphs and the clique search."""

import numpy as np
from jaxtyping import Bool, UInt64

from segslam.core.kernels import kernel

Bits = UInt64[np.ndarray, "_ _"]
"""One row per vertex: bit k of word w is 1 for an edge to vertex 64 w + k."""


def pack_rows(joined: Bool[np.ndarray, "n n"]) -> Bits:
    """The adjacency of n vertices as bits; the diagonal is cleared."""
    num = len(joined)
    padded = np.zeros((num, (num + 63) // 64 * 64), bool)
    padded[:, :num] = joined & ~np.eye(num, dtype=bool)
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


@kernel("uint64(uint64)")
def count_bits(word):
    """Number of set bits, summed in fields of 2, 4 and 8 bits."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel("int64(uint64)")
def lowest_bit(word):
    """Position of the lowest set bit; `word` must not be 0."""
    return np.int64(count_bits((word & (~word + np.uint64(1))) - np.uint64(1)))


@kernel("uint64(uint64[::1])")
def pack_flags(eights):
    """One word from 64 bytes of 0 or 1, eight at a time: a product collects the lowest bits in its highest byte."""
    word = np.uint64(0)
    for k in range(8):
        word |= ((eights[k] * np.uint64(0x0102040810204080)) >> np.uint64(56)) << np.uint64(8 * k)
    return word


@kernel("int64(uint64[::1], int64[::1])")
def members(row, out):
    """Writes the positions of the set bits of `row`, ascending, to `out`, and returns their number."""
    count = 0
    for w in range(len(row)):
        word = row[w]
        while word:
            out[count] = 64 * w + lowest_bit(word)
            count += 1
            word &= word - np.uint64(1)
    return count


@kernel("int64[:, ::1](uint64[:, ::1])")
def pairs(adjacency):
    """(n, 2) adjacent vertices i < j, in ascending order."""
    count = len(adjacency)
    degrees = np.int64(0)
    for i in range(count):
        for w in range(adjacency.shape[1]):
            degrees += np.int64(count_bits(adjacency[i, w]))
    found = np.empty((degrees // 2, 2), np.int64)
    neighbours = np.empty(count, np.int64)
    row = 0
    for i in range(count):
        for k in range(members(adjacency[i], neighbours)):
            if neighbours[k] > i:
                found[row, 0], found[row, 1] = i, neighbours[k]
                row += 1
    return found


@kernel("void(uint64[:, ::1], int64[:, ::1])")
def part(adjacency, parted):
    """Removes the edges between the two vertices of each row."""
    for row in range(len(parted)):
        i, j = parted[row]
        adjacency[i, j >> 6] &= ~(np.uint64(1) << np.uint64(j & 63))
        adjacency[j, i >> 6] &= ~(np.uint64(1) << np.uint64(i & 63))

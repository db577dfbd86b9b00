"""Bit kernels against plain Python."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from segslam.registration.cliques import count_bits, lowest_bit, members, pack_rows

WORDS = st.integers(0, 2**64 - 1)


@given(word=WORDS)
def test_bits_are_counted_as_python_counts_them(word: int) -> None:
    assert count_bits(np.uint64(word)) == word.bit_count()


@given(word=WORDS.filter(bool))
def test_lowest_bit_is_the_number_of_zeros_below_it(word: int) -> None:
    assert lowest_bit(np.uint64(word)) == (word & -word).bit_length() - 1


@pytest.mark.parametrize("count", [1, 63, 64, 65, 200])
def test_members_are_those_of_the_flags(count: int) -> None:
    upper = np.triu(np.random.default_rng(count).random((count, count)) < 0.2, 1)
    flags = upper | upper.T
    adjacency, out = pack_rows(flags), np.empty(count, np.int64)
    for row in range(count):
        number = members(adjacency[row], out)
        assert out[:number].tolist() == np.flatnonzero(flags[row]).tolist()

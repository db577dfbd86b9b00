"""Faults that the mutation check writes: valid code, one change each, and none in what does not run."""

import ast

from tools.mutation import ROOT, TESTS, chosen, faults_of, files_of

SOURCE = '''"""Text with 2 < 3."""
LIMIT = 4

def larger(a: float, b: float = 1.5) -> float:
    """Text with a - b."""
    if a < b and -a > 2:
        raise ValueError(f"{a - b}")
    return max(a, b) + 10
'''


def test_every_kind_of_fault_is_found_and_leaves_valid_code() -> None:
    faults = faults_of(SOURCE)
    assert {(fault.line, fault.old, fault.new) for fault in faults} == {
        (6, "<", ">="),
        (6, "and", "or"),
        (6, "-", ""),
        (6, ">", "<="),
        (6, "2", "1"),
        (8, "max", "min"),
        (8, "+", "-"),
        (8, "10", "5"),
    }
    for fault in faults:
        broken = fault.applied(SOURCE)
        ast.parse(broken)
        assert broken != SOURCE


def test_a_seed_gives_the_same_lines_each_once() -> None:
    faults = faults_of(SOURCE)
    assert chosen(faults, num_lines=2, seed=3) == chosen(faults, num_lines=2, seed=3)
    assert {fault.line for fault in chosen(faults, num_lines=9, seed=3)} == {6, 8}


def test_the_rooms_and_their_tests_exist() -> None:
    for room in TESTS:
        assert files_of(room)
        assert all((ROOT / test).exists() for test in TESTS[room])

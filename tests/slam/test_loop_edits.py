import pytest

from segslam.core.errors import SegslamError
from segslam.slam.loop_edits import LoopEdits, pairs_of


def test_pairs_are_read_in_either_order() -> None:
    assert pairs_of(["15:120", "120:15", "7:3"], "--add") == {(120, 15), (7, 3)}
    for text in ("120", "a:b", "1:2:3", "-1:3", "1:"):
        with pytest.raises(SegslamError, match=r"--forbid .*as in --forbid 120:15"):
            pairs_of([text], "--forbid")


def test_the_later_edit_wins() -> None:
    first = LoopEdits(frozenset({(5, 1), (6, 2)}), frozenset({(9, 3)}))
    later = LoopEdits(frozenset({(9, 3)}), frozenset({(5, 1)}))
    assert first.and_then(later) == LoopEdits(frozenset({(6, 2), (9, 3)}), frozenset({(5, 1)}))
    assert first.and_then(LoopEdits()) == first


def test_contradicting_and_impossible_pairs_are_refused() -> None:
    with pytest.raises(SegslamError, match="both forbidden and added"):
        LoopEdits(frozenset({(5, 1)}), frozenset({(5, 1)}))
    with pytest.raises(SegslamError, match="two keyframes"):
        LoopEdits(frozenset({(5, 5)}))
    with pytest.raises(SegslamError, match=r"0:800: give two keyframes of loops\.csv, the newer first"):
        LoopEdits(frozenset({(0, 800)}))


def test_edits_survive_a_log() -> None:
    edits = LoopEdits(frozenset({(6, 2), (5, 1)}), frozenset({(9, 3)}))
    assert LoopEdits.from_json(edits.to_json()) == edits
    assert LoopEdits.from_json("") == LoopEdits()
    for text in ("{", "[]", '{"forbidden": [1], "added": []}'):
        with pytest.raises(SegslamError, match="cannot be read"):
            LoopEdits.from_json(text)

"""Loops that position fixes propose."""

from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.finished_run import make_run

from segslam.candidates.proximity import GAP_M
from segslam.core.config import ProximityConfig
from segslam.run.replay import pairs_near

SPACING_M = 2.0
ROUND = 100
"""Keyframes of one round of a circle."""


def _two_rounds(apart_m: float) -> np.ndarray:
    angle = np.arange(2 * ROUND) * 2.0 * np.pi / ROUND
    radius_m = SPACING_M * ROUND / (2.0 * np.pi) + apart_m * (np.arange(2 * ROUND) >= ROUND)
    return radius_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def _pairs(apart_m: float, loops: list[tuple[int, int]], tried: list[tuple[int, int]] | None = None) -> set:
    travel_m = np.arange(2 * ROUND) * SPACING_M
    config = ProximityConfig()
    return set(pairs_near(_two_rounds(apart_m), travel_m, loops, tried or loops, config=config))


def test_each_place_of_the_second_round_is_paired_with_the_first() -> None:
    pairs = sorted(_pairs(1.0, []))
    assert {newer - older for newer, older in pairs[1:]} == {ROUND}
    assert pairs[0] == (ROUND - 3, 0), "the circle closes before the second round begins"
    assert set(np.diff([newer for newer, _ in pairs]) * SPACING_M) == {GAP_M}
    elsewhere = _pairs(ProximityConfig().base_radius_m + 1.0, [])
    assert elsewhere == {(ROUND - 3, 0), (2 * ROUND - 2, ROUND)}, "the second round is another street"


def test_places_that_a_loop_joins_and_pairs_that_were_tried_are_left_out() -> None:
    joined = _pairs(1.0, [(ROUND + 50, 50)])
    assert all(abs(newer - ROUND - 50) * SPACING_M >= GAP_M for newer, _ in joined)
    assert 0 < len(joined) < len(_pairs(1.0, []))
    first = min(_pairs(1.0, []))
    assert first not in _pairs(1.0, [], tried=[first])


def test_a_run_without_a_place_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_run(tmp_path / "run")
    for given in (made.folder, made.folder / "log.mcap"):
        assert run("edit", given, "--add-near-fixes", "--out", tmp_path / "new", "--quiet") == 2
        assert "georeference.json: missing; `segslam georeference` the run first" in capsys.readouterr().err

"""Real submaps of thin scans, revisited in reverse."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from segslam.config import Config


@pytest.mark.slow
@pytest.mark.data
def test_submaps_of_a_real_drive_close_in_reverse_and_no_others_do(data_dir: Path) -> None:
    file = Path(__file__).resolve().parents[2] / "tools" / "bench_submaps.py"
    spec = importlib.util.spec_from_file_location("bench_submaps", file)
    assert spec is not None
    assert spec.loader is not None
    bench = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bench)
    submaps = bench.Submaps(data_dir / "nclt", Config())
    rng = np.random.default_rng(0)
    outcomes = bench.run(submaps, submaps.pairs(45, rng, near=True), Config())
    assert outcomes["right"] >= 44, outcomes
    assert outcomes["wrong"] == 0, outcomes
    negatives = bench.run(submaps, submaps.pairs(15, rng, near=False), Config())
    assert negatives["right"] + negatives["wrong"] == 0, negatives

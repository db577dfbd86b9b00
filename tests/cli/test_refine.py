from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run

from segslam.graph.g2o import read_g2o
from segslam.output.finished import read_metrics
from segslam.output.folder import ADJUSTED_GRAPH
from segslam.output.log import read_log

pytestmark = pytest.mark.usefixtures("short_runs")


def test_a_run_is_refined_and_keeps_its_loops_and_a_replay_keeps_nothing_of_the_adjustment(
    log: Path, tmp_path: Path
) -> None:
    assert run("refine", log, "--out", tmp_path / "refined", "--refine-minutes", 5, "--quiet") == 0
    metrics = read_metrics(tmp_path / "refined")
    before, after = read_log(log), read_log(tmp_path / "refined" / "log.mcap")
    first, second = before.result(), after.result()
    assert first is not None
    assert second is not None
    assert first[0].closure_weights.keys() == second[0].closure_weights.keys()
    assert before.adjustment() is None
    adjustment = after.adjustment()
    assert adjustment is not None
    assert adjustment.num_registered == metrics["num_submap_pairs"] > 0
    assert metrics["map_thickness_m"] > 0.0
    assert not np.array_equal(first[1].T_world_lidar, second[1].T_world_lidar)
    plain = tmp_path / "plain"
    assert run("replay", tmp_path / "refined", "--out", plain, "--refine-minutes", 0, "--quiet") == 0
    assert read_log(plain / "log.mcap").adjustment() is None
    adjusted, last = (read_g2o(folder / ADJUSTED_GRAPH) for folder in (tmp_path / "refined", plain))
    loops = read_g2o(plain / "graph.g2o")
    assert len(last.edges) <= len(loops.edges) < len(adjusted.edges)
    for vertex, T_world in loops.T_world_vertex.items():
        np.testing.assert_array_equal(last.T_world_vertex[vertex], T_world)


def test_no_time_is_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("refine", log, "--out", tmp_path / "refined", "--refine-minutes", 0) == 2
    assert "--refine-minutes" in capsys.readouterr().err

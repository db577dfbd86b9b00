from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run

from segslam.core import geometry
from segslam.graph.g2o import read_g2o
from segslam.output.finished import read_corrections, read_metrics, read_result, read_run
from segslam.output.folder import ADJUSTED_GRAPH
from segslam.output.log import read_log
from segslam.run.sessions.recorded import known_of, read_session
from segslam.slam.adjustment import rounds
from segslam.slam.adjustment.sweeps import Sweep, swept

pytestmark = pytest.mark.usefixtures("short_runs")


@pytest.mark.long
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


@pytest.mark.long
def test_the_motion_within_sweeps_is_corrected_in_the_run_and_in_its_map(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rounds, "measure_sweep", lambda *_, **__: Sweep(-0.1, 0.002, 180.0))
    folder = tmp_path / "refined"
    assert run("refine", log, "--out", folder, "--refine-minutes", 5) == 0
    assert "; points corrected for the motion within sweeps of 100 ms, as measured" in capsys.readouterr().err
    metrics = read_metrics(folder)
    assert (metrics["sweep_s"], metrics["sweep_sigma_s"]) == (-0.1, 0.002)
    keyframes = [(row, step.keyframe) for row, step in enumerate(read_log(folder).steps()) if step.keyframe is not None]
    result = read_run(folder).result
    corrections, odometry = read_corrections(read_log(folder), result), result.odometry
    row, keyframe = keyframes[3]
    seconds = 1e-9 * float(odometry.stamp_ns[row + 1] - odometry.stamp_ns[row - 1])
    before, after = odometry.T_world_lidar[[row - 1, row + 1]]
    velocity = geometry.log(geometry.inverse(before) @ after) / seconds
    expected = keyframe.points - 0.1 * swept(keyframe.points.astype(np.float64), velocity, 180.0)
    np.testing.assert_allclose(corrections[3](keyframe.points), expected, atol=1e-4)
    plain = read_corrections(read_log(log), read_result(read_log(log)))
    np.testing.assert_array_equal(plain[3](keyframe.points), keyframe.points)
    known = known_of([read_session(folder)] * 2)
    assert known.sweep == pytest.approx(Sweep(-0.1, 0.002 / 2**0.5, 180.0))
    np.testing.assert_allclose(known.corrections[len(keyframes) + 3](keyframe.points), expected, atol=1e-4)


def test_no_time_is_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("refine", log, "--out", tmp_path / "refined", "--refine-minutes", 0) == 2
    assert "--refine-minutes" in capsys.readouterr().err

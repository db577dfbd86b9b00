"""A killed run is resumed after its last complete step, and ends like an uninterrupted run."""

import csv
import errno
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.made_logs import boundaries, largest_file
from mcap.reader import make_reader

from segslam.core.types import LoopClosure
from segslam.graph.g2o import read_g2o
from segslam.output.finished import read_run
from segslam.output.folder import POSE_COLUMNS
from segslam.output.log import LogWriter, RunLog, read_log

pytestmark = pytest.mark.usefixtures("short_runs")

OPTIONS = ("--labels", "true_labels", "--quiet")
FAST = ("odometry.max_range_m=40", "odometry.voxel_size_m=1.5", "keyframes.distance_m=6", "proximity.min_travel_m=60")
SETTINGS = tuple(word for setting in FAST for word in ("--set", setting))


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with loops, its sixth scan broken."""
    root = tmp_path_factory.mktemp("kitti")
    (write_kitti_sequence(root) / "000005.bin").write_bytes(b"broken")
    return root


@pytest.fixture(scope="module")
def whole(kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the uninterrupted run."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run("map", kitti, "--out", out, *OPTIONS, *SETTINGS) == 0
    return out


def _killed(kitti: Path, out: Path, *, log_bytes: int) -> Path:
    """The folder of a run killed when its log had grown to so many bytes."""
    command = [sys.executable, "-m", "segslam", "map", kitti, "--out", out, *OPTIONS, *SETTINGS]
    with subprocess.Popen([str(word) for word in command], stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and _size(out / "log.mcap") < log_bytes:
            time.sleep(0.002)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    return out


def _size(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0


def _cut(whole: Path, out: Path, *, log_bytes: int) -> Path:
    """What a power failure may leave of a run: the beginning of its log."""
    out.mkdir()
    (out / "log.mcap").write_bytes((whole / "log.mcap").read_bytes()[:log_bytes])
    return out


def _closures(log: RunLog) -> list[tuple[int, int, list[float]]]:
    outcomes = [attempt.outcome for step in log.steps() for attempt in step.attempts]
    return [(c.source_id, c.target_id, c.T_target_source) for c in outcomes if isinstance(c, LoopClosure)]


def _assert_as_whole(whole: Path, resumed: Path) -> None:
    logs = [read_log(folder / "log.mcap") for folder in (whole, resumed)]
    closures, closures_again = (_closures(log) for log in logs)
    assert len(closures) > 0
    assert [closure[:2] for closure in closures_again] == [closure[:2] for closure in closures]
    poses, poses_again = (log.result()[1] for log in logs)
    np.testing.assert_array_equal(poses_again.scan_index, poses.scan_index)
    np.testing.assert_array_equal(poses_again.stamp_ns, poses.stamp_ns)
    apart_m = np.linalg.norm((poses_again.T_world_lidar - poses.T_world_lidar)[:, :3, 3], axis=1)
    assert apart_m.max() < 0.1, "odometry and motion model start again from the first scan of so short a drive"
    metrics, metrics_again = (json.loads((folder / "metrics.json").read_text()) for folder in (whole, resumed))
    assert metrics_again["num_scans"] == metrics["num_scans"]
    assert metrics_again["num_scans_skipped"] == metrics["num_scans_skipped"] == 1
    alone = {"kiss_icp_tum.txt", "kiss_icp_kitti.txt"}  # the state of KISS-ICP alone is lost
    assert {file.name for file in resumed.iterdir()} - alone == {file.name for file in whole.iterdir()} - alone
    with (resumed / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == reader.get_summary().statistics.message_count


def test_graph_table_and_log_have_the_same_closures(whole: Path) -> None:
    """With their poses and final weights, in files written from different records."""
    made = read_run(whole)
    logged = {
        (one.outcome.target_id, one.outcome.source_id): one.outcome.T_target_source
        for one in made.result.attempts
        if isinstance(one.outcome, LoopClosure)
    }
    graph = read_g2o(whole / "graph.g2o")
    drawn = {(edge.a, edge.b): edge.T_a_b for edge in graph.edges if edge.b != edge.a + 1}
    with (whole / "loops.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["outcome"] == "accepted"]
    assert drawn.keys() == logged.keys() == {(int(row["target"]), int(row["source"])) for row in rows}
    assert len(rows) == len(logged) > 0
    for row in rows:
        target_id, source_id = int(row["target"]), int(row["source"])
        np.testing.assert_allclose(drawn[target_id, source_id], logged[target_id, source_id], atol=1e-6)
        np.testing.assert_array_equal([float(row[name]) for name in POSE_COLUMNS], logged[target_id, source_id].ravel())
        assert float(row["weight"]) == made.result.estimate.closure_weights[source_id, target_id]


def _resumed_as_whole(kitti: Path, whole: Path, out: Path) -> None:
    kept = len(list(read_log(out / "log.mcap").steps()))
    assert run("map", kitti, "--out", out, "--resume", *OPTIONS) == 0
    assert json.loads((out / "metrics.json").read_text())["num_scans_resumed"] == kept
    _assert_as_whole(whole, out)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.08, 0.83])
def test_a_killed_run_ends_as_an_uninterrupted_one(kitti: Path, whole: Path, tmp_path: Path, share: float) -> None:
    size = int(share * _size(whole / "log.mcap"))
    _resumed_as_whole(kitti, whole, _killed(kitti, tmp_path / "run", log_bytes=size))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_runs_killed_at_random_end_as_an_uninterrupted_one(kitti: Path, whole: Path, tmp_path: Path, seed: int) -> None:
    """Every other one is killed again while it resumes, and has lost the end of its log as in a power failure."""
    rng = np.random.default_rng(seed)
    full = _size(whole / "log.mcap")
    out = _killed(kitti, tmp_path / "run", log_bytes=int(rng.uniform(0.02, 0.98) * full))
    if seed % 2:
        log = (out / "log.mcap").read_bytes()
        head = len(_head_of_log(tmp_path, whole))
        (out / "log.mcap").write_bytes(log[: int(rng.uniform(head, len(log)))])
        with subprocess.Popen(
            [sys.executable, "-m", "segslam", "map", str(kitti), "--out", str(out), "--resume", *OPTIONS]
        ) as process:
            time.sleep(rng.uniform(0.0, 8.0))
            process.kill()
    if not (out / "report.html").exists():  # the last that a run writes
        _resumed_as_whole(kitti, whole, out)
    _assert_as_whole(whole, out)


def _head_of_log(tmp_path: Path, whole: Path) -> bytes:
    """What a log begins with, before its first step."""
    with LogWriter(tmp_path / "head.mcap", config=read_log(whole / "log.mcap").config):
        return (tmp_path / "head.mcap").read_bytes()


@pytest.mark.long
@pytest.mark.parametrize(
    "part",
    [
        "half a step",
        *(
            pytest.param(part, marks=pytest.mark.slow)
            for part in ("no step", "all steps, no result", "result, no files")
        ),
    ],
)
def test_a_run_that_lost_its_end_is_resumed(kitti: Path, whole: Path, tmp_path: Path, part: str) -> None:
    ends = boundaries(whole / "log.mcap")  # of the ground truth, of each step, of the result
    size = {"no step": ends[0], "half a step": ends[30] + 700, "all steps, no result": ends[-2]}.get(part, ends[-1])
    out = _cut(whole, tmp_path / "run", log_bytes=size)
    for name in ("georeference.json", "gnss.csv", "poses_enu_tum.txt", "poses_geodetic.csv"):
        (out / name).write_text("of fewer scans")
    _resumed_as_whole(kitti, whole, out)


@pytest.mark.slow
def test_a_full_disk_ends_with_status_2_and_the_run_is_resumed_when_there_is_space(
    kitti: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with largest_file(int(0.7 * _size(whole / "log.mcap"))):
        assert run("map", kitti, "--out", out, *OPTIONS, *SETTINGS) == 2
    assert "free space on the disk" in capsys.readouterr().err
    _resumed_as_whole(kitti, whole, out)


def test_a_disk_without_room_for_a_scan_leaves_nothing_to_continue(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with largest_file(2000):
        assert run("map", kitti, "--out", out, *OPTIONS, *SETTINGS) == 2
    shown = capsys.readouterr().err
    assert "free space on the disk" in shown
    assert "segslam resume" not in shown
    assert not out.exists()


@pytest.mark.long
def test_results_without_disk_space_end_with_status_2_and_the_run_is_resumed(
    kitti: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if there are results of fewer scans, because the run was stopped before."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    out = _cut(whole, tmp_path / "run", log_bytes=boundaries(whole / "log.mcap")[-2])
    (out / "report.html").write_text("of fewer scans")
    with monkeypatch.context() as patched:
        patched.setattr("segslam.output.folder.write_kitti", full)
        assert run("map", kitti, "--out", out, "--resume", *OPTIONS) == 2
    assert "cannot write the results (No space left on device)" in capsys.readouterr().err
    _resumed_as_whole(kitti, whole, out)


@pytest.mark.long
def test_a_run_killed_before_its_report_gets_it_on_resuming(kitti: Path, whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "run")
    (tmp_path / "run" / "report.html").unlink()
    _resumed_as_whole(kitti, whole, tmp_path / "run")


def test_resuming_a_finished_run_is_reported_and_changes_nothing(
    kitti: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {file.name: file.read_bytes() for file in whole.iterdir()}
    assert run("map", kitti, "--out", whole, "--resume", "--labels", "true_labels") == 0
    assert "already complete" in capsys.readouterr().err
    assert run("map", kitti, "--out", whole, "--resume", "--json", *OPTIONS) == 0
    assert capsys.readouterr().out.encode() == _one_line(before["metrics.json"])
    assert {file.name: file.read_bytes() for file in whole.iterdir()} == before


def _one_line(metrics: bytes) -> bytes:
    return json.dumps(json.loads(metrics)).encode() + b"\n"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--set", "verify.max_false_share=0.02"], "verify.max_false_share: 0.02 now"),
        (["--labels", "none"], "--labels: none now"),
        (["--frames", "0:20"], "--frames: 0:20 now"),
    ],
)
def test_a_run_is_resumed_as_it_began_or_not_at_all(
    kitti: Path, whole: Path, capsys: pytest.CaptureFixture[str], options: list[str], expected: str
) -> None:
    assert run("map", kitti, "--out", whole, "--resume", *OPTIONS, *options) == 2
    assert expected in capsys.readouterr().err


def test_other_data_under_the_same_name_are_refused_and_the_log_stays(
    kitti: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = _cut(whole, tmp_path / "run", log_bytes=boundaries(whole / "log.mcap")[8])
    log = (out / "log.mcap").read_bytes()
    write_kitti_sequence(tmp_path / "other")
    (tmp_path / "other" / "sequences" / "00" / "times.txt").write_text("".join(f"{0.1 * i:.6f}\n" for i in range(72)))
    assert run("map", tmp_path / "other", "--out", out, "--resume", *OPTIONS) == 2
    assert "resume with the data of the interrupted run" in capsys.readouterr().err
    assert (out / "log.mcap").read_bytes() == log


def test_a_run_in_progress_is_not_resumed(
    kitti: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with LogWriter(tmp_path / "log.mcap", config=read_log(whole / "log.mcap").config):
        assert run("map", kitti, "--out", tmp_path, "--resume") == 2
    assert "still in progress" in capsys.readouterr().err


def test_there_is_nothing_to_resume_without_a_log(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("map", kitti, "--out", tmp_path, "--resume") == 2
    assert "no log.mcap, so there is no run to resume" in capsys.readouterr().err

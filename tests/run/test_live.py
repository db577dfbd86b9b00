"""Scans that arrive during mapping: waiting and dropped scans, gaps, and the end of a run."""

import signal
import threading
from pathlib import Path
from time import sleep
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import drifting_slam, round_drive
from helpers.hanging_source import HangingSource
from helpers.live_command import LiveCommand, record, write_scan
from helpers.terminal import in_terminal

from segslam.cli.live import LiveFigures, too_slow
from segslam.core import geometry
from segslam.core.config import Config, OdometryConfig
from segslam.core.evaluation import trajectory_metrics
from segslam.core.types import BadScan, LoopClosure, Scan, SegslamError
from segslam.odometry.apart import OdometryApart
from segslam.odometry.kiss import KissOdometry
from segslam.output.finished import read_run
from segslam.output.log import LogWriter, read_log
from segslam.output.words import FIGURES
from segslam.run.live.folder import FolderSource
from segslam.run.live.front import Front
from segslam.run.live.waiting import Rhythm, Tally, Waiting
from segslam.scans import open_dataset
from segslam.scans.presets import SETTINGS as PRESETS

INTERVAL_NS = 100_000_000
SETTINGS = ("--set", "odometry.min_range_m=1")


def _scan(index: int, stamp_ns: int) -> Scan:
    return Scan(np.ones((1, 3)), stamp_ns, index)


def test_the_oldest_that_waits_is_dropped_and_counted() -> None:
    waiting = Waiting(most=3)
    for number in range(5):
        waiting.put(number * INTERVAL_NS, _scan)
    taken = [waiting.take(0.0) for _ in range(4)]
    assert [arrival.index if arrival else None for arrival in taken] == [2, 3, 4, None]
    assert (waiting.tally.num_arrived, waiting.tally.num_dropped) == (5, 2)


def test_a_closed_queue_gives_what_waits_and_takes_nothing_more() -> None:
    waiting = Waiting()
    waiting.put(0, _scan)
    waiting.close()
    waiting.put(INTERVAL_NS, _scan)
    first = waiting.take(None)
    assert first is not None
    assert first.index == 0
    assert waiting.take(None) is None
    assert waiting.tally.num_arrived == 1


def test_gaps_are_counted_by_stamp_with_the_scans_that_they_lack() -> None:
    rhythm = Rhythm(Tally())
    for number in (0, 1, 2, 3, 6, 7, 8, 18):
        rhythm.note(number * INTERVAL_NS)
    assert (rhythm.tally.num_gaps, rhythm.tally.num_missing) == (2, 2 + 9)
    assert rhythm.tally.longest_gap_s == pytest.approx(1.0)
    assert rhythm.intervals.gap(3 * INTERVAL_NS, 0) == pytest.approx(3.0)
    assert rhythm.intervals.gap(int(1.2 * INTERVAL_NS), 0) == 1.0
    assert rhythm.intervals.gap(1000 * INTERVAL_NS, 0) == pytest.approx(1000.0)


def test_stamps_continue_when_the_clock_of_the_sender_is_set_back() -> None:
    rhythm = Rhythm(Tally())
    stamps = [rhythm.note(1_000_000_000_000 + number * INTERVAL_NS) for number in range(20)]
    again = [rhythm.note(1_000_000_000_000 + number * INTERVAL_NS) for number in range(20)]
    assert np.all(np.diff([*stamps, *again]) == INTERVAL_NS)
    assert (rhythm.tally.num_clock_set, rhythm.tally.num_gaps) == (1, 0)


@pytest.mark.parametrize("ahead_ns", [25 * 3600 * 10**9, 2_000_000_000 * 10**9])
def test_stamps_of_a_clock_that_is_set_forward_continue_and_count_no_missing_scans(ahead_ns: int) -> None:
    """Also if it is set for one scan only, as by a damaged packet."""
    first_ns, rhythm = 1_700_000_000 * 10**9, Rhythm(Tally())
    sent = [first_ns + INTERVAL_NS * number for number in range(12)]
    sent[4] += ahead_ns
    sent[8:] = [stamp_ns + ahead_ns for stamp_ns in sent[8:]]
    assert np.all(np.diff([rhythm.note(stamp_ns) for stamp_ns in sent]) == INTERVAL_NS)
    assert (rhythm.tally.num_clock_set, rhythm.tally.num_gaps, rhythm.tally.num_missing) == (3, 0, 0)


def test_a_pause_of_an_hour_is_a_gap() -> None:
    rhythm = Rhythm(Tally())
    for stamp_s in (0, 1, 2, 3, 3603):
        rhythm.note(stamp_s * 10**9)
    assert (rhythm.tally.num_clock_set, rhythm.tally.num_gaps, rhythm.tally.longest_gap_s) == (0, 1, 3600.0)


def test_a_file_is_read_once_when_it_is_closed_or_renamed(tmp_path: Path) -> None:
    write_scan(tmp_path, _scan(0, 0), "before")
    source, waiting, stopped = FolderSource(tmp_path), Waiting(most=9), threading.Event()
    output: list[str] = []
    source.open(output.append)
    assert "1 scan already in" in output[0]
    thread = threading.Thread(target=source.feed, args=(waiting, stopped))
    thread.start()
    try:
        with (tmp_path / "1700000000.1.bin").open("wb") as unfinished:
            unfinished.write(np.ones(40, "<f4").tobytes())
            unfinished.flush()
            assert waiting.take(0.5) is None
        written = waiting.take(5.0)
        write_scan(tmp_path, _scan(0, 0), "1700000000.2")
        (tmp_path / "notes.txt").write_text("no scan")
        with (tmp_path / "1700000000.1.bin").open("ab"):
            pass  # the same file again
        renamed, third = waiting.take(5.0), waiting.take(0.5)
    finally:
        stopped.set()
        thread.join()
        source.close()
    assert written is not None
    assert renamed is not None
    assert third is None
    assert [arrival.stamp_ns for arrival in (written, renamed)] == [
        1_700_000_000_100_000_000,
        1_700_000_000_200_000_000,
    ]
    scan = written.read(written.index, written.stamp_ns)
    assert (scan.index, len(scan.points)) == (0, 10)


def test_the_times_of_the_points_of_a_file_are_used_as_when_it_is_mapped_later(tmp_path: Path) -> None:
    source, waiting, stopped = FolderSource(tmp_path), Waiting(), threading.Event()
    source.open(print)
    threading.Thread(target=source.feed, args=(waiting, stopped)).start()
    head = "VERSION 0.7\nFIELDS x y z time\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 5\nHEIGHT 1\nDATA ascii\n"
    try:
        (tmp_path / "1700000000.5.pcd").write_text(head + "".join(f"{k + 1} 2 3 {0.025 * k}\n" for k in range(5)))
        arrival = waiting.take(5.0)
    finally:
        stopped.set()
    assert arrival is not None
    scan, later = arrival.read(0, arrival.stamp_ns), open_dataset(tmp_path)[0]
    np.testing.assert_allclose(scan.times, [0.0, 0.25, 0.5, 0.75, 1.0], atol=1e-6)
    np.testing.assert_array_equal(scan.times, later.times)
    assert scan.stamp_time == later.stamp_time == 0.0  # they count from the stamp in the name


def test_a_file_that_is_no_scan_is_a_bad_scan(tmp_path: Path) -> None:
    source, waiting, stopped = FolderSource(tmp_path), Waiting(), threading.Event()
    source.open(print)
    threading.Thread(target=source.feed, args=(waiting, stopped)).start()
    try:
        (tmp_path / "a.npy").write_bytes(b"no array")
        arrival = waiting.take(5.0)
    finally:
        stopped.set()
    assert arrival is not None
    with pytest.raises(BadScan, match=r"a\.npy: it is not a \.npy file"):
        arrival.read(0, 0)


def test_a_removed_folder_ends_the_stream_with_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    source = FolderSource(folder)
    source.open(print)
    folder.rmdir()
    assert "was removed" in source.feed(Waiting(), threading.Event())


def test_only_folders_can_be_watched(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="cannot be watched"):
        FolderSource(tmp_path / "nowhere").open(print)


def test_odometry_that_knows_of_a_gap_predicts_by_the_velocity() -> None:
    """In an endless corridor, only the prediction determines the distance travelled; the walls determine the rest."""
    rng = np.random.default_rng(0)
    along = rng.uniform(-60, 60, 20000)
    side, height = rng.choice([-3.0, 3.0], 20000), rng.uniform(0, 3, 20000)
    corridor = np.column_stack([along, side, height])
    config = OdometryConfig(min_range_m=0.5)
    with OdometryApart(config) as apart:
        for odometry in (KissOdometry(config), apart):
            odometry.follow([(np.eye(4), corridor.astype(np.float32))], np.eye(4), _ahead(1.0))
            one, after_gap, next_one = (
                odometry.register(Scan(corridor, stamp), gap=gap).T_odom_lidar
                for stamp, gap in ((1, 1.0), (4, 3.0), (5, 1.0))
            )
            steps = [geometry.inverse(one) @ after_gap, geometry.inverse(after_gap) @ next_one]
            np.testing.assert_allclose([step[0, 3] for step in steps], [3.0, 1.0], atol=0.4)


def _ahead(distance_m: float) -> np.ndarray:
    return geometry.transform(np.eye(3), [distance_m, 0, 0])


def test_the_figures_of_a_live_run_have_their_meaning_in_the_report() -> None:
    figures = LiveFigures(SimpleNamespace(tally=Tally(), num_restarts=0))  # type: ignore[arg-type]
    placed = SimpleNamespace(latency_s=0.1, is_keyframe=True)
    figures.note(placed, lag_s=0.2, tries_loops=False)  # type: ignore[arg-type]
    assert {key for key, value in figures.metrics().items() if not isinstance(value, dict)} <= FIGURES.keys()
    assert figures.line().startswith("live: 1 scan, ")


@pytest.mark.slow
def test_scans_are_mapped_as_they_appear_until_none_comes(tmp_path: Path) -> None:
    folder, run = tmp_path / "scans", tmp_path / "run"
    folder.mkdir()
    scans = list(round_drive()[0][:8])
    with LiveCommand(folder, "--out", run, "--idle", "3", *SETTINGS) as command:
        command.wait_for("waiting for scans")
        record(folder, scans[:4], every_s=0.3)
        (folder / "broken.bin").write_bytes(b"x" * 23)
        record(folder, scans[4:], every_s=0.3, first=4)
        status, metrics = command.ended()
    assert status == 0, command.output
    assert "no scan for 3 s" in command.output
    assert metrics["num_scans_arrived"] == 9
    assert metrics["num_scans"] + metrics["num_scans_skipped"] + metrics["num_scans_dropped"] == 9
    assert metrics["latency_ms"]["median"] > 0
    assert len(read_log(run / "log.mcap").result()[1]) == metrics["num_scans"]
    assert (run / "report.html").is_file()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_a_live_run_with_all_its_results(tmp_path: Path, number: int) -> None:
    folder, run = tmp_path / "scans", tmp_path / "run"
    folder.mkdir()
    with LiveCommand(folder, "--out", run, *SETTINGS) as command:
        command.wait_for("waiting for scans")
        record(folder, list(round_drive()[0][:3]), every_s=0.5)
        command.signal(number)
        status, metrics = command.ended()
    assert status == 0, command.output
    assert metrics["num_scans"] + metrics["num_scans_dropped"] == 3
    assert (run / "report.html").is_file()


@pytest.mark.long
def test_two_signals_before_the_first_scan_leave_nothing_and_say_so(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    with LiveCommand(folder, "--out", tmp_path / "run", *SETTINGS) as command:
        command.wait_for("waiting for scans")
        command.signal(signal.SIGINT)
        command.signal(signal.SIGTERM)  # two of one kind may become one
        status, metrics = command.ended()
    assert status in (2, 130), command.output
    assert (metrics, "is kept" in command.output, (tmp_path / "run").exists()) == ({}, False, False)


@pytest.mark.slow
def test_without_a_scan_nothing_is_left_behind(tmp_path: Path) -> None:
    with LiveCommand(tmp_path, "--out", tmp_path / "run", "--idle", "0.5", "--quiet") as command:
        status, metrics = command.ended()
    assert (status, metrics) == (2, {})
    assert "no scan was mapped (no scan for 0.5 s)" in command.output
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_same_scans_live_and_offline_close_the_same_loops_on_the_same_trajectory(tmp_path: Path) -> None:
    """Slow enough that none is dropped; on a machine too slow for that nothing can be compared."""
    folder, scans = tmp_path / "scans", round_drive()[0]
    folder.mkdir()
    settings = (*SETTINGS, "--set", "proximity.min_travel_m=60")
    with LiveCommand(folder, "--out", tmp_path / "live", *settings) as command:
        command.wait_for("waiting for scans")
        for scan in scans:
            write_scan(folder, scan, f"{scan.stamp_ns:019d}")
            sleep(1.5)
        command.signal(signal.SIGINT)
        status, metrics = command.ended()
    assert status == 0, command.output
    if metrics["num_scans_dropped"]:
        pytest.skip("the machine dropped scans")
    (folder / "times.txt").write_text("".join(f"{scan.stamp_ns / 1e9:.9f}\n" for scan in scans))
    assert run("map", folder, "--out", tmp_path / "map", "--preset", "driving", *settings, "--quiet") == 0
    live, offline = (read_run(tmp_path / name).result for name in ("live", "map"))
    assert live.estimate.closure_weights.keys() == offline.estimate.closure_weights.keys()
    assert len(live.estimate.closure_weights) >= 3
    apart_m = live.trajectory.T_world_lidar[:, :3, 3] - offline.trajectory.T_world_lidar[:, :3, 3]
    assert np.abs(apart_m).max() < 0.05


@pytest.mark.slow
def test_a_live_run_shows_how_it_stands_in_a_terminal(tmp_path: Path) -> None:
    folder, ended = tmp_path / "scans", threading.Event()
    folder.mkdir()

    def feed() -> None:
        number = 0
        while not ended.wait(0.5):
            write_scan(folder, round_drive()[0][number % 2], f"{number:06d}")
            if (tmp_path / "run" / "log.mcap").is_file() and number > 40:
                return
            number += 1

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        words = ("live", str(folder), "--out", str(tmp_path / "run"), "--idle", "3", *SETTINGS)
        status, shown = in_terminal("-m", "segslam", *words)
    finally:
        ended.set()
        feeder.join()
    assert status == 0, shown
    assert "waiting for scans" in shown
    assert "ms after the scan" in shown
    assert "results in" in shown
    assert "Traceback" not in shown


def test_a_live_run_is_not_resumed_and_the_message_has_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = LogWriter(tmp_path / "log.mcap", config=Config(), dataset="live/scans", options={"live": "live/scans"})
    log.close()
    assert run("resume", tmp_path) == 2
    assert f"segslam replay {tmp_path} --out NEW" in capsys.readouterr().err


def test_without_ros_one_line_has_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("segslam.cli.live.find_spec", lambda name: None)
    assert run("live", "--topic", "/points", "--out", tmp_path / "run") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--topic needs ROS 2" in line
    assert "pip install" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_file_with_fixes_is_for_after_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "my fixes.csv").touch()
    out = tmp_path / "run"
    assert run("live", tmp_path, "--gnss", tmp_path / "my fixes.csv", "--out", out) == 2
    assert f"after the run: segslam georeference {out} --gnss '{tmp_path}/my fixes.csv'" in capsys.readouterr().err
    assert not out.exists()


def test_loops_that_are_not_tried_in_time_are_searched_at_the_end() -> None:
    scans, truth = round_drive()
    slam = drifting_slam()
    steps = [slam.close_loops(slam.track(scan), tries_loops=False) for scan in scans]
    assert not any(step.attempts for step in steps)
    result = slam.finish()
    assert sum(isinstance(attempt.outcome, LoopClosure) for attempt in result.attempts) >= 1
    error_m = trajectory_metrics(result.trajectory.T_world_lidar, truth.T_world_lidar)["ate_m"]
    assert error_m < trajectory_metrics(result.odometry.T_world_lidar, truth.T_world_lidar)["ate_m"] / 2


def test_a_faster_odometry_is_recommended_where_many_scans_were_dropped() -> None:
    assert too_slow({"num_scans_dropped": 1, "num_scans_arrived": 100}, 1.0) == ""
    assert too_slow({"num_scans_dropped": 30, "num_scans_arrived": 100, "num_restarts": 1}, 0.4) == ""
    advice = too_slow({"num_scans_dropped": 30, "num_scans_arrived": 100}, 0.4)
    assert advice.startswith("30 of 100 scans were dropped")
    assert "--set odometry.voxel_size_m=0.6 " in advice


@pytest.mark.slow
def test_a_source_that_hangs_does_not_keep_a_run_from_ending() -> None:
    with Front(HangingSource(), dict.fromkeys(PRESETS, Config()), tell=lambda text: None) as front:
        front.wait_until_ready()
        front.stop()
        assert list(front) == []
    assert not front.ended.failed
    assert "did not end" in front.ended.why

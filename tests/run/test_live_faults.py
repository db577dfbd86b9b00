"""A live run continues after any scan, and after the death of a process; every scan is accounted for."""

import os
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from time import sleep

import numpy as np
import pytest
from helpers.drives import round_drive
from helpers.hanging_source import HangingSource
from helpers.live_command import LiveCommand, record, write_scan

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.interrupts import stopped_by_signals
from segslam.core.types import BadScan, Scan, SegslamError
from segslam.odometry.tracker import Tracked, Tracker
from segslam.output.log import read_log
from segslam.run.live.folder import FolderSource
from segslam.run.live.front import Front
from segslam.run.live.serve import Ended, OdometryEnded, Past, Placed, _place_all
from segslam.run.live.waiting import Arrival, Waiting
from segslam.scans.presets import SETTINGS as PRESETS

SETTINGS = ("--set", "odometry.min_range_m=1")
INTERVAL_NS = 300_000_000


@contextmanager
def watched(folder: Path, waiting: Waiting) -> Iterator[FolderSource]:
    source, stopped = FolderSource(folder), threading.Event()
    source.open(lambda text: None)
    thread = threading.Thread(target=source.feed, args=(waiting, stopped))
    thread.start()
    try:
        yield source
    finally:
        stopped.set()
        thread.join()
        source.close()


def taken(waiting: Waiting) -> Arrival:
    arrival = waiting.take(5.0)
    assert arrival is not None
    return arrival


def test_a_file_removed_before_it_is_read_is_counted_and_changes_no_stamp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.stat

    def stat(self: Path, **options: bool) -> os.stat_result:
        if self.stem == "gone":
            raise FileNotFoundError(2, "No such file or directory")
        return real(self, **options)

    monkeypatch.setattr(Path, "stat", stat)
    waiting, scan = Waiting(most=9), round_drive()[0][0]
    with watched(tmp_path, waiting):
        for name in ("a", "gone", "b", "c"):
            write_scan(tmp_path, scan, name)
            sleep(0.02)
        arrivals = [taken(waiting) for _ in range(4)]
    with pytest.raises(BadScan, match=r"gone\.bin: no such file; leave files until"):
        arrivals[1].read(1, 0)
    stamps = [arrivals[number].stamp_ns for number in (0, 2, 3)]
    assert 0 < stamps[2] - stamps[0] < 5_000_000_000
    assert (waiting.tally.num_arrived, waiting.tally.num_clock_set, waiting.tally.num_missing) == (4, 0, 0)


@pytest.mark.parametrize("stem", ["9999999999999900001", "9999999999999999"])
def test_a_stamp_that_no_time_has_makes_a_scan_unusable(tmp_path: Path, stem: str) -> None:
    waiting, scan = Waiting(most=9), round_drive()[0][0]
    with watched(tmp_path, waiting):
        write_scan(tmp_path, scan, stem)
        wild = taken(waiting)
        write_scan(tmp_path, scan, "1700000000.5")
        good = taken(waiting)
    with pytest.raises(BadScan, match="no time between 1970 and 2116"):
        wild.read(0, wild.stamp_ns)
    assert good.stamp_ns == 1_700_000_000_500_000_000
    assert waiting.tally.num_arrived == 2


def test_a_name_that_is_used_again_is_another_scan(tmp_path: Path) -> None:
    waiting, scans = Waiting(most=9), round_drive()[0]
    with watched(tmp_path, waiting):
        for scan in scans[:3]:
            write_scan(tmp_path, scan, "latest")
            arrival = taken(waiting)
            assert len(arrival.read(0, 0).points) == len(scan.points)


def test_a_file_that_is_created_empty_and_written_later_gives_its_scan(tmp_path: Path) -> None:
    waiting, file = Waiting(most=9), tmp_path / "a.bin"
    with watched(tmp_path, waiting):
        file.touch()
        empty = taken(waiting)
        sleep(0.02)
        np.ones(40, "<f4").tofile(file)
        written = taken(waiting)
    with pytest.raises(BadScan):
        empty.read(0, 0)
    assert len(written.read(1, 0).points) == 10


def test_a_source_that_is_opened_again_gives_the_scans_that_it_missed_once(tmp_path: Path) -> None:
    scan, waiting = round_drive()[0][0], Waiting(most=9)
    write_scan(tmp_path, scan, "before")
    with watched(tmp_path, waiting) as source:
        write_scan(tmp_path, scan, "first")
        taken(waiting)
    sleep(0.02)
    for name in ("missed 1", "missed 2"):
        write_scan(tmp_path, scan, name)
        sleep(0.02)
    stopped, again = threading.Event(), Waiting(most=9)
    source.open(lambda text: None)
    thread = threading.Thread(target=source.feed, args=(again, stopped))
    thread.start()
    sleep(0.5)
    stopped.set()
    thread.join()
    assert again.tally.num_arrived == 2


class _Published(HangingSource):
    """Fails for the second scan, like a middleware without a network."""

    def publish(self, arrival: Arrival, T_odom_lidar: np.ndarray) -> None:
        if arrival.index == 1:
            raise RuntimeError("no subscriber")


def raises(error: BaseException) -> Callable[[int, int], Scan]:
    def read(index: int, stamp_ns: int) -> Scan:
        raise error

    return read


class _Breaks(Tracker):
    """A tracker in which some scans break something."""

    def track(self, scan: Scan, *, gap: float = 1.0) -> Tracked:
        if scan.index == 3:
            raise ValueError("points span too many cells\nand more")
        if scan.index == 7:
            raise SegslamError("the odometry process has ended")
        return super().track(scan, gap=gap)


def test_whatever_a_scan_raises_is_counted_and_the_run_continues_until_the_odometry_ends() -> None:
    scans, waiting = round_drive()[0], Waiting(most=9)
    reads: list[Callable[[int, int], Scan]] = [
        lambda index, stamp_ns: Scan(scans[index].points, stamp_ns, index) for _ in range(8)
    ]
    reads[2] = raises(MemoryError("Unable to allocate 29 TiB"))
    reads[5] = raises(KeyError("odd"))
    for number, read in enumerate(reads):
        waiting.put(INTERVAL_NS * number, read)
    sent: SimpleQueue[object] = SimpleQueue()
    with pytest.raises(OdometryEnded, match="has ended"):
        _place_all(_Breaks(Config()).track, _Published(), waiting, sent, None, Past([], deque()))
    items = [sent.get() for _ in range(sent.qsize())]
    placed = [item.tracked for item in items if isinstance(item, Placed)]
    bad = {number: str(one) for number, one in enumerate(placed) if isinstance(one, BadScan)}
    assert bad.keys() == {2, 3, 5}
    assert bad[2] == "scan 2: cannot be used (MemoryError: Unable to allocate 29 TiB)"
    assert bad[3] == "scan 3: cannot be used (ValueError: points span too many cells)"
    assert len(placed) == 7
    assert any("the pose of scan 1 was not published" in item for item in items if isinstance(item, str))


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["front", "odometry"])
def test_a_process_that_is_killed_is_started_again_from_its_last_pose(tmp_path: Path, victim: str) -> None:
    folder, run = tmp_path / "scans", tmp_path / "run"
    folder.mkdir()
    scans = list(round_drive()[0][:14])
    with LiveCommand(folder, "--out", run, "--idle", "4", *SETTINGS) as command:
        command.wait_for("waiting for scans")
        record(folder, scans[:6], every_s=0.8)
        sleep(1.0)
        pids = _spawned(command.pid)
        os.kill(pids[0] if victim == "front" else _spawned(pids[0])[0], signal.SIGKILL)
        if victim == "odometry":
            write_scan(folder, scans[6], "000006")  # meets it
        else:
            sleep(0.5)
            write_scan(folder, scans[6], "000006")  # appears while the folder is not watched
        command.wait_for("runs again")
        record(folder, scans[7:], every_s=0.8, first=7)
        status, metrics = command.ended()
    assert status == 0, command.output
    assert "starting it again" in command.output
    assert "--resume" not in command.output
    assert metrics["num_scans_arrived"] == 14
    assert metrics["num_scans"] + metrics["num_scans_skipped"] + metrics["num_scans_dropped"] == 14
    assert metrics["num_restarts"] == 1
    steps = list(read_log(run / "log.mcap").steps(clouds=False))
    assert min(step.scan_index for step in steps) < 6 < max(step.scan_index for step in steps)
    T_first_true = geometry.inverse(round_drive()[1].T_world_lidar[steps[0].scan_index])
    for step in steps:  # without the last poses, the second process would start at the origin again
        T_true = T_first_true @ round_drive()[1].T_world_lidar[step.scan_index]
        assert np.linalg.norm(step.T_odom_lidar[:3, 3] - T_true[:3, 3]) < 1.0


def _spawned(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]


@pytest.mark.long
def test_a_front_process_that_is_killed_while_it_stops_ends_the_run() -> None:
    with Front(HangingSource(), dict.fromkeys(PRESETS, Config()), tell=lambda text: None) as front:
        front.wait_until_ready()
        front.stop()
        front._process.kill()
        assert list(front) == []
    assert not front.ended.failed
    assert front.num_restarts == 0


@pytest.mark.long
def test_a_signal_that_does_not_end_a_wait_for_scans_is_heard(tmp_path: Path) -> None:
    """Received by another thread here; one that arrives just before the wait begins has the same effect."""
    late: list[bool] = []
    with Front(FolderSource(tmp_path), dict.fromkeys(PRESETS, Config()), tell=lambda _: None) as front:
        front.wait_until_ready()
        receiver = threading.Thread(target=sleep, args=(5,), daemon=True)
        receiver.start()
        signalling = threading.Timer(0.5, signal.pthread_kill, (receiver.ident, signal.SIGTERM))
        giving_up = threading.Timer(30, lambda: (late.append(True), front.stop()))
        with stopped_by_signals(front.stop):
            signalling.start()
            giving_up.start()
            assert front.wait_until_chosen() is None
        giving_up.cancel()
    assert late == []
    assert front.is_stopping


@pytest.mark.long
@pytest.mark.parametrize("fails", ["start", "tell"])
def test_a_front_process_that_cannot_be_started_again_ends_the_run(fails: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(*_: object) -> None:
        raise OSError(12, "Cannot allocate memory")

    with Front(HangingSource(), dict.fromkeys(PRESETS, Config()), tell=lambda _: None) as front:
        front.wait_until_ready()
        monkeypatch.setattr(front, f"_{fails}", no_memory)
        giving_up = threading.Timer(30, lambda: front._received.put(Ended("waits forever")))
        giving_up.start()
        front._process.kill()
        assert list(front) == []
        giving_up.cancel()
    assert front.ended.failed
    assert "Cannot allocate memory" in front.ended.why


@pytest.mark.long
def test_an_exception_in_the_main_process_ends_the_front_process_at_once() -> None:
    errors: list[threading.ExceptHookArgs] = []
    before, threading.excepthook = threading.excepthook, errors.append
    try:
        front = Front(HangingSource(), dict.fromkeys(PRESETS, Config()), tell=lambda _: None)
        with pytest.raises(SegslamError, match="disk"):
            _fails_within(front)
    finally:
        threading.excepthook = before
    assert errors == []
    assert not front._process.is_alive()


def _fails_within(front: Front) -> None:
    with front:
        front.wait_until_ready()
        raise SegslamError("disk full")


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a small disk")
def test_a_full_disk_ends_a_live_run_with_the_remedy_though_no_scan_comes(tmp_path: Path) -> None:
    folder, disk = tmp_path / "scans", tmp_path / "disk"
    folder.mkdir()
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", disk], capture_output=True)
    if mounted.returncode:
        pytest.skip("no file system may be mounted here")
    try:
        with LiveCommand(folder, "--out", disk / "run", *SETTINGS) as command:
            command.wait_for("waiting for scans")
            record(folder, list(round_drive()[0][:6]), every_s=0.8)
            status, _ = command.ended()
        assert status == 2, command.output
        assert "Traceback" not in command.output
        assert f"segslam replay {disk / 'run'} --out NEW" in command.output
        assert read_log(disk / "run" / "log.mcap").num_steps() >= 1
    finally:
        subprocess.run(["umount", disk], check=True)

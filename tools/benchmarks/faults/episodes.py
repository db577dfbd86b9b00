"""One run each with faults, and the check that scans are accounted for, the log reads and the run can be continued."""

import random
import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from time import sleep

import numpy as np

from segslam.core.types import SegslamError
from segslam.output.log import read_log
from tools.benchmarks.faults.commands import Command, kill, small_disk
from tools.benchmarks.faults.files import LIVE, OFFLINE, whole

NUM_SCANS = 36
FAULT_SHARE = 0.4
"""Chosen: share of the scans with a fault."""
IDLE_S = 8.0


@dataclass
class Outcome:
    """What an episode found."""

    faults: Counter[str] = field(default_factory=Counter)
    num_scans: int = 0
    num_unaccounted: int = 0
    problems: list[str] = field(default_factory=list)

    def written(
        self, fault: str | None, folder: Path, rows: np.ndarray, name: str, rng: random.Random, where: str = ""
    ) -> int:
        """Write a scan, with a fault if one is named; the number of scans that a watcher sees."""
        if fault is None:
            return whole(folder, rows, name, rng)
        self.faults[fault + where] += 1
        return LIVE[fault](folder, rows, name, rng)

    def expect(self, *, condition: bool, problem: str) -> None:
        """Note a problem unless the condition holds."""
        if not condition:
            self.problems.append(problem)


def live_episode(scans: list[np.ndarray], out: Path, rng: random.Random, every_s: float) -> Outcome:
    """A folder that fills while files are damaged and processes die; the main process dies at times, too."""
    found, folder, run = Outcome(), out / "scans", out / "run"
    folder.mkdir(parents=True)
    command = Command("live", folder, "--out", run, "--idle", IDLE_S, "--json")
    if not _starts(found, command):
        return found
    kill_at = {rng.randrange(5, NUM_SCANS): rng.choice(("front", "odometry")) for _ in range(rng.randrange(3))}
    main_dies = rng.randrange(8, NUM_SCANS) if rng.random() < 0.25 else None
    for number in range(NUM_SCANS):
        rows, name = scans[number % len(scans)], f"s{number:06d}.bin"
        if number == main_dies:
            found.faults["main process killed"] += 1
            command.process.kill()
            command.ended()
            _check_replay(found, run, out / "again")
            return found
        if number in kill_at:
            found.faults[f"{kill_at[number]} killed"] += 1
            kill(command.process.pid, kill_at[number], rng)
            found.num_scans += whole(folder, rows, name, rng)  # meets or misses the process
            command.wait_for("runs again")
        else:
            fault = rng.choice(sorted(LIVE)) if rng.random() < FAULT_SHARE else None
            found.num_scans += found.written(fault, folder, rows, name, rng)
        sleep(every_s)
    _finish(found, command, run)
    return found


def map_episode(scans: list[np.ndarray], out: Path, rng: random.Random, every_s: float) -> Outcome:
    """A folder with damaged files, mapped by processes that are killed, and resumed until it is complete."""
    found, folder, run = Outcome(num_scans=NUM_SCANS), out / "scans", out / "run"
    folder.mkdir(parents=True)
    for number in range(NUM_SCANS):
        fault = rng.choice(sorted(OFFLINE)) if number > 0 and rng.random() < FAULT_SHARE / 2 else None
        found.written(fault, folder, scans[number % len(scans)], f"{number:06d}.bin", rng, where=" (map)")
    words: tuple[object, ...] = ("map", folder, "--out", run, "--json")
    for _ in range(rng.randrange(1, 3)):
        command = Command(*words)
        sleep(rng.uniform(4.0, 20.0))
        if command.process.poll() is None:
            victim = rng.choice(("main", "main", "odometry"))
            found.faults[f"{victim} killed (map)"] += 1
            kill(command.process.pid, victim, rng)
        command.ended()
        if (run / "log.mcap").is_file():
            words = ("resume", run, "--json")
        else:
            shutil.rmtree(run, ignore_errors=True)
    _finish(found, Command(*words), run)
    return found


def disk_episode(scans: list[np.ndarray], out: Path, rng: random.Random, every_s: float) -> Outcome:
    """A disk that becomes full, in a live run or a mapped one, and has room again afterwards."""
    found, folder, disk = Outcome(), out / "scans", out / "disk"
    run = disk / "run"
    folder.mkdir(parents=True)
    disk.mkdir()
    with small_disk(disk, rng) as grow:
        if grow is None:
            found.faults["disk full: skipped, no file system may be mounted"] += 1
            return found
        if rng.random() < 0.5:
            found.faults["disk full (map)"] += 1
            for number in range(NUM_SCANS):
                found.num_scans += whole(folder, scans[number % len(scans)], f"{number:06d}.bin", rng)
            _expect_full(found, Command("map", folder, "--out", run, "--json"), "segslam resume")
            grow()
            _finish(found, Command("resume", run, "--json"), run)
            return found
        found.faults["disk full (live)"] += 1
        command = Command("live", folder, "--out", run, "--json", "--idle", 60)
        command.wait_for("waiting for scans")
        for number in range(NUM_SCANS):
            if command.process.poll() is not None:
                break
            whole(folder, scans[number % len(scans)], f"s{number:06d}.bin", rng)
            sleep(every_s)
        _expect_full(found, command, "segslam replay")
        grow()
        _check_replay(found, run, disk / "again")
    return found


def topic_episode(scans: list[np.ndarray], out: Path, rng: random.Random, every_s: float) -> Outcome:
    """A topic that stops for some seconds; needs ROS 2."""
    import rclpy

    from tools.benchmarks.live import TOPIC, RosSender

    found, run = Outcome(), out / "run"
    command = Command("live", "--topic", TOPIC, "--out", run, "--idle", IDLE_S, "--json")
    sender = RosSender("reliable")
    if not _starts(found, command):
        return found
    sender.wait_for_listener()
    for number in range(NUM_SCANS // 2):
        if number == NUM_SCANS // 4:
            found.faults["topic stops"] += 1
            sleep(IDLE_S / 2)
        sender.send(scans[number % len(scans)][:, :3], 0)
        found.num_scans += 1
        sleep(every_s)
    _finish(found, command, run)
    rclpy.shutdown()
    return found


EPISODES = {"live": live_episode, "map": map_episode, "disk": disk_episode, "topic": topic_episode}


def _starts(found: Outcome, command: Command) -> bool:
    """Wait until a live run can receive scans."""
    is_ready = command.wait_for("waiting for scans")
    found.expect(condition=is_ready, problem=f"did not start: {command.lines[-1:]}")
    return is_ready


def _expect_full(found: Outcome, command: Command, remedy: str) -> None:
    status, _ = command.ended()
    said = any(remedy in line for line in command.lines)
    found.expect(condition=status == 2 and said, problem=f"full disk: status {status}: {command.lines[-2:]}")
    found.expect(condition=not command.has_traceback, problem="traceback on a full disk")


def _finish(found: Outcome, command: Command, run: Path) -> None:
    """Wait for the end of a command, and count its scans."""
    status, metrics = command.ended()
    found.expect(condition=status == 0, problem=f"{command.name} ended with {status}: {command.lines[-3:]}")
    found.expect(condition=not command.has_traceback, problem=f"traceback of {command.name}")
    num_scans = metrics.get("num_scans", 0)
    counted = num_scans + metrics.get("num_scans_skipped", 0) + metrics.get("num_scans_dropped", 0)
    found.num_unaccounted += abs(found.num_scans - counted)
    num_steps = _num_steps(found, run)
    found.expect(condition=num_steps == num_scans, problem=f"{num_steps} steps in the log of {num_scans} scans")


def _num_steps(found: Outcome, run: Path) -> int:
    """Number of steps in the log; a log that does not read is a problem."""
    try:
        return len(list(read_log(run / "log.mcap").steps()))
    except SegslamError as error:
        found.problems.append(str(error))
        return 0


def _check_replay(found: Outcome, run: Path, again: Path) -> None:
    """The log of a run that ended early gives its results by a replay."""
    num_steps = _num_steps(found, run)
    status, metrics = (command := Command("replay", run, "--out", again, "--json")).ended()
    is_whole = status == 0 and metrics.get("num_scans") == num_steps
    found.expect(condition=is_whole or num_steps == 0, problem=f"replay ended with {status}: {command.lines[-3:]}")

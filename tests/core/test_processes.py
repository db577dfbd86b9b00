import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import pytest

from segslam.core import memory, processes
from segslam.core.memory import peak_mb
from segslam.core.processes import in_parts

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="one process elsewhere")
ME = os.getpid()


@pytest.fixture(autouse=True)
def _three_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(threading, "active_count", lambda: 1)  # those of pytest do not matter here


def squares(part: Sequence[int]) -> Iterator[tuple[int, int]]:
    return ((number**2, os.getpid()) for number in part)


def test_results_are_in_order_and_each_part_has_its_process() -> None:
    done = list(in_parts(range(8), squares))
    assert [number for number, _ in done] == [number**2 for number in range(8)]
    pids = [pid for _, pid in done]
    assert pids[:3] == [ME] * 3
    assert len(set(pids)) == 3
    assert list(in_parts([], squares)) == []
    assert list(in_parts([7], squares)) == [(49, ME)]


def test_all_is_done_here_while_other_threads_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    assert {pid for _, pid in in_parts(range(8), squares)} == {ME}


def test_what_a_copy_does_not_finish_is_done_here() -> None:
    def ends(part: Sequence[int]) -> list[int]:
        if os.getpid() != ME and 7 in part:
            os._exit(3)
        return list(part)

    assert list(in_parts(range(8), ends)) == list(range(8))

    def fails(part: Sequence[int]) -> list[int]:
        if 7 in part:
            raise ValueError("seven")
        return list(part)

    with pytest.raises(ValueError, match="seven"):
        list(in_parts(range(8), fails))


def test_without_room_for_a_copy_all_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> int:
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(os, "fork", full)
    assert {pid for _, pid in in_parts(range(8), squares)} == {ME}


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The ids of all copies."""
    pids: list[int] = []
    fork = os.fork

    def noted() -> int:
        pids.append(fork())
        return pids[-1]

    monkeypatch.setattr(os, "fork", noted)
    return pids


def is_left(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_no_process_is_left_when_the_work_is_given_up(begun: list[int]) -> None:
    for _ in in_parts(range(8), lambda part: squares(list(part) * 10_000)):
        break
    assert len(begun) == 2
    assert not any(map(is_left, begun))


def test_no_process_is_left_when_another_cannot_begin(begun: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = processes.Pipe

    def once(**more: bool) -> object:
        if begun:
            raise OSError("too many open files")
        return pipe(**more)

    monkeypatch.setattr(processes, "Pipe", once)
    with pytest.raises(OSError, match="too many"):
        list(in_parts(range(8), squares))
    assert len(begun) == 1
    assert not is_left(begun[0])


def test_only_the_part_that_is_done_here_is_shown() -> None:
    seen: list[tuple[str, int]] = []

    def progress(done: Iterable[tuple[int, int]], total: int, title: str) -> Iterator[tuple[int, int]]:
        for one in done:
            seen.append((title, total))
            yield one

    assert len(list(in_parts(range(8), squares, progress=progress, title="squares"))) == 8
    assert seen == [("squares", 3)] * 3


def test_memory_of_the_copies_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_together_mb", 0.0)
    alone_mb = peak_mb()

    def large(part: Sequence[int]) -> list[int]:
        kept = bytearray(40 * 2**20) if os.getpid() != ME else b""
        return [len(kept)]

    assert len(list(in_parts(range(3), large))) == 3
    assert 80.0 < peak_mb() - alone_mb < 160.0


def test_a_copy_is_not_ended_by_ctrl_c() -> None:
    def interrupted(part: Sequence[int]) -> list[int]:
        if os.getpid() != ME:
            os.kill(os.getpid(), signal.SIGINT)
        return [os.getpid()]

    assert len(set(in_parts(range(3), interrupted))) == 3


ENDS_BEFORE_ITS_COPY = """
import os, time
import numpy as np
from segslam.core import processes
os.sched_getaffinity = lambda _: {0, 1}
def work(part):
    for number in part:
        if number:
            print(os.getpid(), flush=True)
            yield np.zeros(200_000)
        else:
            time.sleep(1.0)
            os._exit(130)
list(processes.in_parts([0, 1], work))
"""


def test_a_copy_ends_with_its_process_though_its_results_were_not_received() -> None:
    with subprocess.Popen([sys.executable, "-c", ENDS_BEFORE_ITS_COPY], stdout=subprocess.PIPE, text=True) as ended:
        assert ended.stdout is not None
        copy = int(ended.stdout.readline())
        assert ended.wait() == 130
    until = time.monotonic() + 5.0
    while is_running(copy):
        if time.monotonic() > until:
            os.kill(copy, signal.SIGKILL)
            pytest.fail("the copy waits for ever")
        time.sleep(0.05)


def is_running(pid: int) -> bool:
    """False also for a process that has ended and whose parent did not ask for its status."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().split()[2] != "Z"

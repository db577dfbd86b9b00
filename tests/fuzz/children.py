"""Readers on damaged files, in child processes: a signal, a hang or a greedy reader ends the child only."""

import gc
import json
import os
import resource
import select
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from segslam.core.errors import SegslamError

MAX_CPU_S = 1.0
"""Longest processor time for a file, the shorter of two readings; the clock on the wall would measure the other jobs of
the machine, and a machine that is stopped and started again adds its pause to one of the readings."""
MAX_MEMORY, SPARE_BYTES = 2, 64 * 2**20
"""Most memory: twice the size of the file, and what libraries take on the way."""
ADDRESS_BYTES = 8 * 2**30
"""Limit of the address space above the present, so that a greedy reader does not harm the machine."""
HANG, HANG_S = "hang", 60.0
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Defect(NamedTuple):
    """What a reader did on a file, and must not."""

    kind: str
    data: bytes


class _TooLong(BaseException):
    pass


def defects(read: Callable[[Path], Any], file: Path, contents: Sequence[bytes]) -> list[Defect]:
    """The defects of a reader on these contents of a file. A SegslamError that names the file is none.

    A file at which the child stands still is read again by another: machines stand still as well.
    """
    found: list[Defect] = []
    at = 0
    while at < len(contents):
        outcomes, end = _in_child(read, file, contents[at:])
        found += [Defect(kind, data) for kind, data in zip(outcomes, contents[at:], strict=False) if kind]
        at += len(outcomes)
        if at < len(contents):
            if end == HANG:
                outcomes, end = _in_child(read, file, contents[at : at + 1])
                end = outcomes[0] if outcomes else end
            found += [Defect(end, contents[at])] if end else []
            at += 1
    return found


def _in_child(read: Callable[[Path], Any], file: Path, contents: Sequence[bytes]) -> tuple[list[str], str]:
    """The outcome of each content until the child ended, and how it ended.

    The child does not delete what the parent no longer needs: threads that it would wait for do not exist there. It
    would do so within `fork` already, unless garbage collection is off in the parent.
    """
    source, sink = os.pipe()
    gc.disable()
    child = os.fork()
    if child == 0:
        gc.freeze()
        gc.enable()
        os.close(source)
        try:
            _work(read, file, contents, sink)
        finally:
            os._exit(0)
    gc.enable()
    os.close(sink)
    outcomes, hangs = _received(source)
    if hangs:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return outcomes, HANG if hangs else f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else "exit"


def _received(source: int) -> tuple[list[str], bool]:
    """The lines that the child wrote, and whether it stopped to write them."""
    lines = b""
    with os.fdopen(source, "rb", buffering=0) as pipe:
        while True:
            hangs = not select.select([pipe], [], [], HANG_S)[0]
            piece = b"" if hangs else pipe.read(65536)
            if not piece:
                return [json.loads(line) for line in lines.splitlines()], hangs
            lines += piece


def _work(read: Callable[[Path], Any], file: Path, contents: Sequence[bytes], sink: int) -> None:
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    present = int(Path("/proc/self/statm").read_text().split()[0]) * PAGE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (present + ADDRESS_BYTES, present + ADDRESS_BYTES))
    signal.signal(signal.SIGPROF, _stop)
    with os.fdopen(sink, "wb", buffering=0) as pipe:
        for content in contents:
            file.unlink(missing_ok=True)
            file.write_bytes(content)
            pipe.write(json.dumps(_outcome(read, file)).encode() + b"\n")


def _outcome(read: Callable[[Path], Any], file: Path) -> str:
    """The kind of a defect; empty if there is none."""
    kind, spent = _one_reading(read, file)
    if not kind and spent > MAX_CPU_S:
        kind, again = _one_reading(read, file)
        spent = min(spent, again)
    return kind or (f"{spent:.0f} s" if spent > MAX_CPU_S else "")


def _one_reading(read: Callable[[Path], Any], file: Path) -> tuple[str, float]:
    """The kind of a defect, empty if there is none, and the processor time in seconds."""
    size = file.stat().st_size
    before = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_BYTES
    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.process_time()
    kind = ""
    try:
        signal.setitimer(signal.ITIMER_PROF, 10 * MAX_CPU_S)
        read(file)
    except SegslamError as error:
        kind = "" if named(error, file) else f"error that does not name the file: {str(error)[:100]}"
    except _TooLong:
        kind = "more than ten seconds"
    except BaseException as error:
        kind = f"{type(error).__name__} {_place(error)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    spent = time.process_time() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if not kind and peak > highest and peak * 1024 - before > MAX_MEMORY * size + SPARE_BYTES:
        kind = f"{(peak * 1024 - before) >> 20} MB"
    return kind, spent


def named(error: SegslamError, file: Path) -> bool:
    """True if the one line of the error names the file, or the recording that it belongs to."""
    return "\n" not in str(error) and len(str(error)) < 2000 and str(file.parent) in str(error)


def _place(error: BaseException) -> str:
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/segslam/" in frame.filename]
    return f"{frames[-1].filename.split('/segslam/')[-1]}:{frames[-1].lineno}" if frames else ""


def _stop(*_: Any) -> None:
    raise _TooLong

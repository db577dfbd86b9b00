"""Damaged files: an error that names the file or a result, in a second and with little memory, and nothing else."""

import gc
import mmap
import os
import re
import signal
import time
from pathlib import Path

import pytest

from fuzz.__main__ import contents, warm_up
from fuzz.children import MAX_CPU_S, defects
from fuzz.targets import Target, targets

CORPUS = Path(__file__).parent / "corpus"
NUM_INPUTS = 40
"""For each reader, in about 4 s for all; `bash tools/fuzz.sh` tries more."""


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    made = {target.name: target for target in targets(tmp_path_factory.mktemp("readers"))}
    warm_up(list(made.values()))
    return made


@pytest.mark.long
def test_no_damaged_file_does_more_than_fail(readers: dict[str, Target]) -> None:
    for name, target in readers.items():
        found = defects(target.read, target.file, contents(target, 0, NUM_INPUTS))
        assert not found, f"{name}: {found}"


def test_what_once_did_more_fails_now(readers: dict[str, Target]) -> None:
    kept = {name: sorted((CORPUS / name).iterdir()) for name in readers if (CORPUS / name).is_dir()}
    assert sum(map(len, kept.values())) > 10
    for name, files in kept.items():
        found = defects(readers[name].read, readers[name].file, [file.read_bytes() for file in files])
        assert not found, f"{name}: {[(kind, data[:100]) for kind, data in found]}"


def _fail(file: Path) -> None:
    match file.read_bytes():
        case b"signal":
            os.kill(os.getpid(), signal.SIGSEGV)
        case b"exception":
            raise KeyError("x")
        case b"memory":
            fresh = mmap.mmap(-1, 205 * 2**20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)  # not memory freed before
            for page in range(0, len(fresh), 4096):
                fresh[page] = 1
        case b"time":
            started = time.process_time()
            while time.process_time() < started + 1.1 * MAX_CPU_S:
                pass


@pytest.mark.parametrize(
    ("content", "kind"),
    [(b"signal", "signal 11"), (b"exception", "KeyError "), (b"memory", "20. MB"), (b"time", r"\d+ s")],
)
def test_a_defect_is_found_and_the_files_after_it_are_tried(tmp_path: Path, content: bytes, kind: str) -> None:
    found = defects(_fail, tmp_path / "file", [b"good", content, b"exception"])
    assert [data for _, data in found] == [content, b"exception"]
    assert re.fullmatch(kind, found[0].kind)


def test_a_hang_counts_if_it_repeats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fuzz.children.HANG_S", 0.3)

    def read(file: Path) -> None:
        seen = tmp_path / "seen"
        if file.read_bytes() == b"always" or (file.read_bytes() == b"once" and not seen.exists()):
            seen.touch()
            time.sleep(30)

    found = defects(read, tmp_path / "file", [b"good", b"once", b"good", b"always", b"good"])
    assert [(kind, data) for kind, data in found] == [("hang", b"always")]


@pytest.mark.long
def test_a_child_does_not_delete_what_its_parent_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deleted, fork = tmp_path / "deleted", os.fork

    class Left:
        def __init__(self) -> None:
            self.cycle = self

        def __del__(self) -> None:
            with deleted.open("a") as text:
                text.write(f"{os.getpid()}\n")

    def collecting_fork() -> int:
        """Python's own steps after a fork allocate, so that a collection may start in the child within `fork`."""
        child = fork()
        if child == 0 and gc.isenabled():
            gc.collect()
        return child

    monkeypatch.setattr(os, "fork", collecting_fork)
    gc.collect()
    Left()
    assert not defects(lambda _: gc.collect(), tmp_path / "file", [b"good"])
    gc.collect()
    assert deleted.read_text().split() == [str(os.getpid())]

"""Workers and schedulers that die, a disk that is full, a damaged drive: is the fleet the same afterwards?"""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tools.benchmarks.common import Row
from tools.benchmarks.fleet.towns import fleet_command, write_list

STEPS = {"map_drive": "runs", "index_drive": "index", "propose": "proposals", "relate": "pairs", "join": "component_*"}
"""The functions of `segslam.run.fleets.steps` and the folders that they fill."""
COMPARED = ("poses_tum.txt", "graph.g2o")
FIRST_PORT, WAIT_S = 18700, 1800
SMALL_DISK = 200_000
"""Bytes of the largest file that a worker with a full disk can write."""


def troubles(out: Path, drives: Sequence[Path]) -> list[Row]:
    """A row for each trouble: how the command ended, whether the bytes are the same, what was done twice."""
    listed = write_list(out / "drives.yaml", drives)
    reference = out / "reference"
    subprocess.run(fleet_command(listed, reference, "--workers", "1"), check=True)
    rows: list[Row] = []
    for number, step in enumerate((*STEPS, "scheduler: map_drive", "scheduler: relate", "full disk", "damaged drive")):
        rows.append(_Trial(out / f"{number}", reference, listed, FIRST_PORT + number).row(step))
        print(rows[-1], flush=True)
    return rows


class _Trial:
    """One trouble in a folder of its own, where the steps before it are finished."""

    def __init__(self, folder: Path, reference: Path, listed: Path, port: int) -> None:
        self._folder, self._reference, self._listed, self._port = folder, reference, listed, port
        self._address = f"tcp://127.0.0.1:{port}"
        self._command = fleet_command(listed, folder, "--scheduler", self._address)

    def row(self, step: str) -> Row:
        """Cause the trouble, call again where the command failed, and compare."""
        first, _, function = step.rpartition(": ")
        if step == "full disk":
            statuses, before = self._full_disk()
        elif step == "damaged drive":
            statuses, before = self._damaged()
        else:
            statuses, before = self._killed(function, whole_scheduler=bool(first))
        again = [name for name, time_ns in before.items() if Path(name).stat().st_mtime_ns != time_ns]
        return {"trouble": step, "status": statuses, "same bytes": self._same(), "done twice": len(again)}

    def _killed(self, function: str, *, whole_scheduler: bool) -> tuple[list[int], dict[str, int]]:
        """SIGKILL while a worker does this step."""
        self._copy_until(function)
        with self._cluster() as scheduler:
            command = subprocess.Popen(self._command)
            pid = self._working_on(function)
            before = self._finished()
            os.kill(scheduler.pid if whole_scheduler else pid, signal.SIGKILL)
            statuses = [command.wait(WAIT_S)]
        if statuses[0]:
            statuses.append(self._call())
        return statuses, before

    def _full_disk(self) -> tuple[list[int], dict[str, int]]:
        status = self._call(most_bytes=SMALL_DISK)
        states = json.loads((self._folder / "fleet.json").read_text())["drives"]
        print({name: one.get("reason", one["state"]) for name, one in states.items()})
        before = {name: time_ns for name, time_ns in self._finished().items() if "component_" not in name}
        return [status, self._call()], before

    def _damaged(self) -> tuple[list[int], dict[str, int]]:
        """The last drive of the list is a file that is no recording; the others are compared."""
        bad = self._folder.with_suffix(".mcap")
        bad.write_bytes(b"no recording")
        listed = self._folder.with_suffix(".yaml")
        drives = [*json.loads(self._listed.read_text()), {"data": str(bad), "name": "damaged"}]
        listed.write_text(json.dumps(drives))
        status = subprocess.run(fleet_command(listed, self._folder, "--workers", "1")).returncode
        print(json.loads((self._folder / "fleet.json").read_text())["drives"]["damaged"])
        return [status], {}

    def _call(self, *, most_bytes: int | None = None) -> int:
        with self._cluster(most_bytes):
            return subprocess.run(self._command).returncode

    def _copy_until(self, function: str) -> None:
        """What the steps before this one made, from the reference."""
        self._folder.mkdir(parents=True)
        for name in list(STEPS.values())[: list(STEPS).index(function)]:
            for made in self._reference.glob(name):
                shutil.copytree(made, self._folder / made.name, copy_function=shutil.copy2)

    @contextmanager
    def _cluster(self, most_bytes: int | None = None) -> Iterator[subprocess.Popen[bytes]]:
        """The process of a scheduler that has two workers; one may be unable to write files of more bytes."""
        scheduler = ("scheduler", "--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard", "--no-show")
        worker = ("worker", self._address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        with _dask(*scheduler) as process, _dask(*worker, most_bytes=most_bytes), _dask(*worker):
            yield process

    def _working_on(self, function: str) -> int:
        """The process of a worker that does this step now."""
        from distributed import Client

        with Client(self._address, timeout=30) as client:
            client.wait_for_workers(2)
            pids = client.run(os.getpid)
            for _ in range(100 * WAIT_S):
                for worker, keys in client.processing().items():
                    if any(str(key).startswith(function) for key in keys):
                        return int(pids[worker])
                time.sleep(0.01)
        raise SystemExit(f"{function}: no worker did it")

    def _finished(self) -> dict[str, int]:
        """Whole files of the steps, with their times."""
        files = [
            file
            for name in STEPS.values()
            for made in self._folder.glob(name)
            for file in made.rglob("*")
            if file.is_file() and ".part" not in str(file)
        ]
        return {str(file): file.stat().st_mtime_ns for file in files}

    def _same(self) -> bool:
        folders = sorted(self._reference.glob("component_*"))
        return [one.name for one in folders] == [one.name for one in sorted(self._folder.glob("component_*"))] and all(
            (one / name).read_bytes() == (self._folder / one.name / name).read_bytes()
            for one in folders
            for name in COMPARED
        )


@contextmanager
def _dask(*words: str, most_bytes: int | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A process of Dask that is killed at the end."""

    def limit() -> None:
        if most_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    command = [sys.executable, "-m", "dask", *words]
    process = subprocess.Popen(command, preexec_fn=limit, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()

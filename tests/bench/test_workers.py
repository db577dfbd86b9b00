"""A real Dask cluster of two worker processes on this machine."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.drives import round_drive, write_kitti_sequence

from segslam.bench.experiments.benchmark import in_order, run
from segslam.bench.experiments.job import Job
from segslam.bench.experiments.pairs import PairList, Trial, cut_pairs, pair_trials
from segslam.bench.experiments.rows import Row, read_rows
from segslam.core.config import Config
from segslam.core.types import SegslamError
from segslam.run.fleets.workers import _watched, workers
from segslam.scans import DataSource

distributed = pytest.importorskip("distributed")

TIMES = {"ms", "cpu_ms", "label_ms", "prepare_ms", "match_ms", "refine_ms", "verify_ms", "peak_mb"}
"""Columns that differ between runs."""


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    data = tmp_path_factory.mktemp("kitti")
    write_kitti_sequence(data)
    return Job(DataSource(data, labels="true_labels"), ("segregator", "segregator-c2f", "gicp"), Config())


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    _, truth = round_drive()
    whole = cut_pairs(truth, name="revisits", min_m=0.0, max_m=6.0, min_gap=45)
    return pair_trials(PairList("revisits", whole.pairs[::6], len(whole.pairs)), truth)


@pytest.fixture(scope="module")
def here(job: Job, trials: list[Trial]) -> list[Row]:
    return [row for rows in run(job, trials) for row in rows]


def table(rows: list[Row]) -> list[dict[str, object]]:
    return [row.model_dump(exclude=TIMES) for row in rows]


def worker_pids(client: "distributed.Client") -> list[int]:
    return list(client.run(os.getpid).values())


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_nothing_in_the_table(
    job: Job, trials: list[Trial], here: list[Row], tmp_path: Path
) -> None:
    """The cluster is one that was there before, found by its address."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        work = run(job, trials, scheduler=cluster.scheduler_address, folder=tmp_path)
        rows = list(next(work))
        with distributed.Client(cluster) as client:
            victim = worker_pids(client)[0]
            os.kill(victim, signal.SIGKILL)
            rows += [row for some in work for row in some]
            assert victim not in worker_pids(client)
    assert len(here) == 3 * len(trials)
    assert table(in_order(rows, job, trials)) == table(here)
    assert table(in_order(read_rows(tmp_path / "details.csv"), job, trials)) == table(here)


@pytest.mark.slow
def test_a_missing_cluster_is_reported(job: Job, trials: list[Trial]) -> None:
    with pytest.raises(SegslamError, match="no answer"):
        next(run(job, trials, scheduler="tcp://127.0.0.1:9"))


@contextmanager
def scheduler(folder: Path, *, has_worker: bool) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """The process of a scheduler, and its address; with a worker if asked for."""
    file, dask = folder / "scheduler.json", [sys.executable, "-m", "dask"]
    options = ("--port", "0", "--no-dashboard", "--dashboard-address", ":0", "--scheduler-file", str(file))
    with ExitStack() as stack:
        one = stack.enter_context(subprocess.Popen([*dask, "scheduler", *options], stderr=subprocess.DEVNULL))
        stack.callback(one.kill)
        while not file.exists():
            time.sleep(0.1)
        with distributed.Client(scheduler_file=str(file)) as client:
            address = client.scheduler.address
            if has_worker:
                worker = [*dask, "worker", address, "--no-nanny", "--no-dashboard"]
                other = stack.enter_context(subprocess.Popen(worker, stderr=subprocess.DEVNULL, cwd=folder))
                stack.callback(other.kill)
                client.wait_for_workers(1, timeout=30)
        yield one, address


@pytest.mark.long
def test_a_lost_scheduler_is_reported_in_one_line(
    job: Job, trials: list[Trial], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with scheduler(tmp_path, has_worker=True) as (process, address):
        rows = run(job, trials, scheduler=address)
        next(rows)
        with workers(tmp_path, number=1, scheduler=address) as (work, _):
            sleeping = work(time.sleep, [(60.0,)])
            process.terminate()
            for lost in (sleeping, rows):
                with pytest.raises(SegslamError, match="the scheduler is lost; start it and its workers again"):
                    list(lost)
    assert not [record for record in caplog.records if record.name.startswith("distributed")]


@pytest.mark.long
def test_a_benchmark_does_not_wait_for_a_scheduler_without_workers(
    job: Job, trials: list[Trial], tmp_path: Path
) -> None:
    with (
        scheduler(tmp_path, has_worker=False) as (_, address),
        pytest.raises(SegslamError, match="it has no workers; start `dask worker tcp:"),
    ):
        next(run(job, trials, scheduler=address))


@pytest.mark.long
def test_a_scheduler_that_loses_its_last_worker_is_reported_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Dask waits for another one without end."""
    monkeypatch.setattr("segslam.run.fleets.workers.LOOK_EVERY_S", 0.2)
    with (
        scheduler(tmp_path, has_worker=True) as (_, address),
        workers(tmp_path, number=1, scheduler=address) as (_, _),
        distributed.Client(address) as client,
    ):
        client.retire_workers()
        end = time.monotonic() + 20
        while not caplog.messages and time.monotonic() < end:
            time.sleep(0.1)
    assert caplog.messages == [f"--scheduler {address}: no worker is left; start `dask worker {address}` to go on"]


def test_a_lost_scheduler_is_not_taken_for_one_without_workers(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("segslam.run.fleets.workers.LOOK_EVERY_S", 0.01)
    looks: list[None] = []
    lost = SimpleNamespace(scheduler_info=lambda: looks.append(None) or {})
    with _watched(lost, "tcp://localhost:1"):
        end = time.monotonic() + 20
        while len(looks) < 2 and time.monotonic() < end:
            time.sleep(0.01)
    assert len(looks) >= 2
    assert not caplog.messages


STOPPED = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
from segslam.run.fleets.workers import _watched, workers
try:
    with workers(Path(sys.argv[1]), number=2, scheduler=None) as (work, _):
        sleeping = work(time.sleep, [(60.0,), (60.0,)])
        print("ready", flush=True)
        next(sleeping)
except KeyboardInterrupt:
    print("stopped")
"""


@pytest.mark.long
@pytest.mark.usefixtures("ctrl_c_works")
def test_ctrl_c_ends_worker_processes_of_this_machine_and_they_print_nothing(tmp_path: Path) -> None:
    """A terminal sends it to them too."""
    command = (sys.executable, "-c", STOPPED, str(tmp_path))
    out = subprocess.PIPE
    with subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, text=True, start_new_session=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(1.0)
        os.killpg(process.pid, signal.SIGINT)
        assert process.stdout.read() == "stopped\n"


def test_without_dask_the_message_has_the_install_command(
    job: Job, trials: list[Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # as if it were not installed
    with pytest.raises(SegslamError, match=r"pip install 'dask>.*' 'distributed>"):
        next(run(job, trials, workers=2))

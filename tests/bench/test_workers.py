"""A real Dask cluster of two worker processes on this machine."""

import os
import signal
import sys
from pathlib import Path

import pytest
from helpers.drives import round_drive, write_kitti_sequence

from segslam.bench.experiments.benchmark import in_order, run
from segslam.bench.experiments.job import Job
from segslam.bench.experiments.pairs import PairList, Trial, cut_pairs, pair_trials
from segslam.bench.experiments.rows import Row, read_rows
from segslam.core.config import Config
from segslam.core.types import SegslamError
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


def test_without_dask_the_message_has_the_install_command(
    job: Job, trials: list[Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # as if it were not installed
    with pytest.raises(SegslamError, match=r"pip install 'dask>.*' 'distributed>"):
        next(run(job, trials, workers=2))

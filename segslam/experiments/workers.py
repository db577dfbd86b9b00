"""Trials done in this process, or by the workers of a Dask cluster: rows come out as they are finished."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import islice
from typing import Any

from segslam.experiments.job import Job, failed_row, prepare_scan, register_trial
from segslam.experiments.rows import Row
from segslam.experiments.trials import ScanVariant, Trial
from segslam.system.extras import how_to_install
from segslam.types import SegslamError

NUM_SCANS_KEPT = 128
"""Chosen: by one process, up to 15 MB each with all methods; lists that follow the drive come back within as many."""
PAIRS_AHEAD = 8
"""Pairs handed out for each worker: enough that none waits, few enough that their scans fit in memory."""
CONNECT_S = 5
LOST_WORKER = "worker_lost"
"""The reason of a row whose pair ended every worker that tried it."""


def run_here(job: Job, trials: Sequence[Trial]) -> Iterator[list[Row]]:
    """The rows of one trial after the other."""
    prepared = lru_cache(NUM_SCANS_KEPT)(partial(prepare_scan, job))
    for trial in trials:
        yield register_trial(job, trial, prepared(trial.source), prepared(trial.target))


@contextmanager
def cluster(*, workers: int, scheduler: str | None) -> Iterator[Any]:
    """A Dask client: of the cluster at an address, or of one with so many worker processes on this machine.

    Raises SegslamError if Dask is not installed or nothing answers at the address.
    """
    try:
        from distributed import Client, LocalCluster  # optional: extra `cluster`
    except ImportError as error:
        raise SegslamError(f"--workers and --scheduler need Dask: {how_to_install('cluster')}") from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # otherwise it logs each connection
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise SegslamError(
                f"--scheduler {scheduler}: nothing answers there ({error}); start `dask scheduler`"
            ) from error
        with client:
            yield client
        return
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as local,
        Client(local) as client,
    ):
        yield client


def run_on(client: Any, job: Job, trials: Sequence[Trial]) -> Iterator[list[Row]]:
    """The rows of the trials as the workers finish them.

    Each scan is prepared by one worker and handed to whoever registers it. What a worker that dies had, Dask does
    again elsewhere; a pair during which several workers were lost is recorded as failed.
    """
    from distributed import KilledWorker, as_completed

    uses = Counter(variant for trial in trials for variant in (trial.source, trial.target))
    scans: dict[ScanVariant, Any] = {}

    def prepared(variant: ScanVariant) -> Any:
        if variant not in scans:
            scans[variant] = client.submit(prepare_scan, job, variant, pure=False)
        return scans[variant]

    def submit(trial: Trial) -> Any:
        future = client.submit(register_trial, job, trial, prepared(trial.source), prepared(trial.target), pure=False)
        pending[future.key] = trial
        return future

    pending: dict[str, Trial] = {}
    waiting = iter(trials)
    ahead = PAIRS_AHEAD * max(sum(client.nthreads().values()), 1)
    running = as_completed([submit(trial) for trial in islice(waiting, ahead)])
    for future in running:
        trial = pending.pop(future.key)
        try:
            rows = future.result()
        except KilledWorker:
            rows = [failed_row(method, trial, LOST_WORKER) for method in job.methods]
        for variant in (trial.source, trial.target):
            uses[variant] -= 1
            if not uses[variant]:
                scans.pop(variant, None)  # lets the cluster forget it
        for following in islice(waiting, 1):
            running.add(submit(following))
        yield rows

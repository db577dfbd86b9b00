"""Runs trials in this process or on the workers of a Dask cluster; yields rows as they are finished."""

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import islice
from typing import Any

from segslam.bench.experiments.job import Job, failed_row, register_trial, shared_scan
from segslam.bench.experiments.rows import Row
from segslam.bench.experiments.trials import ScanVariant, Trial

NUM_SCANS_KEPT = 128
"""Chosen: scans kept in one process, up to 15 MB each with all methods; consecutive pairs of a drive reuse scans."""
PAIRS_AHEAD = 8
"""Pairs submitted per worker: enough that no worker idles, few enough that their scans fit in memory."""
LOST_WORKER = "worker_lost"
"""Reject reason of a row whose pair terminated every worker that tried it."""


def run_here(job: Job, trials: Sequence[Trial]) -> Iterator[list[Row]]:
    """Yields the rows of one trial after the other."""
    prepared = lru_cache(NUM_SCANS_KEPT)(partial(shared_scan, job))
    for trial in trials:
        yield register_trial(job, trial, prepared(trial.source), prepared(trial.target))


def run_on(client: Any, job: Job, trials: Sequence[Trial]) -> Iterator[list[Row]]:
    """Yields the rows of each trial when a worker finishes it.

    Each scan is prepared by one worker and sent to those that register it. Dask repeats the work of a worker that dies;
    a pair for which several workers died is recorded as failed.
    """
    from distributed import KilledWorker, as_completed

    uses = Counter(variant for trial in trials for variant in (trial.source, trial.target))
    scans: dict[ScanVariant, Any] = {}

    def prepared(variant: ScanVariant) -> Any:
        if variant not in scans:
            scans[variant] = client.submit(shared_scan, job, variant, pure=False)
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
                scans.pop(variant, None)  # the cluster frees the scan
        for following in islice(waiting, 1):
            running.add(submit(following))
        yield rows

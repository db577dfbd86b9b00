"""Runs the trials of a benchmark on one or several workers, stores each row at once, and resumes interrupted runs."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

from segslam.bench.experiments.job import Job, failed_row, register_trial, shared_scan
from segslam.bench.experiments.pairs import ScanVariant, Trial
from segslam.bench.experiments.rows import LOST_WORKER, Row, append_rows, grouped, read_rows, write_rows
from segslam.core.errors import reason
from segslam.core.types import SegslamError
from segslam.core.whole_files import write_whole
from segslam.run.fleets.workers import cluster, result_of

ROWS_FILE = "details.csv"
IDENTITY_FILE = "asked.json"
NUM_SCANS_KEPT = 128
"""Chosen: scans kept in one process, up to 15 MB each with all methods; consecutive pairs of a drive reuse scans."""
PAIRS_AHEAD = 8
"""Pairs submitted per worker: enough that no worker idles, few enough that their scans fit in memory."""


def run(
    job: Job,
    trials: Sequence[Trial],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    folder: Path | None = None,
    before: Sequence[Row] | None = None,
) -> Iterator[list[Row]]:
    """Yields the rows of each trial when it is finished, starting with those already in the folder.

    One worker is this process, several are processes of this machine, those of a scheduler a Dask cluster.
    With a folder, the rows of a trial are on the disk before the next trial is yielded. The same benchmark in the same
    folder continues where it stopped; raises SegslamError if the folder contains another benchmark. `before`: its rows,
    if `rows_before` has read them already.
    """
    done = rows_before(folder, job, trials) if folder and before is None else (before or [])
    tried = grouped(done, lambda row: row.trial_key)
    left = [trial for trial in trials if trial.key not in tried]
    if folder:
        write_rows(folder / ROWS_FILE, done)
    yield from tried.values()
    for rows in _work(job, left, workers, scheduler):
        if folder:
            append_rows(folder / ROWS_FILE, rows)
        yield rows


def in_order(rows: Sequence[Row], job: Job, trials: Sequence[Trial]) -> list[Row]:
    """The rows in the order of a single process, whatever the order in which they were finished."""
    place = {trial.key: number for number, trial in enumerate(trials)}
    return sorted(rows, key=lambda row: (place[row.trial_key], job.methods.index(row.method)))


def _work(job: Job, trials: Sequence[Trial], workers: int, scheduler: str | None) -> Iterator[list[Row]]:
    if workers == 1 and scheduler is None:
        prepared = lru_cache(NUM_SCANS_KEPT)(partial(shared_scan, job))
        for trial in trials:
            yield register_trial(job, trial, prepared(trial.source), prepared(trial.target))
    elif trials:
        with cluster(job.source.data, workers=workers, scheduler=scheduler) as client:
            yield from _run_on(client, job, trials)


def _run_on(client: Any, job: Job, trials: Sequence[Trial]) -> Iterator[list[Row]]:
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
            rows = result_of(future)
        except KilledWorker:
            rows = [failed_row(method, trial, LOST_WORKER) for method in job.methods]
        for variant in (trial.source, trial.target):
            uses[variant] -= 1
            if not uses[variant]:
                scans.pop(variant, None)  # the cluster frees the scan
        for following in islice(waiting, 1):
            running.add(submit(following))
        yield rows


def rows_before(folder: Path, job: Job, trials: Sequence[Trial]) -> list[Row]:
    """The rows of finished trials in a folder; raises SegslamError if they belong to another benchmark."""
    identity = _identity(job, trials)
    file = folder / IDENTITY_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
        if not isinstance(before, dict | None):
            raise ValueError("not an object")
        if before is None:
            write_whole(file, json.dumps(identity, indent=1) + "\n")
    except OSError as error:
        raise SegslamError(f"{file}: cannot be read or written ({reason(error)}); choose another --out") from error
    except ValueError as error:
        raise SegslamError(f"{file}: is not of a benchmark ({error}); choose another --out") from error
    if before is None:
        return []
    for key in identity:
        if before.get(key) != identity[key]:
            raise SegslamError(f"{folder}: contains a benchmark with other {key}; choose another --out, or delete it")
    rows = read_rows(folder / ROWS_FILE) if (folder / ROWS_FILE).exists() else []
    trials_before = grouped([row for row in rows if row.reason != LOST_WORKER], lambda row: row.trial_key).values()
    return [row for some in trials_before if {one.method for one in some} == set(job.methods) for row in some]


def _identity(job: Job, trials: Sequence[Trial]) -> dict[str, Any]:
    """Everything that identifies a benchmark, in readable form."""
    digest = hashlib.sha256()
    for trial in trials:
        digest.update(repr((trial.key, trial.T_target_source.round(6).tolist())).encode())
    return {
        "methods": list(job.methods),
        "settings": job.config.model_dump(mode="json"),
        "data": [str(job.source.data.resolve()), job.source.sequence, job.source.dataset],
        "labels": [job.source.labels, job.source.encoding],
        "pairs": {"number": len(trials), "sha256": digest.hexdigest()},
    }

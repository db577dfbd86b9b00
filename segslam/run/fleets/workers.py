"""Where the steps of a fleet run: in this process, or in a Dask cluster on this machine or that of a scheduler."""

import gc
import logging
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from threading import Event, Thread
from time import process_time
from typing import Any, NamedTuple
from uuid import uuid4

from segslam.core.extras import how_to_install
from segslam.core.memory import give_back, keep_freed_memory
from segslam.core.types import SegslamError

logger = logging.getLogger(__name__)
SHORT_S = 1.5
"""Chosen: CPU time of a task that leaves little behind: it found its result there, or that two drives share no place.
A collection takes 0.1 s."""

LOOK_EVERY_S = 5.0
"""Chosen: pause between two looks at the workers of a scheduler; a nanny replaces a worker that died within it."""


class Outcome(NamedTuple):
    """The result of a task, or why it has none."""

    value: Any
    failure: str | None = None


Workers = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[tuple[int, Outcome]]]
"""Calls a function with several tuples of arguments; yields the number and outcome of each task when it is done."""


def attempted(function: Callable[..., Any], *arguments: Any) -> Outcome:
    """The outcome of one task. A bug, too, is the failure of one task, with its traceback in the worker's log.

    Memory that the task freed is returned to the system when it ends: a worker does many tasks, and what each leaves
    behind in another place of the heap would add up. During the task it is kept: Dask sets a limit of 64 kB for its
    workers (`MALLOC_TRIM_THRESHOLD_`), by which a third of the processor time was spent on clearing pages.
    """
    keep_freed_memory()
    started_s = process_time()
    try:
        return Outcome(function(*arguments))
    except (SegslamError, OSError) as error:
        return Outcome(None, str(error) or type(error).__name__)
    except Exception as error:
        logger.exception("%s failed", function.__name__)
        return Outcome(None, f"{type(error).__name__}: {error}")
    finally:
        if process_time() - started_s > SHORT_S:
            gc.collect()
            give_back()


@contextmanager
def workers(folder: Path, *, number: int, scheduler: str | None) -> Iterator[tuple[Workers, str]]:
    """Runs tasks on the workers of a scheduler, or on so many processes of this machine; with its dashboard's address.

    One process here needs no Dask. Raises SegslamError if Dask is missing, if the scheduler does not answer or has no
    worker, or if a worker has another version or does not see the folder.
    """
    if scheduler is None and number == 1:
        yield lambda function, tasks: ((number, attempted(function, *task)) for number, task in enumerate(tasks)), ""
        return
    with cluster(folder, workers=number, scheduler=scheduler) as client:
        yield partial(_on_cluster, client), client.dashboard_link if scheduler else ""


@contextmanager
def cluster(shared: Path, *, workers: int, scheduler: str | None) -> Iterator[Any]:
    """A Dask client for the scheduler at an address, or for local processes. Raises SegslamError as `workers`."""
    try:
        import dask  # optional package: extra `cluster`
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise SegslamError(f"--workers and --scheduler need Dask: {how_to_install('cluster')}") from error
    logs = [logging.getLogger(name) for name in ("distributed", "distributed.nanny")]
    for one in logs:
        one.setLevel(logging.WARNING)  # their info level reports each connection
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # `result_of` reports a lost scheduler
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=5)
        except (OSError, ValueError) as error:
            raise SegslamError(f"--scheduler {scheduler}: no answer ({error}); start `dask scheduler`") from error
        with client, _watched(client, scheduler):
            _check(client, shared, scheduler)
            yield client
        return
    with dask.config.set({"distributed.worker.daemon": False}):  # a worker that is started again reads it, too
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for this process, which ends all
        try:
            options = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.ERROR}
            local = LocalCluster(n_workers=workers, **options)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with local, Client(local) as client:
            _check(client, shared, scheduler)
            try:
                yield client
            finally:
                for one in logs:
                    one.setLevel(logging.CRITICAL)  # after Ctrl-C they report each worker that is ended amid a task


@contextmanager
def _watched(client: Any, scheduler: str) -> Iterator[None]:
    """Context manager that warns when a scheduler has lost its last worker: Dask then waits for another one."""
    ended = Event()

    def watch() -> None:
        had_workers = True
        while not ended.wait(LOOK_EVERY_S):
            # of a scheduler that is lost nothing is known; whoever waits for its tasks reports it
            has_workers = bool(client.scheduler_info().get("workers", had_workers))
            if had_workers and not has_workers:
                logger.warning(
                    "--scheduler %s: no worker is left; start `dask worker %s` to go on", scheduler, scheduler
                )
            had_workers = has_workers

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(LOOK_EVERY_S)


def _check(client: Any, shared: Path, scheduler: str | None) -> None:
    """Raises SegslamError unless there are workers, and all have this version and see the folder or file."""
    versions = client.run(version, "segslam", on_error="return")
    if not versions:
        raise SegslamError(f"--scheduler {scheduler}: it has no workers; start `dask worker {scheduler}`")
    for worker, found in versions.items():
        if found != version("segslam"):
            has = f"has segslam {found}" if isinstance(found, str) else "cannot import segslam"
            raise SegslamError(f"worker {worker}: {has}, this is {version('segslam')}; install the same version there")
    for worker, sees in client.run(Path.exists, shared).items():
        if not sees:
            raise SegslamError(f"worker {worker}: does not see {shared}; give a folder that all workers share")


def _on_cluster(
    client: Any, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[int, Outcome]]:
    """Tasks on a Dask cluster, which repeats those of a worker that dies. Raises SegslamError if it is lost."""
    from distributed import KilledWorker, as_completed

    name, submit = function.__name__, client.submit  # the dashboard groups tasks by name
    futures = [submit(attempted, function, *task, key=f"{name}-{uuid4().hex}") for task in tasks]
    numbers = {future.key: number for number, future in enumerate(futures)}
    for future in as_completed(futures):
        try:
            yield numbers[future.key], result_of(future)
        except KilledWorker:
            yield numbers[future.key], Outcome(None, "every worker process that tried it died")


def result_of(future: Any) -> Any:
    """The result of a task. Raises SegslamError if the scheduler is lost, or what the task raised."""
    from distributed import CancelledError

    try:
        return future.result()
    except CancelledError as error:
        raise SegslamError(
            "the scheduler is lost; start it and its workers again, and give the same command again to go on"
        ) from error

"""Dask clusters: worker processes of this machine, or those of a scheduler."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from segslam.core.errors import SegslamError
from segslam.core.extras import how_to_install


@contextmanager
def cluster(*, workers: int, scheduler: str | None) -> Iterator[Any]:
    """A Dask client for the scheduler at an address, or for local worker processes.

    Raises SegslamError if Dask is not installed or the scheduler does not answer.
    """
    try:
        from distributed import Client, LocalCluster  # optional package: extra `cluster`
    except ImportError as error:
        raise SegslamError(f"--workers and --scheduler need Dask: {how_to_install('cluster')}") from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # its info level reports each connection
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=5)
        except (OSError, ValueError) as error:
            raise SegslamError(f"--scheduler {scheduler}: no answer ({error}); start `dask scheduler`") from error
        with client:
            yield client
        return
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as local,
        Client(local) as client,
    ):
        yield client

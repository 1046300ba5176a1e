"""Processes that work on lists of tasks: on this machine, or those of a Dask cluster."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["Workers", "check_jobs", "open_workers"]


class Workers:
    """Processes that call a function on many arguments.

    Args:
        options: arguments of joblib's ``Parallel``.
    """

    def __init__(self, **options: Any) -> None:
        self.options = options

    @property
    def number(self) -> int:
        """How many there are."""
        from joblib import effective_n_jobs

        return int(effective_n_jobs(self.options["n_jobs"]))

    @contextmanager
    def results(self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[Iterator[Any]]:
        """Give the results, in order and one at a time; leaving the context cancels what is not done.

        Args:
            function: of a module, so that a process can find it.
            arguments: of one call each; they are taken as processes become free.

        Yields:
            an iterator over the results; a call's errors are raised there.

        """
        from joblib import Parallel, delayed

        # A new Parallel each time: one whose process was killed gives late results of that call to the next.
        parallel = Parallel(return_as="generator", batch_size=1, max_nbytes=None, **self.options)
        results = parallel(delayed(function)(*some) for some in arguments)
        try:
            yield results
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that tasks were cancelled: it is meant so
                results.close()


def check_jobs(jobs: int) -> None:
    """Refuse a number of processes that is none.

    Raises:
        ValueError: unless ``jobs`` is positive, or -1.

    """
    if jobs < 1 and jobs != -1:
        raise ValueError(f"jobs must be a number of processes, or -1 for as many as there are cores, got {jobs}")


@contextmanager
def open_workers(jobs: int, dask: str | None = None) -> Iterator[Workers]:
    """Give processes here or, with ``dask``, those of a cluster.

    Args:
        jobs: processes on this machine; -1 for as many as it has cores.
        dask: address of a Dask scheduler whose workers are taken instead.

    Raises:
        ValueError: if ``jobs`` is neither positive nor -1, or ``dask`` is no address.
        OSError: if the scheduler or its workers cannot be reached, or a task kills one worker of Dask after another.
        ImportError: if joblib or, for ``dask``, Dask is not installed.

    """
    try:
        import joblib
    except ImportError as error:
        raise ImportError("matching many pairs needs joblib: pip install 'kornia-learnnorm[images]'") from error
    check_jobs(jobs)
    if dask is None:
        yield Workers(n_jobs=jobs, backend="loky", initializer=_end_with, initargs=(os.getpid(),))
        return
    try:
        from distributed import Client, KilledWorker
        from distributed.comm.addressing import get_address_host_port
    except ImportError as error:
        raise ImportError("a Dask scheduler needs Dask: pip install 'kornia-learnnorm[dask]'") from error
    try:
        get_address_host_port(dask)
    except ValueError as error:
        raise ValueError(f"a Dask scheduler has an address as tcp://host:8786, got {dask!r}: {error}") from error
    # The finaliser of a client that could not connect takes a lock that the next one holds while it starts.
    gc.collect()
    client = Client(dask)  # type: ignore[no-untyped-call]
    try:
        with client, joblib.parallel_config("dask", client=client):
            yield Workers(n_jobs=-1)
    except KilledWorker as error:
        raise OSError(f"one worker after another of {dask} was killed: {error}") from error


def _end_with(parent: int) -> None:
    """End this process when ``parent`` was killed: it would wait for ever to write to a pipe that nobody reads.

    An interrupt from the keyboard reaches all processes at once. It is for the parent, which ends the others.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

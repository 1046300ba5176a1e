"""Worker processes on this machine or on a Dask cluster."""

import gc
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from kornia_learnnorm.files import explained
from kornia_learnnorm.optional import import_extra


class Workers:
    """Worker processes that call a function with many arguments; ``options`` are those of joblib's ``Parallel``."""

    def __init__(self, joblib: Any, **options: Any) -> None:
        self.joblib, self.options, self.number = joblib, options, int(joblib.effective_n_jobs(options["n_jobs"]))

    @contextmanager
    def results(self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[Iterator[Any]]:
        """Yield an iterator over the results in order; leaving the context cancels the remaining calls."""
        # A new Parallel for each list: after a killed process, an old one mixes late results into the next list.
        parallel = self.joblib.Parallel(return_as="generator", batch_size=1, max_nbytes=None, **self.options)
        results = parallel(self.joblib.delayed(function)(*some) for some in arguments)
        try:
            yield results
        finally:
            with warnings.catch_warnings(action="ignore", category=UserWarning):  # about cancelled tasks
                results.close()


def check_jobs(jobs: int) -> None:
    """Raise ValueError unless ``jobs`` is a number of processes, or -1."""
    if jobs < 1 and jobs != -1:
        raise ValueError(f"jobs must be a number of processes, or -1 for as many as there are cores, got {jobs}")


@contextmanager
def open_workers(jobs: int, dask: str | None = None) -> Iterator[Workers]:
    """Yield worker processes on this machine, -1 for as many as it has cores, or those of a scheduler of Dask."""
    joblib = import_extra("joblib", "images", "matching many pairs")
    check_jobs(jobs)
    if dask is None:
        yield Workers(joblib, n_jobs=jobs, backend="loky", initializer=_end_with, initargs=(os.getpid(),))
        return
    distributed = import_extra("distributed", "dask", "matching on a Dask cluster")
    with explained(f"a Dask scheduler needs an address as tcp://host:8786, got {dask!r}", ValueError):
        distributed.comm.get_address_host_port(dask)
    # Collect an earlier client that could not connect: its finaliser would wait for a lock of the new one.
    gc.collect()
    client = distributed.Client(dask)
    try:
        with client, joblib.parallel_config("dask", client=client):
            yield Workers(joblib, n_jobs=-1)
    except distributed.KilledWorker as error:
        raise OSError(f"one worker after another of {dask} was killed: {error}") from error


def _end_with(parent: int) -> None:
    """End this process when ``parent`` has been killed; otherwise it would wait forever to write to a pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes, and the parent ends the workers

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

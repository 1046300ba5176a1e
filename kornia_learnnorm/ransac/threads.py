"""One thread for many small operations."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import torch


class _Held:
    """How many callers hold PyTorch to one thread, and the number of threads before."""

    lock, callers, threads = Lock(), 0, 1


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold PyTorch's operations on the CPU to one thread.

    Where matrices are small, waking further threads costs more than they save, and on a busy machine many times more
    than the work itself. PyTorch keeps the number for each thread that uses it, so every caller restores it as it
    leaves. A thread that uses PyTorch for the first time meanwhile keeps to one thread until it sets the number itself.
    """
    with _Held.lock:
        if _Held.callers == 0:
            _Held.threads = torch.get_num_threads()
        _Held.callers += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _Held.lock:
            _Held.callers -= 1
            torch.set_num_threads(_Held.threads)

"""Files that are written whole or not at all, by one process at a time, their short names, and messages of errors."""

import errno
import os
import platform
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # error numbers


@contextmanager
def full_disk_names(path: str | Path) -> Iterator[None]:
    """Let the OSError of a full disk, which names no file, name ``path``."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in FULL_DISK:
            error.filename = str(path)
        raise


@contextmanager
def explained(message: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise errors of some kinds as a ValueError that begins with a message; without kinds any, with its class."""
    caught = kinds or (Exception,)
    try:
        yield
    except caught as error:
        text = str(error) if kinds else f"{type(error).__name__}: {error}"
        raise ValueError(f"{message}: {text}") from error


def check_writable(path: str | Path) -> None:
    """Raise FileNotFoundError or ValueError unless a path is in a folder, and new or a regular file's."""
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist")
    if path.exists() and not path.is_file():
        raise ValueError(f"cannot write {path}: it is not a regular file")


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary file beside ``path``, of its suffix, which takes its place only if the block succeeds."""
    check_writable(path)
    path = Path(path)
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.touch()  # a new file shows the mode that the process' umask allows
        mode = temporary.stat().st_mode
        with full_disk_names(temporary):
            yield temporary
        temporary.chmod(mode)  # some writers create files that only their owner can read
        temporary.replace(path)
    except OSError as error:
        if error.filename != str(temporary):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):  # of a file that is not there, also in a read-only file system
            temporary.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 as :func:`atomic_write` does."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def exclusive(path: str | Path) -> Iterator[None]:
    """Hold the lock of a folder or a file that a run writes; BlockingIOError names another process that holds it.

    It is the file ``.lock`` in the folder or ``.NAME.lock`` beside the file; that of a killed process has no effect.
    """
    from filelock import FileLock, Timeout  # a requirement of torch

    path = Path(path)
    file = path / ".lock" if path.is_dir() else path.with_name(f".{path.name}.lock")
    if not file.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {file.parent} does not exist")
    lock, holder = FileLock(file), "another run"
    with suppress(OSError, ValueError):
        holder = file.read_text(encoding="utf-8") or holder
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        if not file.exists():
            raise PermissionError(f"cannot write {path}: the folder {file.parent} takes no files") from error
        with suppress(OSError):  # filelock before 3.30 empties the file when it asks for the lock
            file.write_text(holder, encoding="utf-8")
        raise BlockingIOError(f"{path} is in use by {holder}: wait for it to end, or write elsewhere") from error
    except OSError as error:
        raise type(error)(f"cannot write {path}: {error.strerror or error}") from error
    try:
        with suppress(OSError):  # on Windows nobody can write or read a locked file
            file.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
        yield
    finally:
        with suppress(OSError):  # nor remove it
            file.unlink()
        lock.release()


def short_name(path: str | Path) -> str:
    """Return the name of a store or of weights for tables; of ``weights.safetensors``, the name of its folder."""
    path = Path(path)
    name = path.resolve().parent.name if path.name == "weights.safetensors" else path.name
    return name.removesuffix(".safetensors").replace(".h5", "")


def changed_options(had: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the options that are not what they were before, with both values; empty for equal ones."""
    return "; ".join(f"{k} {had.get(k)!r}, now {now.get(k)!r}" for k in {**had, **now} if had.get(k) != now.get(k))

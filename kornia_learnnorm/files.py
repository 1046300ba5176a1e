"""Files that are written whole or not at all, and their short names."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["atomic_write", "short_name", "write_text"]


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary file beside ``path`` to write; it takes the place of ``path`` only if the block succeeds.

    Args:
        path: the file to write or to replace.

    Yields:
        the path of the temporary file, with the suffix of ``path``.

    Raises:
        FileNotFoundError: if the folder of ``path`` does not exist.
        PermissionError: if the folder is not writable.
        ValueError: if ``path`` is a folder or a device.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_write(Path(folder) / "note.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     (Path(folder) / "note.txt").read_text()
        'whole'

    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist")
    if path.exists() and not path.is_file():
        raise ValueError(f"cannot write {path}: it is not a regular file")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"cannot write {path}: the folder {path.parent} is not writable")
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.touch()  # a new file shows the mode that the process' umask allows
        mode = temporary.stat().st_mode
        yield temporary
        temporary.chmod(mode)  # some writers create files that only their owner can read
        temporary.replace(path)
    except OSError as error:
        if error.filename != str(temporary):
            raise
        raise type(error)(error.errno, f"cannot write {path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 as :func:`atomic_write` does."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def short_name(path: str | Path) -> str:
    """Return a file's name for tables, without its suffix; for ``weights.safetensors``, the name of its folder.

    Args:
        path: a store, ``FILE.h5@FIRST:STOP`` for some of its pairs, or a file of weights.

    Example:
        >>> short_name("data/tum.h5@0:9"), short_name("runs/mine/weights.safetensors")
        ('tum@0:9', 'mine')

    """
    path = Path(path)
    name = path.resolve().parent.name if path.name == "weights.safetensors" else path.name
    return name.removesuffix(".safetensors").replace(".h5", "")

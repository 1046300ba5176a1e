"""The arrays of a run on disk: NumPy archives that are checked when they are read."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.files import atomic_write

__all__ = ["Arrays", "file_name", "read_arrays", "write_arrays"]

Arrays = dict[str, NDArray[Any]]


def file_name(name: str) -> str:
    """Return the name of the file of a method, an estimator or a solver, without suffix."""
    return "".join(letter if letter.isalnum() or letter in "+-._" else "_" for letter in name)


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a compressed ``.npz`` file, whole or not at all; make its folder if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def read_arrays(path: Path, keys: Sequence[str] = (), rows: int | None = None) -> Arrays:
    """Return the arrays in a file of a run; raise ValueError if it lacks ``keys``, or these have not ``rows`` rows."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: call the command that began the run again, it completes it")
    try:
        with path.open("rb") as file, np.load(file) as data:
            found = dict(data)
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} is damaged, remove it: {error}") from error
    if lacks := [key for key in keys if key not in found]:
        raise ValueError(f"{path} is damaged, remove it: expected arrays {', '.join(lacks)}, got {', '.join(found)}")
    for key in keys:
        if rows is not None and found[key].shape[:1] != (rows,):
            got = f"{key} has shape {found[key].shape}"
            raise ValueError(f"{path} is of other samples, remove it: expected {rows} rows, {got}")
    return found

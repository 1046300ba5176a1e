r"""The file of correspondences: one HDF5 file, ragged arrays, one run of rows per image pair.

Pair ``i`` owns the rows ``offsets[i]:offsets[i + 1]`` of ``points1``, ``points2`` and ``ratio``. Where a command or a
configuration takes a store, ``file.h5@3:10`` means its pairs 3 to 9.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.files import atomic_write

if TYPE_CHECKING:
    import h5py

__all__ = ["CorrespondenceStore", "StoreReader", "check_declared", "join_stores", "read_store", "write_store"]

FORMAT, VERSION = "correspondences", 1
# Compression, and rows that were never written, let a small file declare large arrays. One is read if it takes at most
# this many times its size in memory, and this many bytes beyond.
UNFOLD, BEYOND = 20, 2**28
# name: shape behind the first axis, dtype, "M" correspondences or "P" pairs
_LAYOUT: dict[str, tuple[tuple[int, ...], str, str]] = {
    "points1": ((2,), "float32", "M"),
    "points2": ((2,), "float32", "M"),
    "ratio": ((), "float32", "M"),
    "image_size": ((2, 2), "int32", "P"),
    "F": ((3, 3), "float64", "P"),
    "K": ((2, 3, 3), "float64", "P"),
    "R": ((3, 3), "float64", "P"),
    "t": ((3,), "float64", "P"),
}


@dataclass(frozen=True)
class CorrespondenceStore:
    """Correspondences of many image pairs, in memory.

    Attributes:
        points1: pixels (x, y) in the first images, (M, 2) float32.
        points2: pixels (x, y) in the second images, (M, 2) float32.
        ratio: nearest over second-nearest descriptor distance (Lowe's ratio), (M,) float32.
        offsets: pair ``i`` owns rows ``offsets[i]:offsets[i + 1]``, (P + 1,) int64.
        image_size: (width, height) of both images, (P, 2, 2) int32.
        names: file names of both images, P pairs.
        F: ground truth, x2^T F x1 = 0, unit Frobenius norm, NaN where unknown, (P, 3, 3) float64.
        K: cameras, (P, 2, 3, 3) float64.
        R: rotations of x2 = R x1 + t, (P, 3, 3) float64.
        t: translations of x2 = R x1 + t in metres, (P, 3) float64.
        dataset: what the images are.
        pairs: how the pairs were chosen.
        detector: how the correspondences were found.
        provenance: what made the store: options, versions, pairs left out; of JSON's types.
    """

    points1: NDArray[np.float32]
    points2: NDArray[np.float32]
    ratio: NDArray[np.float32]
    offsets: NDArray[np.int64]
    image_size: NDArray[np.int32]
    names: list[tuple[str, str]]
    F: NDArray[np.float64]
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    dataset: str
    pairs: str
    detector: str
    provenance: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of image pairs."""
        return len(self.offsets) - 1

    def select(self, first: int, stop: int) -> CorrespondenceStore:
        """Return the pairs from ``first`` up to, not with, ``stop``.

        Args:
            first: index of the first pair.
            stop: index after the last pair.

        Raises:
            ValueError: if there are no such pairs.

        """
        if not 0 <= first < stop <= len(self):
            raise ValueError(f"pairs {first}:{stop} were asked for, the store has 0:{len(self)}")
        rows = slice(int(self.offsets[first]), int(self.offsets[stop]))
        cut: dict[str, Any] = {
            name: getattr(self, name)[rows if axis == "M" else slice(first, stop)]
            for name, (_, _, axis) in _LAYOUT.items()
        }
        offsets = self.offsets[first : stop + 1] - self.offsets[first]
        return replace(self, offsets=offsets, names=self.names[first:stop], **cut)


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("reading stores needs h5py: pip install 'kornia-learnnorm[images]'") from error
    return h5py


def read_store(path: str | Path) -> CorrespondenceStore:
    """Read a store of correspondences, or some of its pairs, and check it.

    Args:
        path: an HDF5 file in the format that this module describes; ``file.h5@3:10`` for its pairs 3 to 9.

    Returns:
        the store, in memory.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not a store of this version, is truncated, its arrays do not fit together, would take
            more than 20 times its size and 256 MiB in memory, or it lacks the pairs.

    """
    reader = StoreReader(path)
    return reader.read(range(len(reader)))


class StoreReader:
    """A store that stays on disk: some of its pairs at a time.

    The file is open only while it is read, so that a reader can go to other processes.

    Args:
        path: as for :func:`read_store`; of a part, the first pair is 0.

    Attributes:
        path: the file.
        offsets: pair ``i`` owns ``offsets[i + 1] - offsets[i]`` correspondences, (P + 1,) int64.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: as :func:`read_store`, but for what is in the rows, which :meth:`read` checks.
    """

    def __init__(self, path: str | Path) -> None:
        part = re.fullmatch(r"(.+)@(\d+):(\d+)", str(path))
        self.path = Path(part[1] if part else path)
        if not self.path.is_file():
            named = part or "@" not in self.path.name
            hint = "" if named else "; some pairs of a store are FILE.h5@FIRST:STOP, as in s.h5@3:10"
            raise FileNotFoundError(f"no store at {self.path}{hint}")
        with self._open() as file:
            offsets = _check(self.path, file)
        first, stop = (int(part[2]), int(part[3])) if part else (0, len(offsets) - 1)
        if not 0 <= first < stop < len(offsets):
            raise ValueError(f"{self.path}: pairs {first}:{stop} were asked for, the store has 0:{len(offsets) - 1}")
        self._first = first
        self.offsets = offsets[first : stop + 1]

    def __len__(self) -> int:
        """Return the number of image pairs."""
        return len(self.offsets) - 1

    def read(self, pairs: Sequence[int]) -> CorrespondenceStore:
        """Read some pairs, in the order given.

        Args:
            pairs: their indices; a range is read fastest, then a rising order.

        Raises:
            IndexError: if there is no such pair.
            ValueError: if the file changed or points or ratios are not finite.

        """
        if len(pairs) and not 0 <= min(pairs) <= max(pairs) < len(self):
            raise IndexError(f"pairs {min(pairs)} to {max(pairs)} were asked for, the store has 0 to {len(self) - 1}")
        runs = _runs(pairs)
        rows = {
            "M": [slice(int(self.offsets[a]), int(self.offsets[b])) for a, b in runs],
            "P": [slice(a + self._first, b + self._first) for a, b in runs],
        }
        with self._open() as file:
            arrays: dict[str, Any] = {
                name: np.concatenate([np.zeros((0, *tail), dtype), *(file[name][part] for part in rows[axis])])
                for name, (tail, dtype, axis) in _LAYOUT.items()
            }
            names = self._names(file["names"].asstr(), rows["P"])
            about: dict[str, Any] = {key: str(file.attrs.get(key, "")) for key in ("dataset", "pairs", "detector")}
            provenance = json.loads(file.attrs.get("provenance", "{}"))
        for name in ("points1", "points2", "ratio"):
            if not np.isfinite(arrays[name]).all():
                raise ValueError(f"{self.path}: {name} holds NaN or infinite numbers")
        counts = np.diff(self.offsets)[list(pairs)]
        offsets = np.concatenate([[0], counts.cumsum()]).astype(np.int64)
        return CorrespondenceStore(offsets=offsets, names=names, **arrays, **about, provenance=provenance)

    def _names(self, dataset: Any, parts: list[slice]) -> list[tuple[str, str]]:
        """Read names a few at a time: all of them can be one long text that the file holds once."""
        names: list[tuple[str, str]] = []
        most, size = _most_bytes(self.path), 0
        for part in parts:
            for first in range(part.start, part.stop, 16):
                found = [(str(a), str(b)) for a, b in dataset[first : min(first + 16, part.stop)]]
                size += sum(len(a) + len(b) for a, b in found)
                if size > most:
                    raise ValueError(f"{self.path}: its names take more than {_limit(most)}")
                names += found
        return names

    def passing(self, max_ratio: float | None) -> NDArray[np.int64]:
        """Count the correspondences of each pair with a ratio below ``max_ratio``, or all; (P,)."""
        if max_ratio is None:
            return np.diff(self.offsets)
        counts = np.zeros(len(self), np.int64)
        with self._open() as file:
            for first in range(0, len(self), 4096):  # a part at a time: the ratios of all need not fit in memory
                offsets = self.offsets[first : first + 4097]
                passes = file["ratio"][int(offsets[0]) : int(offsets[-1])] < max_ratio
                total = np.concatenate([[0], passes.cumsum()])
                counts[first : first + 4096] = np.diff(total[offsets - offsets[0]])
        return counts

    @contextmanager
    def _open(self) -> Iterator[h5py.File]:
        h5py = _h5py()
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        except (OSError, RuntimeError) as error:
            text = f"{self.path} is not a readable HDF5 file (truncated or of another kind): {error}"
            raise ValueError(text) from error


def _runs(pairs: Sequence[int]) -> list[tuple[int, int]]:
    """Split indices into runs of successive ones, (first, stop)."""
    if not len(pairs):
        return []
    cuts = [0, *(np.flatnonzero(np.diff(pairs) != 1) + 1).tolist(), len(pairs)]
    return [(int(pairs[a]), int(pairs[b - 1]) + 1) for a, b in pairwise(cuts)]


def _check(path: Path, file: h5py.File) -> NDArray[np.int64]:
    """Return the offsets of a store whose arrays fit together."""
    if file.attrs.get("format") != FORMAT or file.attrs.get("version") != VERSION:
        got = f"format={file.attrs.get('format')!r}, version={file.attrs.get('version')}"
        raise ValueError(f"{path} is not a store: expected format={FORMAT!r}, version={VERSION}, got {got}")
    names = (*_LAYOUT, "offsets", "names")
    missing = [name for name in names if not _holds(file, name)]
    if missing:
        raise ValueError(f"{path} lacks the datasets {', '.join(missing)}")
    check_declared(path, [file[name] for name in names])
    offsets = np.asarray(file["offsets"][:], np.int64)
    if offsets.ndim != 1 or len(offsets) < 2 or offsets[0] != 0 or (np.diff(offsets) < 0).any():
        raise ValueError(f"{path}: offsets must rise from 0 over at least one pair, got {offsets[:4]}...")
    rows = {"M": int(offsets[-1]), "P": len(offsets) - 1}
    for name, (tail, dtype, axis) in {**_LAYOUT, "names": ((2,), "O", "P")}.items():
        if file[name].shape != (rows[axis], *tail):
            raise ValueError(f"{path}: {name} must have shape {(rows[axis], *tail)}, got {file[name].shape}")
        if file[name].dtype.kind != np.dtype(dtype).kind:
            raise ValueError(f"{path}: {name} must be {dtype}, got {file[name].dtype}")
    if _h5py().check_string_dtype(file["names"].dtype) is None:
        raise ValueError(f"{path}: names must be texts, got {file['names'].dtype.metadata}")
    return offsets


def _holds(file: h5py.File, name: str) -> bool:
    """Tell whether the file itself holds a dataset; what leads to another file could lead to any on this disk."""
    if not isinstance(file.get(name, getlink=True), _h5py().HardLink) or not hasattr(file[name], "shape"):
        return False
    return not (file[name].external or file[name].is_virtual)


def check_declared(path: Path, datasets: Sequence[h5py.Dataset]) -> None:
    """Raise a clear error for datasets of a file that declare more than the file could reasonably hold.

    Raises:
        ValueError: if their size in memory is over the limit, or their data are in other files.

    """
    if any(data.external or data.is_virtual or Path(data.file.filename) != path for data in datasets):
        raise ValueError(f"{path} refers to data in other files, which are not read")
    size, most = sum(math.prod(data.shape or ()) * data.dtype.itemsize for data in datasets), _most_bytes(path)
    if size > most:
        raise ValueError(f"{path} declares arrays of {size} bytes, more than {_limit(most)}")


def _most_bytes(path: Path) -> int:
    return UNFOLD * path.stat().st_size + BEYOND


def _limit(most: int) -> str:
    return f"the limit of {most} bytes, {UNFOLD} times the size of the file and {BEYOND}"


def write_store(path: str | Path, store: CorrespondenceStore) -> None:
    """Write a store to a file beside the target, then rename it: the target is whole or untouched.

    Args:
        path: the HDF5 file to write; an existing one is replaced.
        store: the correspondences.

    Raises:
        OSError: if the folder does not exist or cannot be written, or the disk is full.

    """
    join_stores(path, [store], store.provenance)


def join_stores(path: str | Path, stores: Iterable[CorrespondenceStore], provenance: dict[str, Any]) -> None:
    """Write one store of all pairs of ``stores``, which are taken one after the other and need not fit in memory.

    Args:
        path: the HDF5 file to write, beside it first, then renamed; an existing one is replaced.
        stores: at least one; what they are of is taken from the first.
        provenance: that of the whole.

    Raises:
        ValueError: if there is no store.
        OSError: if the folder does not exist or cannot be written, or the disk is full.

    """
    h5py = _h5py()
    with atomic_write(path) as beside:
        try:
            with h5py.File(beside, "w") as file:
                _append_all(h5py, file, stores)
                if "offsets" not in file:
                    raise ValueError(f"no pairs to write to {path}")
                file.attrs.update({"format": FORMAT, "version": VERSION, "provenance": json.dumps(provenance)})
        except (OSError, RuntimeError) as error:  # RuntimeError: a disk that fills while a file is closed
            number = getattr(error, "errno", None)
            raise OSError(f"cannot write {path}: {os.strerror(number) if number else error}") from error


def _append_all(h5py: Any, file: h5py.File, stores: Iterable[CorrespondenceStore]) -> None:
    for store in stores:
        if "offsets" not in file:
            file.attrs.update({key: getattr(store, key) for key in ("dataset", "pairs", "detector")})
            file.create_dataset("offsets", (1,), np.int64, maxshape=(None,), chunks=(128,))
            file.create_dataset("names", (0, 2), h5py.string_dtype(), maxshape=(None, 2), chunks=(64, 2))
            for name, (tail, dtype, axis) in _LAYOUT.items():
                rows = 2048 if axis == "M" else 16  # small, since a part of a store is one too
                file.create_dataset(name, (0, *tail), dtype, maxshape=(None, *tail), chunks=(rows, *tail))
        _append(file["offsets"], store.offsets[1:] + file["offsets"][-1])
        _append(file["names"], np.array(store.names, dtype=h5py.string_dtype()))
        for name in _LAYOUT:
            _append(file[name], getattr(store, name))


def _append(dataset: h5py.Dataset, rows: NDArray[Any]) -> None:
    if len(rows):
        dataset.resize(len(dataset) + len(rows), axis=0)
        dataset[-len(rows) :] = rows

"""Stores: correspondences of many image pairs in one HDF5 file of ragged arrays; ``file.h5@3:10`` is its pairs 3-9."""

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.files import explained
from kornia_learnnorm.optional import import_extra

Array = NDArray[np.float32]
MaxRatio = float | None  # limit of Lowe's ratio, exclusive; None for no limit
FORMAT = "correspondences"  # attribute of the file
VERSION = 1  # attribute of the file
READING = "reading HDF5 files"  # what needs h5py, in messages
# name: shape behind the first axis, dtype, and the first axis: "M" correspondences or "P" pairs
LAYOUT: dict[str, tuple[tuple[int, ...], str, str]] = {
    "points1": ((2,), "float32", "M"),
    "points2": ((2,), "float32", "M"),
    "ratio": ((), "float32", "M"),
    "score": ((), "float32", "M"),
    "image_size": ((2, 2), "int32", "P"),
    "F": ((3, 3), "float64", "P"),
    "K": ((2, 3, 3), "float64", "P"),
    "R": ((3, 3), "float64", "P"),
    "t": ((3,), "float64", "P"),
}


@dataclass(frozen=True)
class CorrespondenceStore:
    """Correspondences of many image pairs, in memory."""

    points1: Array  # pixels (x, y) in the first images, (M, 2)
    points2: Array  # pixels (x, y) in the second images, (M, 2)
    ratio: Array  # nearest over second-nearest descriptor distance (Lowe's ratio), NaN without one, (M,)
    offsets: NDArray[np.int64]  # pair i owns rows offsets[i]:offsets[i + 1], (P + 1,)
    image_size: NDArray[np.int32]  # (width, height) of both images, (P, 2, 2)
    names: list[tuple[str, str]]  # file names of both images, P pairs
    F: NDArray[np.float64]  # ground truth, x2^T F x1 = 0, unit Frobenius norm, NaN where unknown, (P, 3, 3)
    K: NDArray[np.float64]  # cameras, (P, 2, 3, 3)
    R: NDArray[np.float64]  # rotations of x2 = R x1 + t, (P, 3, 3)
    t: NDArray[np.float64]  # translations of x2 = R x1 + t in metres, (P, 3)
    dataset: str = ""  # name of the data set and its sequences
    pairs: str = ""  # how the pairs were chosen
    detector: str = ""  # detector and matcher
    provenance: dict[str, Any] = field(default_factory=dict)  # options, versions, skipped pairs; values of JSON's types
    # from 0 to 1, (M,): 1 - ratio, and the matcher's score, to be given, of matches without a ratio
    score: Array = field(default_factory=lambda: np.full(1, np.nan, np.float32))

    def __post_init__(self) -> None:
        score = np.where(np.isnan(self.ratio), self.score, (1 - self.ratio).clip(0, 1))
        object.__setattr__(self, "score", score)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __repr__(self) -> str:
        return f"<store of {len(self)} image pairs, {len(self.points1)} correspondences: {self.dataset!r}>"

    def rows(self, pair: int, max_ratio: MaxRatio = None) -> NDArray[np.int64]:
        """Return the rows (N,) of the correspondences of :meth:`matches`, in increasing order."""
        rows = np.arange(self.offsets[pair], self.offsets[pair + 1])
        return rows[passes_ratio_test(self.ratio[rows], max_ratio)]

    def matches(self, pair: int, max_ratio: MaxRatio = None) -> tuple[Array, Array, Array]:
        """Return points1 (N, 2), points2 (N, 2) and ratio (N,) of a pair: those that pass the ratio test, or all."""
        rows = self.rows(pair, max_ratio)
        return self.points1[rows], self.points2[rows], self.ratio[rows]


def passes_ratio_test(ratio: Array, max_ratio: MaxRatio) -> NDArray[np.bool_]:
    """Return which matches (N,) have a ratio below a limit, None for no limit, or no ratio, NaN."""
    return np.asarray(~(ratio >= (np.inf if max_ratio is None else max_ratio)))


def read_store(path: str | Path) -> CorrespondenceStore:
    """Return a store of correspondences, after checking the file; ``file.h5@3:10`` for its pairs 3 to 9.

    FileNotFoundError if there is no such file; ValueError if it is not a store of this version or is truncated, its
    arrays do not fit together or are not finite, or it lacks the pairs.
    """
    reader = StoreReader(path)
    return reader.read(range(len(reader)))


class StoreReader:
    """A store on disk that is read a few pairs at a time, with the paths and the errors of :func:`read_store`.

    The file is open only during a call, so that a reader can be pickled. ``offsets``, (P + 1,) int64, are those of the
    pairs of ``path``. The values of points and scores are checked by :meth:`read`.
    """

    def __init__(self, path: str | Path) -> None:
        part = re.fullmatch(r"(.+)@(\d+):(\d+)", str(path))
        self.path = Path(part[1] if part else path)
        if not self.path.is_file():
            named = part or "@" not in self.path.name
            hint = "" if named else "; write some pairs of a store as FILE.h5@FIRST:STOP, for example s.h5@3:10"
            if self.path.is_dir():
                hint = "; it is a folder, and learnnorm match folder makes a store of a folder of images"
            elif Path(f"{self.path}.parts").is_dir():
                hint = "; its matching was interrupted: run the same learnnorm match again, which continues"
            raise FileNotFoundError(f"no store at {self.path}{hint}")
        with open_hdf5(self.path) as file:
            offsets = _read_offsets(self.path, file)
        self._first, stop = (int(part[2]), int(part[3])) if part else (0, len(offsets) - 1)
        if not self._first < stop < len(offsets):
            asked = f"pairs {self._first}:{stop} were asked for"
            raise ValueError(f"{self.path}: {asked}, the store has 0:{len(offsets) - 1}")
        self.offsets = offsets[self._first : stop + 1]
        self._written = self.path.stat().st_mtime_ns

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def read(self, pairs: Sequence[int]) -> CorrespondenceStore:
        """Return a store of some pairs, in the order given; a range is read fastest, then increasing indices.

        An index that is negative or too large is an IndexError, a number that is not finite a ValueError.
        """
        if len(pairs) and not 0 <= min(pairs) <= max(pairs) < len(self):
            raise IndexError(f"pairs {min(pairs)} to {max(pairs)} were asked for, the store has 0 to {len(self) - 1}")
        cuts = [0, *(np.flatnonzero(np.diff(pairs) != 1) + 1).tolist(), len(pairs)]
        runs = [(int(pairs[a]), int(pairs[b - 1]) + 1) for a, b in pairwise(cuts) if a < b]
        rows = {
            "M": [slice(int(self.offsets[a]), int(self.offsets[b])) for a, b in runs],
            "P": [slice(a + self._first, b + self._first) for a, b in runs],
        }
        if self.path.stat().st_mtime_ns != self._written:
            raise ValueError(f"{self.path} has changed since it was opened")
        with open_hdf5(self.path) as file:
            arrays: dict[str, Any] = {
                name: np.concatenate([np.zeros((0, *tail), dtype), *(file[name][part] for part in rows[axis])])
                for name, (tail, dtype, axis) in _layout(file).items()
            }
            names = [(str(a), str(b)) for part in rows["P"] for a, b in file["names"].asstr()[part]]
            about: dict[str, Any] = {key: str(file.attrs.get(key, "")) for key in ("dataset", "pairs", "detector")}
            provenance = json.loads(file.attrs.get("provenance", "{}"))
        for name in ("points1", "points2", *(["ratio"] if "score" not in arrays else [])):
            if not np.isfinite(arrays[name]).all():
                raise ValueError(f"{self.path}: {name} holds NaN or infinite numbers")
        if "score" in arrays and not ((arrays["score"] >= 0) & (arrays["score"] <= 1)).all():
            raise ValueError(f"{self.path}: score must be from 0 to 1, got other numbers")
        offsets = np.concatenate([[0], np.diff(self.offsets)[list(pairs)].cumsum()]).astype(np.int64)
        return CorrespondenceStore(offsets=offsets, names=names, **arrays, **about, provenance=provenance)

    def passing(self, max_ratio: MaxRatio) -> NDArray[np.int64]:
        """Return how many correspondences of each pair have a ratio below ``max_ratio``, all if it is None, (P,)."""
        if max_ratio is None:
            return np.diff(self.offsets)
        first, stop = int(self.offsets[0]), int(self.offsets[-1])
        with open_hdf5(self.path) as file:
            passes = passes_ratio_test(file["ratio"][first:stop], max_ratio)
        total = np.concatenate([[0], passes.cumsum()])
        return np.asarray(np.diff(total[self.offsets - first]))


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file to read; its errors, also those of the block, become a ValueError that names the file."""
    h5py = import_extra("h5py", "images", READING)
    message = f"{path} is not a readable HDF5 file (truncated or of another kind)"
    with explained(message, OSError, RuntimeError, KeyError), h5py.File(path, "r") as file:
        yield file


def own_dataset(group: Any, name: str) -> Any:
    """Return a dataset that the file itself holds; None for none, a group, a link, or data in other files."""
    h5py = import_extra("h5py", "images", READING)
    if group.get(name, getclass=True, getlink=True) is not h5py.HardLink:
        return None
    data = group[name]
    return None if not hasattr(data, "shape") or data.external or data.is_virtual else data


def _layout(file: Any) -> dict[str, tuple[tuple[int, ...], str, str]]:
    """Return the layout of a file; one of an earlier version has no scores, which then are 1 minus the ratio."""
    return {name: entry for name, entry in LAYOUT.items() if name != "score" or name in file}


def _read_offsets(path: Path, file: Any) -> NDArray[np.int64]:
    """Return the offsets of a store, after checking its version and the shapes and types of its arrays."""
    if file.attrs.get("format") != FORMAT or file.attrs.get("version") != VERSION:
        got = f"format={file.attrs.get('format')!r}, version={file.attrs.get('version')}"
        raise ValueError(f"{path} is not a store: expected format={FORMAT!r}, version={VERSION}, got {got}")
    if missing := [name for name in (*_layout(file), "offsets", "names") if own_dataset(file, name) is None]:
        raise ValueError(f"{path} lacks the datasets {', '.join(missing)} (links to other files are not followed)")
    offsets = np.asarray(file["offsets"][:], np.int64)
    if offsets.ndim != 1 or len(offsets) < 2 or offsets[0] != 0 or (np.diff(offsets) < 0).any():
        expected = "start at 0 and not decrease, with one pair or more"
        raise ValueError(f"{path}: offsets must {expected}, got {offsets[:4]}...")
    rows = {"M": int(offsets[-1]), "P": len(offsets) - 1}
    for name, (tail, dtype, axis) in {**_layout(file), "names": ((2,), "O", "P")}.items():
        if file[name].shape != (rows[axis], *tail):
            raise ValueError(f"{path}: {name} must have shape {(rows[axis], *tail)}, got {file[name].shape}")
        if file[name].dtype.kind != np.dtype(dtype).kind:
            raise ValueError(f"{path}: {name} must be {dtype}, got {file[name].dtype}")
    if import_extra("h5py", "images", READING).check_string_dtype(file["names"].dtype) is None:
        raise ValueError(f"{path}: names must be strings, got {file['names'].dtype.metadata}")
    return offsets

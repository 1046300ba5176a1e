"""Reading a run of predictions, as ``learnnorm evaluate --out`` leaves it."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.evaluation.runs.manifest import read_about

__all__ = [
    "Cell",
    "Run",
    "check_limit",
    "file_name",
    "is_swept",
    "method_files",
    "read_arrays",
    "read_run",
    "within_limit",
]

MAX_RESIDUAL = 60.0  # pixels: samples whose un-normalised residual is not below are left out, as in Fan et al.
# What the files of a run hold; read by name, so that a damaged one is known before it is used.
PAIRS = ("rotation", "forward", "parallax", "inliers", "names")
SAMPLES = ("pair", "plain_residual")
PREDICTIONS = (
    *("F_mat", "own", "heldout", "truth", "inliers", "f1", "rotation_error", "translation_error"),
    *("condition_number", "rho", "distance1", "distance2"),
)
EXAMPLE = ("store", "pair", "names", "points1", "points2", "truth", "F", "size")
SWEEP = ("size", "own", "truth")


@dataclass(frozen=True)
class Cell:
    """The predictions of all methods on the samples of one store and protocol.

    Attributes:
        store: name of the store.
        protocol: ``filtered`` or ``unfiltered``.
        pair: image pair of each sample, (S,) int64.
        drawn: how many samples there were before the filter on the un-normalised residual.
        predictions: arrays (S, ...) by method and quantity, float64.
    """

    store: str
    protocol: str
    pair: Tensor
    drawn: int
    predictions: dict[str, dict[str, Tensor]]

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


@dataclass(frozen=True)
class Run:
    """Everything that a report is made of.

    Attributes:
        about: what the run is of, from ``run.json``.
        cells: stores and protocols.
        pairs: figures of each store's pairs, (P,) each.
        sizes: errors by the number of correspondences, by method.
        example: the image pair that these errors are of, from
            :func:`~kornia_learnnorm.evaluation.runs.example.random_pair`;
            nothing where there is none yet.
        missing: what is not there yet.
    """

    about: dict[str, Any]
    cells: list[Cell]
    pairs: dict[str, dict[str, NDArray[Any]]]
    sizes: dict[str, dict[str, NDArray[Any]]]
    example: dict[str, NDArray[Any]]
    missing: list[str] = field(default_factory=list)


def read_run(folder: str | Path) -> Run:
    """Read what is there of a run.

    Args:
        folder: what ``learnnorm evaluate --out`` wrote.

    Raises:
        FileNotFoundError: if it is no run, or a file is not there without which others say nothing.
        ValueError: if another version of the package made it, or a file is damaged.

    """
    folder = Path(folder)
    about, missing = read_about(folder), []
    cells, pairs, by_size, example = [], {}, {}, {}
    for store in about["stores"]:
        for protocol in ("filtered", "unfiltered"):
            if (folder / store / protocol / "samples.npz").is_file():
                cells.append(_read_cell(folder / store / protocol, store, protocol, about["methods"]))
                pairs[store] = _read_pairs(folder / store / "pairs.npz", cells[-1].pair)
                absent = [name for name in about["methods"] if name not in cells[-1].predictions]
            else:
                absent = ["all methods"]
            missing += [f"{name} on {store}, {protocol}" for name in absent]
    if (folder / "example.npz").is_file():
        example = read_arrays(folder / "example.npz", EXAMPLE)
        for name in filter(is_swept, about["methods"]):
            path = folder / "sizes" / f"{file_name(name)}.npz"
            if path.is_file():
                by_size[name] = read_arrays(path, SWEEP)
            else:
                missing.append(f"{name} by the number of correspondences")
    else:
        missing.append("the example of a pair")
    return Run(about, cells, pairs, by_size, example, missing)


def _read_cell(folder: Path, store: str, protocol: str, methods: list[str]) -> Cell:
    kept = within_limit(folder)
    pair = torch.from_numpy(read_arrays(folder / "samples.npz", SAMPLES, len(kept))["pair"])[kept]
    paths = {name: folder / f"{file_name(name)}.npz" for name in methods}
    predictions = {
        name: {key: torch.from_numpy(value) for key, value in read_arrays(path, PREDICTIONS, len(pair)).items()}
        for name, path in paths.items()
        if path.is_file()
    }
    return Cell(store, protocol, pair, len(kept), predictions)


def _read_pairs(path: Path, pair: Tensor) -> dict[str, NDArray[Any]]:
    pairs = read_arrays(path, PAIRS)
    number = min(len(pairs[key]) for key in PAIRS)
    if not 0 <= int(pair.min()) <= int(pair.max()) < number:
        raise ValueError(f"{path} has {number} image pairs, there are samples of {int(pair.max()) + 1}: remove it")
    return pairs


def within_limit(folder: Path) -> Tensor:
    """Return which of a store's and protocol's samples, (S,), the un-normalised residual keeps.

    Raises:
        FileNotFoundError: if there are no samples.
        ValueError: if none is kept or the file is damaged.

    """
    return check_limit(read_arrays(folder / "samples.npz", SAMPLES)["plain_residual"], folder)


def check_limit(residual: NDArray[Any], folder: Path) -> Tensor:
    """Return which un-normalised residuals, (S,), are within the limit.

    Raises:
        ValueError: if none is.

    """
    kept = torch.from_numpy(residual < MAX_RESIDUAL)
    if not bool(kept.any()):
        raise ValueError(f"{folder}: none of {len(kept)} samples has an un-normalised residual below {MAX_RESIDUAL} px")
    return kept


def read_arrays(path: Path, keys: Sequence[str] = (), rows: int | None = None) -> dict[str, NDArray[Any]]:
    """Return what a file of a run holds.

    Args:
        path: the file.
        keys: arrays that must be there.
        rows: first dimension that these must have.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is damaged, or its arrays are others.

    """
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is not there: the run is not complete, the command that made it goes on with it"
        )
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


def file_name(method: str) -> str:
    """Return the name of a method's file, without suffix."""
    return "".join(letter if letter.isalnum() or letter in "+-._" else "_" for letter in method)


def is_swept(method: str) -> bool:
    """Return whether a run keeps a method's errors by the number of correspondences: searching takes too long."""
    return not method.startswith("searched")


def method_files(folder: Path, stores: Iterable[str], method: str) -> list[Path]:
    """Return where a run keeps what a method predicts."""
    name = f"{file_name(method)}.npz"
    cells = [folder / store / protocol / name for store in stores for protocol in ("filtered", "unfiltered")]
    return [*cells, folder / "sizes" / name]

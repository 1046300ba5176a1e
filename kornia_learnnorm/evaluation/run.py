"""Reading a run of predictions, as ``learnnorm evaluate --out`` leaves it."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["Cell", "Run", "file_name", "read_arrays", "read_run", "within_limit"]

FORMAT = 2  # of what a run keeps; others are refused
MAX_RESIDUAL = 60.0  # pixels: samples whose un-normalised residual is not below are left out, as in Fan et al.


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
        example: the image pair that these errors are of, from :func:`~kornia_learnnorm.evaluation.example.random_pair`.
    """

    about: dict[str, Any]
    cells: list[Cell]
    pairs: dict[str, dict[str, NDArray[Any]]]
    sizes: dict[str, dict[str, NDArray[Any]]]
    example: dict[str, NDArray[Any]]


def read_run(folder: str | Path) -> Run:
    """Read a run.

    Args:
        folder: what ``learnnorm evaluate --out`` wrote.

    Raises:
        FileNotFoundError: if it is no run, or not a complete one.
        ValueError: if another version of the package made it, or a file is damaged.

    """
    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise FileNotFoundError(f"no run at {folder}: learnnorm evaluate STORE --out {folder} makes one")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    if about.get("format") != FORMAT:
        raise ValueError(
            f"{folder} is a run of format {about.get('format')}, expected {FORMAT}: another version of the package made"
            " it, learnnorm evaluate STORE --out ELSEWHERE makes it anew"
        )
    cells = [
        _read_cell(folder / store / protocol, store, protocol, about["methods"])
        for store in about["stores"]
        for protocol in ("filtered", "unfiltered")
    ]
    pairs = {store: read_arrays(folder / store / "pairs.npz") for store in about["stores"]}
    sizes = {name: folder / "sizes" / f"{file_name(name)}.npz" for name in about["methods"]}
    by_size = {name: read_arrays(path) for name, path in sizes.items() if path.is_file()}
    return Run(about, cells, pairs, by_size, read_arrays(folder / "example.npz"))


def _read_cell(folder: Path, store: str, protocol: str, methods: list[str]) -> Cell:
    kept = within_limit(folder)
    pair = torch.from_numpy(read_arrays(folder / "samples.npz")["pair"])[kept]
    predictions = {
        name: {key: torch.from_numpy(value) for key, value in read_arrays(folder / f"{file_name(name)}.npz").items()}
        for name in methods
    }
    return Cell(store, protocol, pair, len(kept), predictions)


def within_limit(folder: Path) -> Tensor:
    """Return which of a store's and protocol's samples, (S,), the un-normalised residual keeps.

    Raises:
        FileNotFoundError: if there are no samples.
        ValueError: if none is kept or the file is damaged.

    """
    kept = torch.from_numpy(read_arrays(folder / "samples.npz")["plain_residual"] < MAX_RESIDUAL)
    if not bool(kept.any()):
        raise ValueError(f"{folder}: none of {len(kept)} samples has an un-normalised residual below {MAX_RESIDUAL} px")
    return kept


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return what a file of a run holds.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is damaged.

    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there: the run is not complete, learnnorm evaluate goes on with it")
    try:
        with path.open("rb") as file, np.load(file) as data:
            return dict(data)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is damaged, remove it: {error}") from error


def file_name(method: str) -> str:
    """Return the name of a method's file, without suffix."""
    return "".join(letter if letter.isalnum() or letter in "+-._" else "_" for letter in method)

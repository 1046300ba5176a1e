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

__all__ = ["Cell", "Run", "read_run"]

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
    """

    about: dict[str, Any]
    cells: list[Cell]
    pairs: dict[str, dict[str, NDArray[Any]]]
    sizes: dict[str, dict[str, NDArray[Any]]]


def read_run(folder: str | Path) -> Run:
    """Read a run.

    Args:
        folder: what ``learnnorm evaluate --out`` wrote.

    Raises:
        FileNotFoundError: if it is no run, or not a complete one.
        ValueError: if a file is damaged.

    """
    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise FileNotFoundError(f"no run at {folder}: learnnorm evaluate STORE --out {folder} makes one")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    cells = [
        _read_cell(folder / store / protocol, store, protocol, about["methods"])
        for store in about["stores"]
        for protocol in ("filtered", "unfiltered")
    ]
    pairs = {store: _read(folder / store / "pairs.npz") for store in about["stores"]}
    sizes = {name: folder / "sizes" / f"{file_name(name)}.npz" for name in about["methods"]}
    return Run(about, cells, pairs, {name: _read(path) for name, path in sizes.items() if path.is_file()})


def _read_cell(folder: Path, store: str, protocol: str, methods: list[str]) -> Cell:
    samples = _read(folder / "samples.npz")
    kept = torch.from_numpy(samples["plain_residual"] < MAX_RESIDUAL)
    if not bool(kept.any()):
        raise ValueError(f"{folder}: none of {len(kept)} samples has an un-normalised residual below {MAX_RESIDUAL} px")
    predictions = {
        name: {key: torch.from_numpy(value)[kept] for key, value in _read(folder / f"{file_name(name)}.npz").items()}
        for name in methods
    }
    return Cell(store, protocol, torch.from_numpy(samples["pair"])[kept], len(kept), predictions)


def _read(path: Path) -> dict[str, NDArray[Any]]:
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

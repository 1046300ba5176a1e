"""Reading a run of predictions, which ``learnnorm evaluate`` makes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.pairs import MOTIONS
from kornia_learnnorm.evaluation.runs.predict import AGREEMENT, ERRORS
from kornia_learnnorm.evaluation.runs.store import Arrays, file_name, read_arrays, read_section
from kornia_learnnorm.protocol import PROTOCOLS

__all__ = [
    "EXAMPLE",
    "PAIRS",
    "SAMPLES",
    "SWEEP",
    "Cell",
    "Run",
    "is_swept",
    "method_path",
    "pairs_path",
    "prediction_keys",
    "read_run",
    "samples_path",
    "sweep_path",
]

# Arrays in the files of a run; read by name, so that a damaged file is recognised before it is used.
PAIRS = (*MOTIONS, "names")
SAMPLES = ("pair", "plain_residual")
EXAMPLE = ("store", "pair", "names", "points1", "points2", "truth", "F", "size")
SWEEP = ("size", "own", "truth")


@dataclass(frozen=True)
class Cell:
    """The predictions of all methods on the samples of one store and protocol."""

    store: str  # its name
    protocol: str  # filtered or unfiltered
    pair: Tensor  # image pair of each sample, (S,) int64
    drawn: int  # number of samples before the filter on the un-normalised residual
    predictions: dict[str, dict[str, Tensor]]  # arrays (S, ...) by method and quantity, float64

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


@dataclass(frozen=True)
class Run:
    """A run of predictions."""

    about: dict[str, Any]  # what the run was computed from, its section of run.json
    cells: list[Cell]
    pairs: dict[str, Arrays]  # the motion of each store's pairs, (P,) each
    sizes: dict[str, Arrays]  # errors by the number of correspondences, by method
    example: Arrays  # the image pair of these errors, from random_pair; empty where there is none yet
    missing: list[str] = field(default_factory=list)  # what has not been computed yet


def pairs_path(folder: Path, store: str) -> Path:
    """Return the file of the motions of a store's pairs."""
    return folder / file_name(store) / "pairs.npz"


def samples_path(folder: Path, store: str, protocol: str) -> Path:
    """Return the file of the samples of a store."""
    return folder / file_name(store) / protocol / "samples.npz"


def method_path(folder: Path, store: str, protocol: str, method: str) -> Path:
    """Return the file of a method's predictions."""
    return folder / file_name(store) / protocol / f"{file_name(method)}.npz"


def sweep_path(folder: Path, method: str) -> Path:
    """Return the file of a method's errors by the number of correspondences."""
    return folder / "sizes" / f"{file_name(method)}.npz"


def prediction_keys(complete: bool) -> tuple[str, ...]:
    """Return the names of the arrays in the file of a method's predictions."""
    return (*ERRORS, *AGREEMENT) if complete else ERRORS


def is_swept(method: str) -> bool:
    """Return whether a run keeps a method's errors by the number of correspondences: searching takes too long."""
    return not method.startswith("searched")


def read_run(folder: str | Path, complete: bool = True) -> Run:
    """Read what has been computed of a run.

    Args:
        folder: the folder that ``learnnorm evaluate --out`` wrote.
        complete: as for :func:`~kornia_learnnorm.evaluation.runs.record.record_run`.

    Raises:
        FileNotFoundError: if the folder holds no run, or a file that others depend on is missing.
        ValueError: if another version of the package made it, or a file is damaged.

    """
    folder = Path(folder)
    about, missing = read_section(folder, "evaluate"), list[str]()
    if about is None:
        raise FileNotFoundError(f"no run at {folder}: learnnorm evaluate STORE --out {folder} makes one")
    cells, pairs = [], {}
    for store in about["stores"]:
        for protocol in PROTOCOLS:
            if samples_path(folder, store, protocol).is_file():
                cells.append(_read_cell(folder, about, store, protocol, complete))
                pairs[store] = _read_pairs(pairs_path(folder, store), cells[-1].pair)
                absent = [name for name in about["methods"] if name not in cells[-1].predictions]
            else:
                absent = ["all methods"]
            missing += [f"{name} on {store}, {protocol}" for name in absent]
    if not (folder / "example.npz").is_file():
        known = any(np.isfinite(motions["inliers"]).any() for motions in pairs.values())
        return Run(about, cells, pairs, {}, {}, [*missing, *["the example of a pair"] * known])
    example = read_arrays(folder / "example.npz", EXAMPLE)
    swept = {name: sweep_path(folder, name) for name in about["methods"] if is_swept(name)}
    missing += [f"{name} by the number of correspondences" for name, path in swept.items() if not path.is_file()]
    sizes = {name: read_arrays(path, SWEEP) for name, path in swept.items() if path.is_file()}
    return Run(about, cells, pairs, sizes, example, missing)


def _read_cell(folder: Path, about: dict[str, Any], store: str, protocol: str, complete: bool) -> Cell:
    samples = read_arrays(samples_path(folder, store, protocol), SAMPLES)
    kept = torch.from_numpy(samples["plain_residual"] < about["max_residual"])
    pair = torch.from_numpy(samples["pair"])[kept]
    paths = {name: method_path(folder, store, protocol, name) for name in about["methods"]}
    keys = prediction_keys(complete)
    predictions = {
        name: {key: torch.from_numpy(value) for key, value in read_arrays(path, keys, len(pair)).items()}
        for name, path in paths.items()
        if path.is_file()
    }
    return Cell(store, protocol, pair, len(kept), predictions)


def _read_pairs(path: Path, pair: Tensor) -> Arrays:
    pairs = read_arrays(path, PAIRS)
    number = min(len(pairs[key]) for key in PAIRS)
    if not 0 <= int(pair.min()) <= int(pair.max()) < number:
        raise ValueError(f"{path} has {number} image pairs, there are samples of {int(pair.max()) + 1}: remove it")
    return pairs

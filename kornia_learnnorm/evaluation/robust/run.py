"""A run of robust estimation on disk: its section of ``run.json``, its files, and reading it.

The results of an estimator are in ``robust/STORE/PROTOCOL/THRESHOLD/ESTIMATOR.npz``, those of a minimal solver in
``hypotheses/STORE/PROTOCOL/SOLVER.npz``. The folder may also hold a run of ``learnnorm evaluate``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.store import file_name, read_arrays, read_section
from kornia_learnnorm.protocol import PROTOCOLS, THRESHOLDS

__all__ = ["RobustCell", "RobustRun", "estimate_path", "hypotheses_path", "read_robust", "result_files"]

Results = dict[str, Tensor]


@dataclass(frozen=True)
class RobustCell:
    """The results of one store and protocol."""

    store: str  # its name
    protocol: str  # filtered or unfiltered
    estimates: dict[str, dict[float, Results]]  # results (pairs, seeds) by estimator, then by threshold
    hypotheses: dict[str, Results]  # error and score of minimal samples, (pairs, samples), by solver

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


@dataclass(frozen=True)
class RobustRun:
    """A run of robust estimation."""

    about: dict[str, Any]  # what the run was computed from, its section of run.json
    cells: list[RobustCell]
    missing: list[str]  # what has not been computed yet


def estimate_path(folder: Path, store: str, protocol: str, threshold: float, name: str) -> Path:
    """Return the file of an estimator's results."""
    return folder / "robust" / file_name(store) / protocol / f"{threshold:g}px" / f"{file_name(name)}.npz"


def hypotheses_path(folder: Path, store: str, protocol: str, name: str) -> Path:
    """Return the file of a minimal solver's results."""
    return folder / "hypotheses" / file_name(store) / protocol / f"{file_name(name)}.npz"


def result_files(folder: Path, names: Iterable[str]) -> list[Path]:
    """Return the files of estimators and solvers."""
    patterns = ("robust/*/*/*", "hypotheses/*/*")
    return [path for name in names for p in patterns for path in folder.glob(f"{p}/{file_name(name)}.npz")]


def read_robust(folder: str | Path) -> RobustRun | None:
    """Read a run of robust estimation.

    Args:
        folder: the folder that ``learnnorm robust --out`` wrote.

    Returns:
        the run; None where the folder has none.

    Raises:
        ValueError: if another version of the package made it, or a file is damaged.

    """
    folder = Path(folder)
    about, missing = read_section(folder, "robust"), list[str]()
    if about is None:
        return None
    cells = [_read_cell(folder, about, store, protocol, missing) for store in about["stores"] for protocol in PROTOCOLS]
    return RobustRun(about, cells, missing)


def _read_cell(folder: Path, about: dict[str, Any], store: str, protocol: str, missing: list[str]) -> RobustCell:
    estimates, hypotheses = {}, {}
    for name, identity in about["estimators"].items():
        paths = {threshold: estimate_path(folder, store, protocol, threshold, name) for threshold in THRESHOLDS}
        if all(path.is_file() for path in paths.values()):
            estimates[name] = {threshold: _results(path) for threshold, path in paths.items()}
        elif identity is not None:  # its package is installed
            missing.append(f"{name} ({store}, {protocol})")
    for name in about["solvers"]:
        path = hypotheses_path(folder, store, protocol, name)
        if path.is_file():
            hypotheses[name] = _results(path)
        else:
            missing.append(f"hypotheses of {name} ({store}, {protocol})")
    return RobustCell(store, protocol, estimates, hypotheses)


def _results(path: Path) -> Results:
    return {key: torch.from_numpy(value).double() for key, value in read_arrays(path).items()}

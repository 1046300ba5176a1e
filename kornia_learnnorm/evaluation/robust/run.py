"""A run of robust estimation on disk: its section of ``run.json``, its files, and reading it.

The results of an estimator are in ``robust/STORE/PROTOCOL/THRESHOLD/ESTIMATOR.npz``, those of a minimal solver in
``hypotheses/STORE/PROTOCOL/SOLVER.npz``. The folder may also hold a run of ``learnnorm evaluate``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.arrays import file_name, read_arrays
from kornia_learnnorm.evaluation.runs.manifest import begin_section, read_section
from kornia_learnnorm.evaluation.runs.manifest import leave_out as remove
from kornia_learnnorm.protocol import PROTOCOLS, THRESHOLDS

__all__ = ["RobustCell", "RobustRun", "begin_run", "estimate_path", "hypotheses_path", "leave_out", "read_robust"]

Results = dict[str, Tensor]


@dataclass(frozen=True)
class RobustCell:
    """The results of one store and protocol.

    Attributes:
        store: name of the store.
        protocol: ``filtered`` or ``unfiltered``.
        estimates: results (pairs, seeds) by estimator, then by threshold.
        hypotheses: ``error`` and ``score`` of minimal samples, (pairs, samples), by solver.
    """

    store: str
    protocol: str
    estimates: dict[str, dict[float, Results]]
    hypotheses: dict[str, Results]

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


@dataclass(frozen=True)
class RobustRun:
    """A run of robust estimation.

    Attributes:
        about: what the run was computed from, its section of ``run.json``.
        cells: stores and protocols.
        missing: what has not been computed yet.
    """

    about: dict[str, Any]
    cells: list[RobustCell]
    missing: list[str]


def estimate_path(folder: Path, store: str, protocol: str, threshold: float, name: str) -> Path:
    """Return the file of an estimator's results."""
    return folder / "robust" / store / protocol / f"{threshold:g}px" / f"{file_name(name)}.npz"


def hypotheses_path(folder: Path, store: str, protocol: str, name: str) -> Path:
    """Return the file of a minimal solver's results."""
    return folder / "hypotheses" / store / protocol / f"{file_name(name)}.npz"


def begin_run(folder: Path, about: dict[str, Any], redo: Sequence[str] = ()) -> None:
    """Write what the run is computed from, or refuse a folder of another run; remove the files of ``redo``.

    Args:
        folder: the run, made if missing.
        about: as for :func:`~kornia_learnnorm.evaluation.runs.manifest.begin_section`.
        redo: estimators and solvers to compute again.

    Raises:
        ValueError: if the folder holds a run of other options.

    """
    begin_section(folder, "robust", about, redo)
    for name in redo:
        for path in _files(folder, name):
            path.unlink()


def leave_out(folder: Path, names: Sequence[str]) -> None:
    """Remove estimators and solvers that have no files from what a run is computed from.

    Args:
        folder: the run.
        names: of estimators and solvers.

    """
    remove(folder, "robust", [name for name in names if not _files(folder, name)])


def _files(folder: Path, name: str) -> list[Path]:
    """Return the files of an estimator or solver."""
    path = f"{file_name(name)}.npz"
    return [*folder.glob(f"robust/*/*/*/{path}"), *folder.glob(f"hypotheses/*/*/{path}")]


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
    estimates = {
        name: {threshold: estimate_path(folder, store, protocol, threshold, name) for threshold in THRESHOLDS}
        for name, identity in about["estimators"].items()
        if identity is not None
    }
    hypotheses = {name: hypotheses_path(folder, store, protocol, name) for name in about["solvers"]}
    lacking = [name for name, paths in estimates.items() if not all(path.is_file() for path in paths.values())]
    unsolved = [name for name, path in hypotheses.items() if not path.is_file()]
    missing += [f"{name} ({store}, {protocol})" for name in lacking]
    missing += [f"hypotheses of {name} ({store}, {protocol})" for name in unsolved]
    return RobustCell(
        store,
        protocol,
        {
            name: {threshold: _results(path) for threshold, path in paths.items()}
            for name, paths in estimates.items()
            if name not in lacking
        },
        {name: _results(path) for name, path in hypotheses.items() if name not in unsolved},
    )


def _results(path: Path) -> Results:
    return {key: torch.from_numpy(value).double() for key, value in read_arrays(path).items()}

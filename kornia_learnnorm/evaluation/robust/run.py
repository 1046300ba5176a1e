"""A run of robust estimation on disk: what it is of, its files, and reading it.

``robust.json`` says what it is of. Figures of an estimator are in ``robust/STORE/PROTOCOL/THRESHOLD/ESTIMATOR.npz``,
those of a minimal solver in ``hypotheses/STORE/PROTOCOL/SOLVER.npz``. The folder may also hold a run of ``learnnorm
evaluate``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.consensus import THRESHOLDS
from kornia_learnnorm.evaluation.runs.manifest import read_object
from kornia_learnnorm.evaluation.runs.run import file_name, read_arrays
from kornia_learnnorm.files import atomic_write

__all__ = ["RobustCell", "RobustRun", "begin_run", "estimate_path", "hypotheses_path", "leave_out", "read_robust"]

FORMAT = 1
JOINED = ("stores", "estimators", "solvers")
Figures = dict[str, Tensor]


@dataclass(frozen=True)
class RobustCell:
    """The figures of one store and protocol.

    Attributes:
        store: name of the store.
        protocol: ``filtered`` or ``unfiltered``.
        estimates: figures (pairs, seeds) by estimator, then by threshold.
        hypotheses: ``error`` and ``score`` of minimal samples, (pairs, samples), by solver.
    """

    store: str
    protocol: str
    estimates: dict[str, dict[float, Figures]]
    hypotheses: dict[str, Figures]

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


@dataclass(frozen=True)
class RobustRun:
    """Everything that a report shows of robust estimation.

    Attributes:
        about: what the run is of, from ``robust.json``.
        cells: stores and protocols.
        missing: what is not there yet.
    """

    about: dict[str, Any]
    cells: list[RobustCell]
    missing: list[str]


def estimate_path(folder: Path, store: str, protocol: str, threshold: float, name: str) -> Path:
    """Return the file of an estimator's figures."""
    return folder / "robust" / store / protocol / f"{threshold:g}px" / f"{file_name(name)}.npz"


def hypotheses_path(folder: Path, store: str, protocol: str, name: str) -> Path:
    """Return the file of a minimal solver's figures."""
    return folder / "hypotheses" / store / protocol / f"{file_name(name)}.npz"


def begin_run(folder: Path, about: dict[str, Any], redo: Sequence[str] = ()) -> None:
    """Write what the run is of, or refuse a folder of another run; stores, estimators and solvers may join one.

    Args:
        folder: the run, made if missing.
        about: options, and by the names of ``JOINED`` what each store, estimator and solver is; an estimator that
            is ``None`` is not installed.
        redo: estimators and solvers whose files are removed.

    Raises:
        ValueError: if the folder holds a run of other options.

    """
    path, about = folder / "robust.json", {"format": FORMAT, **about}
    if path.is_file():
        had = _read_about(folder)
        differ = [
            f"{key} {had.get(key)!r}, now {now!r}"
            for key, now in about.items()
            if key not in JOINED and had.get(key) != now
        ]
        for key in JOINED:
            about[key], changed = _join(had.get(key, {}), about[key], redo)
            differ += changed
        if differ:
            raise ValueError(f"{folder} is a run of other options, remove it or write elsewhere: {'; '.join(differ)}")
    folder.mkdir(parents=True, exist_ok=True)
    for name in redo:
        for old in [
            *folder.glob(f"robust/*/*/*/{file_name(name)}.npz"),
            *folder.glob(f"hypotheses/*/*/{file_name(name)}.npz"),
        ]:
            old.unlink()
    _write_about(folder, about)


def leave_out(folder: Path, names: Sequence[str]) -> None:
    """Take estimators and solvers out of what a run is of, but for those that have files.

    Args:
        folder: the run.
        names: of estimators and solvers.

    """
    about = _read_about(folder)
    for key in ("estimators", "solvers"):
        for name in [name for name in names if not any(folder.glob(f"*/**/{file_name(name)}.npz"))]:
            about[key].pop(name, None)
    _write_about(folder, about)


def _read_about(folder: Path) -> dict[str, Any]:
    path = folder / "robust.json"
    about = read_object(path)
    if about.get("format") != FORMAT:
        raise ValueError(f"{path} is of format {about.get('format')}, expected {FORMAT}")
    if wrong := [key for key in JOINED if not isinstance(about.get(key), dict)]:
        raise ValueError(f"{path} is damaged: {', '.join(wrong)} not as they should be")
    return about


def _write_about(folder: Path, about: dict[str, Any]) -> None:
    with atomic_write(folder / "robust.json") as beside:
        beside.write_text(json.dumps(about, indent=1), encoding="utf-8")


def _join(
    old: dict[str, str | None], new: dict[str, str | None], redo: Sequence[str]
) -> tuple[dict[str, str | None], list[str]]:
    """Return what was there and what is new, and what has changed; what is not installed now stays as it was."""
    new = {name: value for name, value in new.items() if value is not None or name not in old}
    changed = [
        f"{name} {old[name]!r}, now {value!r}"
        for name, value in new.items()
        if name not in redo and old.get(name) not in (None, value)
    ]
    return {**old, **new}, changed


def read_robust(folder: str | Path) -> RobustRun | None:
    """Read a run of robust estimation.

    Args:
        folder: what ``learnnorm robust --out`` wrote.

    Returns:
        the run; nothing where the folder has none.

    Raises:
        ValueError: if another version of the package made it, or a file is damaged.

    """
    folder = Path(folder)
    if not (folder / "robust.json").is_file():
        return None
    about, missing = _read_about(folder), list[str]()
    cells = [
        _read_cell(folder, about, store, protocol, missing)
        for store in about["stores"]
        for protocol in ("filtered", "unfiltered")
    ]
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
            name: {threshold: _figures(path) for threshold, path in paths.items()}
            for name, paths in estimates.items()
            if name not in lacking
        },
        {name: _figures(path) for name, path in hypotheses.items() if name not in unsolved},
    )


def _figures(path: Path) -> Figures:
    return {key: torch.from_numpy(value).double() for key, value in read_arrays(path).items()}

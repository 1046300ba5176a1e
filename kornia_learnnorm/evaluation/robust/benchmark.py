"""A run of robust estimators and minimal solvers on stores.

Results that exist are not computed again, and a run of other options is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.robust.budgets import Estimator
from kornia_learnnorm.evaluation.robust.estimators import (
    DEFAULT_ESTIMATORS,
    estimator_names,
    find_estimator,
    find_solver,
    identify_estimator,
)
from kornia_learnnorm.evaluation.robust.peers import PEERS
from kornia_learnnorm.evaluation.robust.record import record_missing
from kornia_learnnorm.evaluation.robust.run import begin_run, leave_out
from kornia_learnnorm.evaluation.runs.manifest import describe_stores, package_versions

__all__ = ["DEFAULT_OPTIONS", "record_robust"]

DEFAULT_OPTIONS = {
    "pairs": 48,  # image pairs of each store for the estimators; 0 for all
    "hypotheses": 12,  # image pairs of each store for the minimal solvers; 0 for all
    "seeds": 5,  # runs on each pair
    "slow_seeds": 1,  # runs of the slow estimators on each pair
    "seed": 0,  # the first seed
}
MIN_OPTIONS = {"pairs": 0, "hypotheses": 0, "seeds": 1, "slow_seeds": 1, "seed": 0}


def record_robust(
    folder: str | Path,
    stores: Mapping[str, str],
    estimators: Sequence[str] = DEFAULT_ESTIMATORS,
    solvers: Sequence[str] = (),
    options: Mapping[str, int] | None = None,
    redo: Sequence[str] = (),
) -> None:
    """Compute the missing results of a run, with a progress bar.

    An estimator whose package is not installed is left out, and the run records that.

    Args:
        folder: the run, created if it does not exist.
        stores: paths of the stores by their names in tables.
        estimators: names for :func:`~kornia_learnnorm.evaluation.robust.estimators.find_estimator`.
        solvers: names for :func:`~kornia_learnnorm.evaluation.robust.estimators.find_solver`.
        options: options that differ from :data:`DEFAULT_OPTIONS`.
        redo: estimators or solvers whose results are computed again.

    Raises:
        ValueError: if the folder holds a run of other options, an option, a store or an estimator is wrong, an existing
            file is damaged, or, at the end, if an estimator or solver has failed.
        OSError: if a file is missing or cannot be written.

    """
    folder, options = Path(folder), _checked(options or {})
    if unknown := {*redo} - {*estimators, *solvers}:
        raise ValueError(f"--redo {' '.join(sorted(unknown))}: not among the estimators and solvers of this command")
    names, solver_names = estimator_names(estimators), estimator_names(solvers)
    found = {name: _find(name) for name in estimators}
    solve = {solver_names[name]: find_solver(name) for name in solvers}
    read = {name: read_store(path) for name, path in stores.items()}
    about: dict[str, Any] = {
        "stores": describe_stores(read),
        "estimators": {names[name]: found[name] and identify_estimator(name) for name in estimators},
        "solvers": {solver_names[name]: identify_estimator(name) for name in solvers},
        **options,
        "threads": torch.get_num_threads(),
        "versions": package_versions(),
    }
    begin_run(folder, about, [(names | solver_names)[name] for name in redo])
    installed = {names[name]: estimator for name, estimator in found.items() if estimator is not None}
    failed = record_missing(folder, read, installed, solve, options)
    if failed:
        leave_out(folder, [*failed])
        raise ValueError(f"{'; '.join(dict.fromkeys(failed.values()))}. All others are in {folder}")


def _checked(options: Mapping[str, int]) -> dict[str, int]:
    """Return all options, with the defaults for those that are not given."""
    result = {**DEFAULT_OPTIONS, **options}
    for name, least in MIN_OPTIONS.items():
        if result[name] < least:
            raise ValueError(f"{name.replace('_', '-')} must be {least} or more, got {result[name]}")
    return result


def _find(name: str) -> Estimator | None:
    """Return an estimator; None if it is from another package that is not installed."""
    try:
        return find_estimator(name)
    except ImportError:
        if name in PEERS:
            return None
        raise

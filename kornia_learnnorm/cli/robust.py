"""Robust estimators, and the hypotheses of minimal solvers, on stores: ``learnnorm robust STORE ... --out RUN``.

What is there already is not computed again, and a run of other options is refused.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.robust.budgets import Estimator
from kornia_learnnorm.evaluation.robust.estimators import (
    DEFAULT_ESTIMATORS,
    DEFAULT_SOLVERS,
    estimator_names,
    find_estimator,
    find_solver,
    identify_estimator,
)
from kornia_learnnorm.evaluation.robust.peers import PEERS
from kornia_learnnorm.evaluation.robust.record import record_missing
from kornia_learnnorm.evaluation.robust.run import begin_run, leave_out
from kornia_learnnorm.evaluation.runs.manifest import describe_stores, package_versions
from kornia_learnnorm.evaluation.tables import names_of

__all__ = ["add_arguments", "record_robust", "run"]

PAIRS = 48
HYPOTHESES = 12  # image pairs
SEEDS, SLOW_SEEDS = 5, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm robust`` to a parser."""
    parser.add_argument(
        "stores", metavar="STORE", nargs="+", help="stores of correspondences (.h5); FILE.h5@3:10 for some pairs"
    )
    parser.add_argument("--out", metavar="RUN", type=Path, required=True, help="folder to write to")
    parser.add_argument(
        "--estimators",
        metavar="NAME",
        nargs="*",
        default=list(DEFAULT_ESTIMATORS),
        help="robust estimators; count:METHOD, time:METHOD and RANSAC:METHOD for your own (default: %(default)s)",
    )
    parser.add_argument(
        "--solvers",
        metavar="NAME",
        nargs="*",
        default=list(DEFAULT_SOLVERS),
        help="minimal solvers whose hypotheses are measured (default: %(default)s)",
    )
    counts = {
        "--pairs": (PAIRS, "evenly spaced image pairs of each store; 0: all"),
        "--hypotheses": (HYPOTHESES, "evenly spaced image pairs of each store for the minimal solvers; 0: all"),
        "--seeds": (SEEDS, "runs on each pair"),
        "--slow-seeds": (SLOW_SEEDS, "runs of those that can take a second: all but opencv-*, count:* and time:*"),
        "--seed": (0, "the first seed"),
    }
    for name, (default, text) in counts.items():
        parser.add_argument(name, metavar="N", type=int, default=default, help=f"{text} (default: %(default)s)")
    parser.add_argument(
        "--redo", metavar="NAME", nargs="+", default=[], help="estimators or solvers to run again, after a change"
    )


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm robust``.

    Raises:
        FileNotFoundError: if a store or weights are missing.
        ValueError: if an option, a store or weights are wrong, or the folder holds a run of other options.

    """
    stores = dict(zip(names_of(args.stores), args.stores, strict=True))
    options = {name: getattr(args, name) for name in ("pairs", "hypotheses", "seeds", "slow_seeds", "seed")}
    record_robust(args.out, stores, args.estimators, args.solvers, options, args.redo)
    print(f"wrote {args.out}; learnnorm report {args.out} makes tables and figures of it")
    return 0


def record_robust(
    folder: str | Path,
    stores: Mapping[str, str],
    estimators: Sequence[str] = DEFAULT_ESTIMATORS,
    solvers: Sequence[str] = (),
    options: Mapping[str, int] | None = None,
    redo: Sequence[str] = (),
) -> None:
    """Compute what is not there yet of a run, with a progress bar.

    An estimator whose package is not installed is left out, and the run says so.

    Args:
        folder: the run, made if missing.
        stores: paths of the stores by the names that tables give them.
        estimators: names for :func:`~kornia_learnnorm.evaluation.robust.estimators.find_estimator`.
        solvers: names for :func:`~kornia_learnnorm.evaluation.robust.estimators.find_solver`.
        options: of ``pairs``, ``hypotheses``, ``seeds``, ``slow_seeds`` and ``seed`` those that differ from the
            command's.
        redo: estimators or solvers whose figures are computed again.

    Raises:
        ValueError: if the folder holds a run of other options, an option, a store or an estimator is wrong, a file that
            is there is damaged, or, at the end, if an estimator or solver has failed.
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
    present = {names[name]: estimator for name, estimator in found.items() if estimator is not None}
    failed = record_missing(folder, read, present, solve, options)
    if failed:
        leave_out(folder, [*failed])
        raise ValueError(f"{'; '.join(dict.fromkeys(failed.values()))}. All others are in {folder}")


def _checked(options: Mapping[str, int]) -> dict[str, int]:
    """Return all options, with the command's defaults."""
    result = {"pairs": PAIRS, "hypotheses": HYPOTHESES, "seeds": SEEDS, "slow_seeds": SLOW_SEEDS, "seed": 0, **options}
    for name, least in {"pairs": 0, "hypotheses": 0, "seeds": 1, "slow_seeds": 1, "seed": 0}.items():
        if result[name] < least:
            raise ValueError(f"{name.replace('_', '-')} must be {least} or more, got {result[name]}")
    return result


def _find(name: str) -> Estimator | None:
    """Return an estimator; nothing for one of a package that is not installed."""
    try:
        return find_estimator(name)
    except ImportError:
        if name in PEERS:
            return None
        raise

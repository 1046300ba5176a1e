"""Run robust estimators and minimal solvers on stores, and keep their results.

Results that exist are not computed again, and a run of other options is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.robust.budgets import Estimator, Solver, run_estimator
from kornia_learnnorm.evaluation.robust.estimators import (
    DEFAULT_ESTIMATORS,
    estimator_names,
    find_estimator,
    find_solver,
    identify_estimator,
    is_slow,
    is_timed,
)
from kornia_learnnorm.evaluation.robust.hypotheses import hypothesis_quality, samples_of
from kornia_learnnorm.evaluation.robust.matches import Matches, draw_matches, even_pairs, measure
from kornia_learnnorm.evaluation.robust.peers import PEERS
from kornia_learnnorm.evaluation.robust.run import estimate_path, hypotheses_path, result_files
from kornia_learnnorm.evaluation.runs.store import (
    Arrays,
    begin_section,
    leave_out,
    read_arrays,
    run_folder,
    write_arrays,
)
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import PROTOCOLS, THRESHOLDS

__all__ = ["DEFAULT_OPTIONS", "record_robust"]

DEFAULT_OPTIONS = {
    "pairs": 48,  # image pairs of each store for the estimators; 0 for all
    "hypotheses": 12,  # image pairs of each store for the minimal solvers; 0 for all
    "seeds": 5,  # runs on each pair
    "slow_seeds": 1,  # runs of the slow estimators on each pair
    "seed": 0,  # the first seed
}
Draw = Callable[..., Matches]


def record_robust(
    folder: str | Path,
    stores: Mapping[str, str],
    estimators: Sequence[str] = DEFAULT_ESTIMATORS,
    solvers: Sequence[str] = (),
    options: Mapping[str, int] | None = None,
    redo: Sequence[str] = (),
    command: str = "",
) -> list[str]:
    """Compute the missing results of a run, with a progress bar.

    An estimator whose package is not installed is left out, and the run records that.

    Args:
        folder: the run, created if it does not exist.
        stores: paths of the stores by their names in tables.
        estimators: names for :func:`~kornia_learnnorm.evaluation.robust.estimators.find_estimator`.
        solvers: names for :func:`~kornia_learnnorm.evaluation.robust.estimators.find_solver`.
        options: options that differ from :data:`DEFAULT_OPTIONS`.
        redo: estimators or solvers whose results are computed again.
        command: the command line that asks for it, for the report.

    Returns:
        the names of the estimators that were left out, since their packages are not installed.

    Raises:
        ValueError: if the folder holds a run of other options, an option, a store or an estimator is wrong, an existing
            file is damaged, or, at the end, if an estimator or solver has failed.
        OSError: if a file is missing or cannot be written, or another process writes this run.

    """
    folder, options = Path(folder), {**DEFAULT_OPTIONS, **(options or {})}
    for name, value in options.items():
        if value < (least := 1 if name in ("seeds", "slow_seeds") else 0):
            raise ValueError(f"{name.replace('_', '-')} must be {least} or more, got {value}")
    if unknown := {*redo} - {*estimators, *solvers}:
        raise ValueError(f"--redo {' '.join(sorted(unknown))}: not among the estimators and solvers of this command")
    names, solver_names = estimator_names(estimators), estimator_names(solvers)
    found = {name: _find(name) for name in estimators}
    solve = {solver_names[name]: find_solver(name) for name in solvers}
    read = {name: read_store(path) for name, path in stores.items()}
    about: dict[str, Any] = {
        "estimators": {names[name]: found[name] and identify_estimator(name) for name in estimators},
        "solvers": {solver_names[name]: identify_estimator(name) for name in solvers},
        **options,
        "threads": torch.get_num_threads(),
    }
    redone = [(names | solver_names)[name] for name in redo]
    installed = {names[name]: estimator for name, estimator in found.items() if estimator is not None}
    with run_folder(folder):
        begin_section(folder, "robust", read, about, redone, command)
        for path in result_files(folder, redone):
            path.unlink()
        failed = _record_missing(folder, read, installed, solve, options)
        leave_out(folder, "robust", [name for name in failed if not result_files(folder, [name])])
    if failed:
        raise ValueError(f"{'; '.join(dict.fromkeys(failed.values()))}. All others are in {folder}")
    return [names[name] for name, estimator in found.items() if estimator is None]


def _find(name: str) -> Estimator | None:
    """Return an estimator; None if it is from another package that is not installed."""
    try:
        return find_estimator(name)
    except ImportError:
        if name in PEERS:
            return None
        raise


class _Job(NamedTuple):
    """An estimator, how often it runs on a pair, and the files by threshold that are missing."""

    name: str
    estimator: Estimator
    runs: int
    paths: dict[float, Path]


def _record_missing(
    folder: Path,
    stores: Mapping[str, CorrespondenceStore],
    estimators: Mapping[str, Estimator],
    solvers: Mapping[str, Solver],
    options: Mapping[str, int],
) -> dict[str, str]:
    """Compute what a run does not have yet; return why estimators and solvers failed, by name: all others go on.

    A step of the bar is a run on an image pair, or a solver on one.
    """
    tqdm = import_extra("tqdm", "images", "the progress bar of robust estimation").tqdm
    failed = dict[str, str]()
    runs = {name: min(options["seeds"], options["slow_seeds"] if is_slow(name) else 10**9) for name in estimators}
    # What depends on time takes turns, so that the load of the machine is the same for all.
    groups = [[name] for name in estimators if not is_timed(name)] + [[name for name in estimators if is_timed(name)]]
    chosen = {name: even_pairs(len(store), options["pairs"]) for name, store in stores.items()}
    few = {name: even_pairs(len(store), options["hypotheses"]) for name, store in stores.items()}
    steps = sum(len(chosen[name]) * sum(runs.values()) + len(few[name]) * len(solvers) for name in stores)
    with tqdm(total=steps * len(PROTOCOLS), unit="run", disable=None) as bar:
        for (name, store), protocol in product(stores.items(), PROTOCOLS):
            draw = partial(draw_matches, store, protocol=protocol, seed=options["seed"])
            for group in groups:
                bar.set_postfix_str(f"{name}, {protocol}, {', '.join(group)}")
                jobs = [
                    _Job(label, estimators[label], runs[label], _missing(folder, name, protocol, label))
                    for label in group
                    if label not in failed
                ]
                _record_estimates(jobs, draw, chosen[name], failed, bar)
            for label, solver in solvers.items():
                if label in failed:
                    continue
                bar.set_postfix_str(f"{name}, {protocol}, hypotheses of {label}")
                path = hypotheses_path(folder, name, protocol, label)
                try:
                    _record_hypotheses(path, solver, samples_of(label), draw, few[name], options["seed"], bar)
                except ValueError as error:
                    failed[label] = str(error)
    return failed


def _missing(folder: Path, store: str, protocol: str, name: str) -> dict[float, Path]:
    paths = {threshold: estimate_path(folder, store, protocol, threshold, name) for threshold in THRESHOLDS}
    return {threshold: path for threshold, path in paths.items() if not _is_there(path)}


def _is_there(path: Path) -> bool:
    """Return whether a file exists; a damaged one is an error."""
    return path.is_file() and bool(read_arrays(path))


def _record_estimates(jobs: Sequence[_Job], draw: Draw, pairs: Sequence[int], failed: dict[str, str], bar: Any) -> None:
    """Run estimators in turn on every pair with every seed, and write their results at each threshold."""
    todo = [job for job in jobs if job.paths]
    bar.update(len(pairs) * sum(job.runs for job in jobs if not job.paths))
    results: dict[Path, Arrays] = {path: {} for job in todo for path in job.paths.values()}
    for (place, pair), seed in product(enumerate(pairs), range(max((job.runs for job in todo), default=0))):
        matches = draw(pair=pair, order=seed)
        for job in todo:
            if seed >= job.runs or job.name in failed:
                continue
            try:
                estimates = run_estimator(job.estimator, matches, seed, [*job.paths])
            except ValueError as error:
                failed[job.name] = str(error)
                continue
            for (threshold, path), estimate in zip(job.paths.items(), estimates, strict=True):
                values = measure(matches, estimate.F_mat, threshold) | estimate._asdict()
                for key, value in values.items():
                    empty = np.full((len(pairs), job.runs, *np.shape(value)), np.nan)
                    results[path].setdefault(key, empty)[place, seed] = value
            bar.update()
    for job in todo:
        if job.name not in failed:
            for path in job.paths.values():
                write_arrays(path, {"pair": np.array(pairs), **results[path]})


def _record_hypotheses(
    path: Path, solver: Solver, number: int, draw: Draw, pairs: Sequence[int], seed: int, bar: Any
) -> None:
    """Measure a minimal solver's hypotheses of every pair."""
    if _is_there(path):
        bar.update(len(pairs))
        return
    errors, scores = [], []
    for pair in pairs:
        error, score = hypothesis_quality(solver, draw(pair=pair), number, seed)
        errors.append(error.float().numpy())
        scores.append(score.float().numpy())
        bar.update()
    write_arrays(path, {"pair": np.array(pairs), "error": np.stack(errors), "score": np.stack(scores)})

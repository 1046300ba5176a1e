"""Run robust estimators and minimal solvers on stores, and keep their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.robust.budgets import Estimate, Estimator, Solver, run_estimator
from kornia_learnnorm.evaluation.robust.estimators import is_slow, is_timed
from kornia_learnnorm.evaluation.robust.hypotheses import hypothesis_quality, samples_of
from kornia_learnnorm.evaluation.robust.matches import Matches, draw_matches, even_pairs, measure
from kornia_learnnorm.evaluation.robust.run import estimate_path, hypotheses_path
from kornia_learnnorm.evaluation.runs.arrays import Arrays, read_arrays, write_arrays
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import PROTOCOLS, THRESHOLDS

__all__ = ["record_missing"]

Draw = Callable[..., Matches]


class _Job(NamedTuple):
    """An estimator, how often it runs on a pair, and the files by threshold that are missing."""

    name: str
    estimator: Estimator
    runs: int
    paths: dict[float, Path]


def record_missing(
    folder: Path,
    stores: Mapping[str, CorrespondenceStore],
    estimators: Mapping[str, Estimator],
    solvers: Mapping[str, Solver],
    options: Mapping[str, int],
) -> dict[str, str]:
    """Compute what a run does not have yet; a step of the bar is a run on an image pair, or a solver on one.

    Args:
        folder: the run.
        stores: stores by name.
        estimators: robust estimators by name.
        solvers: minimal solvers by name.
        options: ``pairs``, ``hypotheses``, ``seeds``, ``slow_seeds`` and ``seed``, as for the command.

    Returns:
        why estimators and solvers failed, by name; all others go on.

    Raises:
        ValueError: if a file is damaged.

    """
    tqdm = import_extra("tqdm", "images", "the progress bar of robust estimation").tqdm
    failed = dict[str, str]()
    runs = {name: min(options["seeds"], options["slow_seeds"] if is_slow(name) else 10**9) for name in estimators}
    # What depends on time takes turns, so that the load of the machine is the same for all.
    groups = [[name] for name in estimators if not is_timed(name)] + [[name for name in estimators if is_timed(name)]]
    chosen = {name: even_pairs(len(store), options["pairs"] or None) for name, store in stores.items()}
    few = {name: even_pairs(len(store), options["hypotheses"] or None) for name, store in stores.items()}
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
                for key, value in _describe(matches, estimate, threshold).items():
                    empty = np.full((len(pairs), job.runs, *np.shape(value)), np.nan)
                    results[path].setdefault(key, empty)[place, seed] = value
            bar.update()
    for job in todo:
        if job.name not in failed:
            for path in job.paths.values():
                write_arrays(path, {"pair": np.array(pairs), **results[path]})


def _describe(matches: Matches, estimate: Estimate, threshold: float) -> dict[str, Any]:
    measured = measure(matches, estimate.F_mat, threshold)
    return {**measured, "F_mat": estimate.F_mat.numpy(), "seconds": estimate.seconds, "samples": estimate.samples}


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

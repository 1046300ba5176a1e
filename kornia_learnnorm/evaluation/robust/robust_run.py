"""Results of robust estimators on stores, kept in a folder: what ``learnnorm robust`` makes."""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.metrics import angle_error_mat, angle_error_vec
from torch import Tensor

from kornia_learnnorm import relative_pose, symmetric_epipolar_distance
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.robust import robust_estimators
from kornia_learnnorm.evaluation.robust.robust_estimators import Estimator, EvaluatedPair, run_estimator
from kornia_learnnorm.evaluation.runs import results_store
from kornia_learnnorm.evaluation.runs.results_store import About, Arrays, Job, Names, Paths, Stores
from kornia_learnnorm.metrics.inliers import epipolar_error, f1_score, finite_distance
from kornia_learnnorm.protocol import INLIER_THRESHOLD, MAX_FILTERED, PROTOCOLS, THRESHOLDS

DEFAULT_OPTIONS = {
    "pairs": 48,  # image pairs of each store; 0 for all
    "seeds": 5,  # runs on each pair
    "slow_seeds": 1,  # runs of the slow estimators on each pair
    "seed": 0,  # the first seed
}
Results = dict[str, Tensor]


class RobustCell(NamedTuple):
    """The results of one store and protocol."""

    store: str  # its name
    protocol: str  # filtered or unfiltered
    estimates: dict[str, dict[float, Results]]  # results (pairs, seeds) by estimator, then by threshold

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


class RobustRun(NamedTuple):
    """A run of robust estimation."""

    about: About  # what the run was computed from, its section of run.json
    cells: list[RobustCell]
    missing: list[str]  # what has not been computed yet


def record_robust(
    folder: Path, stores: Paths, estimators: Names, options: dict[str, int], redo: Names, command: str
) -> list[str]:
    """Compute the missing results of a run; return the estimators that were left out: their packages are not installed.

    Arguments and errors are those of ``record_run``; the results of ``redo`` are computed again.
    """
    for name, value in options.items():
        if value < (least := 1 if name in ("seeds", "slow_seeds") else 0):
            raise ValueError(f"{name.replace('_', '-')} must be {least} or more, got {value}")
    if unknown := {*redo} - {*estimators}:
        raise ValueError(f"--redo {' '.join(sorted(unknown))}: not among the estimators of this command")
    names = robust_estimators.estimator_names(estimators)
    installed, absent = dict[str, Estimator](), list[ImportError]()
    for name, short in names.items():
        try:
            installed[short] = robust_estimators.find_estimator(name)
        except ImportError as error:  # its package is not installed
            absent.append(error)
    if absent and not installed:
        raise absent[0]
    identify = robust_estimators.identify_estimator
    identities = {short: identify(name) if short in installed else None for name, short in names.items()}
    read = {name: read_store(path) for name, path in stores.items()}
    if calibrated := [name for name in names if name.endswith("-calibrated")]:
        for name, store in read.items():
            if not np.isfinite(store.K).any():
                raise ValueError(f"{' and '.join(calibrated)} need cameras, store {name} has none: leave out either")
    about: About = {"estimators": identities, **options, "threads": torch.get_num_threads()}
    jobs = _jobs(folder, read, installed, options)
    total = len(read) * len(PROTOCOLS) * len(THRESHOLDS) * len(installed)
    redone = [names[name] for name in redo]
    if failed := results_store.record(folder, "robust", read, about, jobs, total, redone, command):
        raise ValueError(f"{failed}. All others are in {folder}")
    return [name for name in identities if name not in installed]


def _jobs(folder: Path, stores: Stores, estimators: dict[str, Estimator], options: dict[str, int]) -> Iterator[Job]:
    for store, protocol, name, threshold in product(stores, PROTOCOLS, estimators, THRESHOLDS):
        pairs = even_pairs(len(stores[store]), options["pairs"])
        seeds = min(options["seeds"], options["slow_seeds"]) if robust_estimators.is_slow(name) else options["seeds"]
        draw = partial(shuffled_pair, stores[store], protocol=protocol, seed=options["seed"])
        compute = partial(_estimates, estimators[name], draw, threshold, pairs, seeds)
        yield name, estimate_path(folder, store, protocol, threshold, name), compute


def _estimates(
    estimator: Estimator, draw: Callable[..., EvaluatedPair], threshold: float, pairs: list[int], seeds: int
) -> Arrays:
    """Return an estimator's matrices of every pair with every seed and their metrics, arrays (pairs, seeds, ...)."""
    rows = []
    for index, seed in product(pairs, range(seeds)):
        pair = draw(index, order=seed)
        found = run_estimator(estimator, pair, seed, threshold)
        rows.append({**measure(pair, found.F_mat, threshold), **found._asdict(), "F_mat": found.F_mat.numpy()})
    arrays = {key: np.array([row[key] for row in rows], float) for key in rows[0]}
    return {"pair": np.array(pairs)} | {key: v.reshape(len(pairs), seeds, *v.shape[1:]) for key, v in arrays.items()}


def even_pairs(total: int, number: int) -> list[int]:
    """Return the indices of at most ``number`` evenly spaced image pairs of ``total``; all of them for 0."""
    return [int(place) for place in np.linspace(0, total - 1, min(number or total, total)).round()]


def shuffled_pair(store: CorrespondenceStore, pair: int, protocol: str, seed: int, order: int = 0) -> EvaluatedPair:
    """Return the correspondences of an image pair, at most 1,000 filtered ones; ``order`` is a seed of their order."""
    rows = store.rows(pair, PROTOCOLS[protocol])
    if protocol == "filtered":
        rows = np.random.default_rng([seed, pair]).permutation(rows)[:MAX_FILTERED]
    rows = np.random.default_rng([seed, pair, order]).permutation(rows)
    points1, points2 = (torch.from_numpy(points[rows]).double() for points in (store.points1, store.points2))
    F_mat, K, R, t = (torch.from_numpy(part[pair]) for part in (store.F, store.K, store.R, store.t))
    scores = torch.from_numpy(store.score[rows]).double()
    return EvaluatedPair(points1, points2, F_mat, K, R, t, store.image_size[pair], scores)


def measure(pair: EvaluatedPair, F_mat: Tensor, threshold: float) -> dict[str, float]:
    """Return ``inliers``, ``f1``, ``error`` (px) and errors of the pose (degrees) of a matrix, NaN where unknown."""
    x1, x2 = pair.points1, pair.points2
    near = symmetric_epipolar_distance(x1, x2, F_mat) < INLIER_THRESHOLD
    K1, K2 = torch.where(pair.K.isnan(), torch.eye(3).to(pair.K), pair.K)  # any, where the true pose is unknown
    pose = relative_pose(F_mat[None], K1, K2, x1[None], x2[None], near[None])
    known = (angle_error_mat(pair.R, pair.R) + angle_error_vec(pair.t, pair.t)).isfinite()
    results = {
        "inliers": (finite_distance(x1, x2, F_mat) < threshold).double().mean(),
        "f1": f1_score(x1, x2, F_mat, pair.F_mat, threshold),
        "error": epipolar_error(x1, x2, F_mat, pair.F_mat),
        "rotation_error": angle_error_mat(pose[0][0], pair.R).nan_to_num(torch.inf).where(known, torch.nan),
        "translation_error": angle_error_vec(pose[1][0], pair.t).nan_to_num(torch.inf).where(known, torch.nan),
    }
    return {name: float(value) for name, value in results.items()}


def estimate_path(folder: Path, store: str, protocol: str, threshold: float, name: str) -> Path:
    """Return the file of an estimator's results."""
    return results_store.array_path(folder / "robust", store, protocol, f"{threshold:g}px", name)


def read_robust(folder: Path) -> RobustRun | None:
    """Read a run of robust estimation, None where the folder has none; raise ValueError if it is damaged."""
    about, missing = results_store.read_section(folder, "robust"), list[str]()
    if about is None:
        return None
    cells = []
    for store, protocol in product(about["stores"], PROTOCOLS):
        cells.append(RobustCell(store, protocol, {}))
        for name, identity in about["estimators"].items():
            paths = {threshold: estimate_path(folder, store, protocol, threshold, name) for threshold in THRESHOLDS}
            if all(path.is_file() for path in paths.values()):
                cells[-1].estimates[name] = {t: results_store.read_arrays(path) for t, path in paths.items()}
            elif identity is not None:  # its package is installed
                missing.append(f"{name} ({store}, {protocol})")
    return RobustRun(about, cells, missing)

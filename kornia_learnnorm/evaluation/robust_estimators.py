"""The robust estimators that ``learnnorm robust`` compares, by name."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.geometry.epipolar.fundamental import run_7point
from torch import Tensor

from kornia_learnnorm.evaluation.methods import OPTIMAL, REFINED, base_name, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.predict import Normalizer
from kornia_learnnorm.evaluation.robust_matches import Matches
from kornia_learnnorm.evaluation.robust_peers import PEERS, Peer, find_peer, peer_version
from kornia_learnnorm.ransac import RANSAC
from kornia_learnnorm.sampling import SAMPLE_SIZE, draw_distinct
from kornia_learnnorm.scoring import PairScorer

__all__ = [
    "DEFAULT_ESTIMATORS",
    "DEFAULT_SOLVERS",
    "Estimate",
    "Estimator",
    "Solver",
    "estimator_names",
    "find_estimator",
    "find_solver",
    "identify_estimator",
    "is_slow",
    "minimal_samples",
    "run_estimator",
]

SEVEN_POINT = "seven-point"
COUNT = 1000  # samples of a run of equal hypotheses
SECONDS = 0.05  # of a run of equal time
DEFAULTS = "RANSAC"
KINDS = ("count:", "time:", f"{DEFAULTS}:")
_SOLVERS = ("Hartley", "whitening", "paper", "crossview", "Hartley+optimal")
DEFAULT_SOLVERS = ("none", "Hartley", "whitening", "reweighted", *_SOLVERS[2:], SEVEN_POINT, "searched")
DEFAULT_ESTIMATORS = (
    *PEERS,
    *(f"count:{name}" for name in (*_SOLVERS, SEVEN_POINT)),
    *(f"time:{name}" for name in _SOLVERS),
    DEFAULTS,
    f"{DEFAULTS}:crossview",
)


class Estimate(NamedTuple):
    """A matrix and what it took.

    Attributes:
        F_mat: (3, 3) float64; NaN for a failure.
        seconds: wall clock.
        samples: how many minimal samples were solved; NaN where that is not known.
    """

    F_mat: Tensor
    seconds: float
    samples: float


class Solver(NamedTuple):
    """A minimal solver.

    Attributes:
        size: correspondences of a sample.
        solve: maps points in pixels, (K, size, 2) float64 each, to candidate matrices (K, C, 3, 3).
    """

    size: int
    solve: Callable[[Tensor, Tensor], Tensor]


Estimator = Callable[[Matches, int, Sequence[float]], list[Estimate]]  # by seed, for each threshold


def find_solver(name: str) -> Solver:
    """Return a minimal solver by its name.

    Args:
        name: ``seven-point``, Kornia's, or as for :func:`~kornia_learnnorm.evaluation.methods.find_method`.

    Raises:
        ValueError: if there is no such method.
        FileNotFoundError: if there are no such weights.

    """
    if name == SEVEN_POINT:
        return Solver(7, run_7point)
    method = find_method(name)
    return Solver(SAMPLE_SIZE, lambda x1, x2: method.estimate(x1, x2)[:, None])


def find_estimator(name: str) -> Estimator:
    """Return a robust estimator by its name.

    Args:
        name: one of :data:`~kornia_learnnorm.evaluation.robust_peers.PEERS`; ``count:SOLVER``, the best of 1,000
            minimal samples, the same for all solvers; ``time:METHOD``, the best of those of 50 ms; ``RANSAC`` or
            ``RANSAC:METHOD``, :class:`~kornia_learnnorm.ransac.RANSAC` with its defaults and with another normaliser.

    Raises:
        ValueError: if there is no such estimator.
        FileNotFoundError: if there are no such weights.
        ImportError: if its package is not installed.

    """
    if name in PEERS:
        return _each(find_peer(name))
    kind, _, method = name.partition(":")
    if kind == "count" and method:
        return _equal_count(find_solver(method))
    if name == DEFAULTS or (kind == DEFAULTS and method):
        return _ransac(method or None, {})
    if kind == "time" and method:
        return _ransac(method, {"max_iter": 10**7, "max_seconds": SECONDS, "confidence": 1, "refine": False})
    raise ValueError(
        f"no estimator {name!r}: expected {', '.join(PEERS)}, count:SOLVER, time:METHOD, RANSAC or RANSAC:METHOD"
    )


def run_estimator(estimator: Estimator, matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
    """Run an estimator, or let it fail where there are fewer than eight correspondences.

    Args:
        estimator: from :func:`find_estimator`.
        matches: the correspondences.
        seed: seed of its draws.
        thresholds: of inliers, pixels.

    Returns:
        a matrix for each threshold.

    """
    if len(matches.points1) < SAMPLE_SIZE:
        return [Estimate(_failure(), 0.0, 0.0) for _ in thresholds]
    return estimator(matches, seed, thresholds)


def is_slow(name: str) -> bool:
    """Return whether an estimator can take a second and more where inliers are few."""
    return not name.startswith(("opencv", *KINDS[:2]))


def identify_estimator(name: str) -> str:
    """Return what an estimator's figures depend on: its package's version, or the digest of its weights."""
    if name in PEERS:
        return peer_version(name)
    kind, _, method = name.partition(":")
    return f"{kind}:{identify_method(method)}" if method and method != SEVEN_POINT else name


def minimal_samples(total: int, number: int, seed: int) -> Tensor:
    """Return the minimal samples that all solvers get, (number, 8) indices of ``total`` correspondences."""
    return draw_distinct(torch.full((number,), total), SAMPLE_SIZE, torch.Generator().manual_seed(seed))


def estimator_names(names: Sequence[str]) -> dict[str, str]:
    """Return the names of estimators or solvers for tables and files: of weights, the run's folder or the file's name.

    Args:
        names: as for :func:`find_estimator` or :func:`find_solver`.

    Raises:
        ValueError: if two are the same.

    """
    short = {}
    for name in names:
        kind, colon, method = name.partition(":") if name.startswith(KINDS) else ("", "", name)
        short[name] = kind + colon + short_names([method])[method]
    if len(set(short.values())) < len(names):
        raise ValueError(f"two estimators have the same name: {', '.join(names)}")
    return short


def _failure() -> Tensor:
    return torch.full((3, 3), torch.nan, dtype=torch.float64)


def _each(peer: Peer) -> Estimator:
    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        found = []
        for threshold in thresholds:
            start = time.perf_counter()
            F_mat = peer(matches.points1.numpy(), matches.points2.numpy(), matches.size, seed, threshold)
            seconds = time.perf_counter() - start
            # OpenCV stacks several matrices where seven points are all there is.
            good = F_mat is not None and F_mat.shape == (3, 3)
            F_mat = torch.tensor(np.array(F_mat, float)) if good else _failure()
            found.append(Estimate(F_mat, seconds, math.nan))
        return found

    return estimate


def _equal_count(solver: Solver) -> Estimator:
    """The best of the same samples; hypotheses do not depend on the threshold, only which of them is chosen."""

    @torch.no_grad()
    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        x1, x2 = matches.points1, matches.points2
        start = time.perf_counter()
        rows = minimal_samples(len(x1), COUNT, seed)[:, : solver.size]
        F_mat = solver.solve(x1[rows], x2[rows])
        shared, found = time.perf_counter() - start, []
        for threshold in thresholds:
            start = time.perf_counter()
            scorer = PairScorer(x1, x2, threshold)
            kept = F_mat
            if solver.size == SAMPLE_SIZE:
                kept = F_mat[scorer.determined(x1[rows], x2[rows])]
            best = scorer.best(kept.flatten(0, 1), 1).F_mat
            seconds = shared + time.perf_counter() - start
            found.append(Estimate(best[0] if len(best) else _failure(), seconds, COUNT))
        return found

    return estimate


class _Counted:
    """A normaliser that counts the samples it is given."""

    def __init__(self, normalizer: Normalizer) -> None:
        self.normalizer, self.samples = normalizer, 0

    def __call__(self, x1: Tensor, x2: Tensor, w: Tensor | None) -> tuple[Tensor, Tensor]:
        self.samples += len(x1) if x1.shape[1] == SAMPLE_SIZE else 0
        return self.normalizer(x1, x2, w)


def _ransac(name: str | None, options: dict[str, Any]) -> Estimator:
    """RANSAC with the normaliser of a method, or with its own."""
    if name and name.endswith(REFINED):
        raise ValueError(f"RANSAC refines by itself: {base_name(name)!r} without {REFINED}, got {name!r}")
    normalizer = find_method(name).normalizer if name else None
    if name and name.endswith(OPTIMAL):
        options = {**options, "rank2": "optimal"}

    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        found = []
        for threshold in thresholds:
            counted = None if normalizer is None else _Counted(normalizer)
            start = time.perf_counter()
            F_mat = RANSAC(counted, inl_th=threshold, seed=seed, **options)(matches.points1, matches.points2)[0]
            seconds = time.perf_counter() - start
            F_mat = F_mat if bool(F_mat.any()) else _failure()
            found.append(Estimate(F_mat, seconds, counted.samples if counted else math.nan))
        return found

    return estimate

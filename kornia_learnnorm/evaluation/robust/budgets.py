"""Robust estimators under equal budgets: the best of so many minimal samples, and RANSAC with a normaliser."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.estimators.fundamental import Normalizer
from kornia_learnnorm.estimators.minimal import are_determined
from kornia_learnnorm.evaluation.robust.matches import Matches
from kornia_learnnorm.evaluation.robust.peers import Peer
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE, draw_distinct
from kornia_learnnorm.ransac.scoring import PairScorer

__all__ = ["Estimate", "Estimator", "Solver", "best_of", "minimal_samples", "peer_estimator", "ransac", "run_estimator"]


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


def minimal_samples(total: int, number: int, seed: int) -> Tensor:
    """Return the minimal samples that all solvers get, (number, 8) indices of ``total`` correspondences."""
    return draw_distinct(torch.full((number,), total), SAMPLE_SIZE, torch.Generator().manual_seed(seed))


def run_estimator(estimator: Estimator, matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
    """Run an estimator, or let it fail where there are fewer than eight correspondences.

    Args:
        estimator: from :func:`~kornia_learnnorm.evaluation.robust.estimators.find_estimator`.
        matches: the correspondences.
        seed: seed of its draws.
        thresholds: of inliers, pixels.

    Returns:
        a matrix for each threshold.

    """
    if len(matches.points1) < SAMPLE_SIZE:
        return [Estimate(_failure(), 0.0, 0.0) for _ in thresholds]
    return estimator(matches, seed, thresholds)


def _failure() -> Tensor:
    return torch.full((3, 3), torch.nan, dtype=torch.float64)


def peer_estimator(peer: Peer) -> Estimator:
    """Return an estimator of another package, timed.

    Args:
        peer: from :func:`~kornia_learnnorm.evaluation.robust.peers.find_peer`.

    """

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


def best_of(number: int, solver: Solver) -> Estimator:
    """Return what takes the matrix of highest MSAC score of so many minimal samples, the same for all solvers.

    The matrices do not depend on the threshold, only which of them is taken: they are computed once for all.

    Args:
        number: of minimal samples.
        solver: what solves them.

    """

    @torch.no_grad()
    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        x1, x2 = matches.points1, matches.points2
        start = time.perf_counter()
        rows = minimal_samples(len(x1), number, seed)[:, : solver.size]
        F_mat = solver.solve(x1[rows], x2[rows])
        shared, found = time.perf_counter() - start, []
        for threshold in thresholds:
            start = time.perf_counter()
            scorer = PairScorer(x1, x2, threshold)
            kept = F_mat
            if solver.size == SAMPLE_SIZE:
                kept = F_mat[are_determined(*scorer.samples(rows), 0.01 * threshold)]
            best = scorer.to_pixels(scorer.best(scorer.from_pixels(kept.flatten(0, 1)), 1).F_mat)
            seconds = shared + time.perf_counter() - start
            found.append(Estimate(best[0] if len(best) else _failure(), seconds, number))
        return found

    return estimate


class _Counted(RANSAC):
    """RANSAC that counts the samples it draws."""

    samples = 0

    def _solve(self, scorer: PairScorer, rows: Tensor) -> Tensor:
        self.samples += len(rows)
        return super()._solve(scorer, rows)


def ransac(normalizer: Normalizer | None, options: dict[str, Any]) -> Estimator:
    """Return :class:`~kornia_learnnorm.RANSAC` as an estimator.

    Args:
        normalizer: its normaliser; None for its own.
        options: further arguments of it.

    """

    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        found = []
        for threshold in thresholds:
            estimator = _Counted(normalizer, inl_th=threshold, seed=seed, **options)
            start = time.perf_counter()
            F_mat = estimator(matches.points1, matches.points2)[0]
            seconds = time.perf_counter() - start
            F_mat = F_mat if bool(F_mat.any()) else _failure()
            found.append(Estimate(F_mat, seconds, estimator.samples))
        return found

    return estimate

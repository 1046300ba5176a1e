"""Robust estimators on equal budgets: the best of a number of minimal samples, and RANSAC with a normaliser."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.estimators.minimal import are_determined
from kornia_learnnorm.evaluation.robust.matches import Matches
from kornia_learnnorm.evaluation.robust.peers import Peer
from kornia_learnnorm.normalizers.contract import Normalizer
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE, draw_distinct
from kornia_learnnorm.ransac.scoring import PairScorer

__all__ = ["Estimate", "Estimator", "Solver", "best_of", "minimal_samples", "peer_estimator", "ransac", "run_estimator"]


class Estimate(NamedTuple):
    """A fundamental matrix, its time and its number of samples.

    Attributes:
        F_mat: (3, 3) float64; NaN for a failure.
        seconds: wall-clock time.
        samples: number of minimal samples solved; NaN if unknown.
    """

    F_mat: Tensor
    seconds: float
    samples: float


class Solver(NamedTuple):
    """A minimal solver.

    Attributes:
        size: correspondences in a sample.
        solve: maps points1 and points2 in pixels, (K, size, 2) float64, to candidate matrices (K, C, 3, 3).
    """

    size: int
    solve: Callable[[Tensor, Tensor], Tensor]


Estimator = Callable[[Matches, int, Sequence[float]], list[Estimate]]  # matches, seed, thresholds in pixels


def minimal_samples(total: int, number: int, seed: int) -> Tensor:
    """Return the minimal samples that all solvers share, (number, 8) indices of ``total`` correspondences."""
    return draw_distinct(torch.full((number,), total), SAMPLE_SIZE, torch.Generator().manual_seed(seed))


def run_estimator(estimator: Estimator, matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
    """Return the estimates of an estimator; failures if there are fewer than eight correspondences.

    Args:
        estimator: from :func:`~kornia_learnnorm.evaluation.robust.estimators.find_estimator`.
        matches: the correspondences.
        seed: seed of the samples.
        thresholds: inlier thresholds, pixels.

    Returns:
        one estimate per threshold.

    """
    if len(matches.points1) < SAMPLE_SIZE:
        return [Estimate(_failure(), 0.0, 0.0) for _ in thresholds]
    return estimator(matches, seed, thresholds)


def _failure() -> Tensor:
    return torch.full((3, 3), torch.nan, dtype=torch.float64)


def peer_estimator(peer: Peer) -> Estimator:
    """Return an estimator of another package that measures its time.

    Args:
        peer: from :func:`~kornia_learnnorm.evaluation.robust.peers.find_peer`.

    """

    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        found = []
        for threshold in thresholds:
            start = time.perf_counter()
            F_mat = peer(matches.points1.numpy(), matches.points2.numpy(), matches.size, seed, threshold)
            seconds = time.perf_counter() - start
            # OpenCV stacks up to three matrices if there are only seven points.
            good = F_mat is not None and F_mat.shape == (3, 3)
            F_mat = torch.tensor(np.array(F_mat, float)) if good else _failure()
            found.append(Estimate(F_mat, seconds, math.nan))
        return found

    return estimate


def best_of(number: int, solver: Solver) -> Estimator:
    """Return an estimator that picks the matrix of highest MSAC score among a number of minimal samples.

    Only the score depends on the threshold: the matrices are computed once for all thresholds.

    Args:
        number: number of minimal samples, which all solvers share.
        solver: minimal solver.

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


def ransac(normalizer: Normalizer | None, options: dict[str, Any]) -> Estimator:
    """Return :class:`~kornia_learnnorm.RANSAC` as an estimator.

    Args:
        normalizer: normaliser; None for the default of RANSAC.
        options: further arguments of RANSAC.

    """

    def estimate(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        found = []
        for threshold in thresholds:
            estimator = RANSAC(normalizer, inl_th=threshold, seed=seed, **options)
            start = time.perf_counter()
            result = estimator.estimate(matches.points1, matches.points2)
            seconds = time.perf_counter() - start
            F_mat = result.F_mat if bool(result.F_mat.any()) else _failure()
            found.append(Estimate(F_mat, seconds, result.num_samples))
        return found

    return estimate

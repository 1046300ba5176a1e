"""Robust estimators on equal budgets: the best of a number of minimal samples, and RANSAC with a normaliser."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.estimators.minimal import are_determined
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.evaluation.robust.matches import Matches
from kornia_learnnorm.evaluation.robust.peers import Peer
from kornia_learnnorm.normalizers.contract import Normalizer
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE, draw_distinct
from kornia_learnnorm.ransac.scoring import PairScorer

__all__ = [
    "Estimate",
    "Estimator",
    "Solver",
    "best_of",
    "guided_ransac",
    "learned",
    "minimal_samples",
    "peer_estimator",
    "ransac",
    "run_estimator",
]


class Estimate(NamedTuple):
    """A fundamental matrix, its time and its number of samples."""

    F_mat: Tensor  # (3, 3) float64; NaN for a failure
    seconds: float  # wall-clock time
    samples: float  # number of minimal samples solved; NaN if unknown


class Solver(NamedTuple):
    """A minimal solver."""

    size: int  # correspondences in a sample
    solve: Callable[[Tensor, Tensor], Tensor]  # points (K, size, 2) float64 in pixels to candidates (K, C, 3, 3)


Estimator = Callable[[Matches, int, Sequence[float]], list[Estimate]]  # matches, seed, thresholds in pixels


def minimal_samples(total: int, number: int, seed: int) -> Tensor:
    """Return the minimal samples that all solvers share, (number, 8) indices of ``total`` correspondences."""
    return draw_distinct(torch.full((number,), total), SAMPLE_SIZE, torch.Generator().manual_seed(seed))


def run_estimator(estimator: Estimator, matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
    """Return one estimate per threshold, in pixels; failures if there are fewer than eight correspondences."""
    if len(matches.points1) < SAMPLE_SIZE:
        return [Estimate(_failure(), 0.0, 0.0) for _ in thresholds]
    return estimator(matches, seed, thresholds)


def _failure() -> Tensor:
    return torch.full((3, 3), torch.nan, dtype=torch.float64)


def _timed(estimate: Callable[[Matches, int, float], tuple[Tensor | None, float]]) -> Estimator:
    """Return an estimator that calls a function at each threshold and measures its time; None is a failure."""

    def run(matches: Matches, seed: int, thresholds: Sequence[float]) -> list[Estimate]:
        found = []
        for threshold in thresholds:
            start = time.perf_counter()
            F_mat, samples = estimate(matches, seed, threshold)
            seconds = time.perf_counter() - start
            found.append(Estimate(_failure() if F_mat is None else F_mat, seconds, samples))
        return found

    return run


def peer_estimator(peer: Peer, calibrated: bool = False) -> Estimator:
    """Return an estimator of another package that measures its time; if ``calibrated``, it gets the cameras too."""

    def estimate(matches: Matches, seed: int, threshold: float) -> tuple[Tensor | None, float]:
        cameras = [matches.K.numpy()] if calibrated else []
        F_mat = peer(matches.points1.numpy(), matches.points2.numpy(), matches.size, seed, threshold, *cameras)
        # OpenCV stacks up to three matrices if there are only seven points.
        good = F_mat is not None and F_mat.shape == (3, 3)
        return torch.tensor(np.array(F_mat, float)) if good else None, math.nan

    return _timed(estimate)


def ransac(normalizer: Normalizer | None, options: dict[str, Any], calibrated: bool = False) -> Estimator:
    """Return :class:`~kornia_learnnorm.RANSAC` with a normaliser, its default if None, as an estimator.

    If ``calibrated``, it gets the cameras too, and fails on pairs of unknown cameras.
    """

    def estimate(matches: Matches, seed: int, threshold: float) -> tuple[Tensor | None, float]:
        if calibrated and not bool(matches.K.isfinite().all()):
            return None, 0.0
        cameras = {"K1": matches.K[0], "K2": matches.K[1]} if calibrated else {}
        estimator = RANSAC(normalizer, inl_th=threshold, seed=seed, **options)
        result = estimator.estimate(matches.points1, matches.points2, **cameras)
        return result.F_mat if bool(result.F_mat.any()) else None, result.num_samples

    return _timed(estimate)


def learned(estimator: LearnedEightPoint, refined: bool) -> Estimator:
    """Return a learned estimator, which has no threshold, followed by robust refinement at the threshold if wanted."""

    @torch.no_grad()
    def estimate(matches: Matches, seed: int, threshold: float) -> tuple[Tensor | None, float]:
        points1, points2 = matches.points1[None], matches.points2[None]
        F_mat = estimator(points1, points2)
        if refined:
            F_mat = refine_fundamental(points1, points2, F_mat, loss=GemanMcClure(threshold)).F_mat
        return F_mat[0], math.nan

    return _timed(estimate)


def guided_ransac(estimator: LearnedEightPoint) -> Estimator:
    """Return :class:`~kornia_learnnorm.RANSAC` whose samples follow the probabilities of a learned estimator."""

    @torch.no_grad()
    def estimate(matches: Matches, seed: int, threshold: float) -> tuple[Tensor | None, float]:
        points1, points2 = matches.points1, matches.points2
        weights = estimator.estimate(points1[None], points2[None]).weights[0]
        result = RANSAC(inl_th=threshold, seed=seed).estimate(points1, points2, weights)
        return result.F_mat if bool(result.F_mat.any()) else None, result.num_samples

    return _timed(estimate)


def best_of(number: int, solver: Solver) -> Estimator:
    """Return an estimator that picks the matrix of highest MSAC score among minimal samples, which all solvers share.

    Only the score depends on the threshold: the matrices are computed once for all thresholds.
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

r"""Errors of the hypotheses of minimal solvers: of the best of :math:`k`, and of the one that MSAC picks.

All solvers share the minimal samples. The error of a hypothesis is the mean symmetric epipolar distance of the pair's
ground-truth inliers. It is clamped to 60 px, where Fan et al. drop a sample.
"""

from __future__ import annotations

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.evaluation.robust.budgets import Solver, minimal_samples
from kornia_learnnorm.evaluation.robust.matches import Matches
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.protocol import INLIER_THRESHOLD, MAX_RESIDUAL

__all__ = ["MAX_ERROR", "NUMBERS", "expected_best", "hypothesis_quality", "picked", "samples_of"]

NUMBERS = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)  # values of k
NUM_SAMPLES = {"paper": 1000, "searched": 200}  # minimal samples of the slow solvers
MIN_INLIERS = 16  # ground-truth inliers; pairs with fewer are not measured
MAX_ERROR = MAX_RESIDUAL  # pixels; larger errors are clamped
BATCH_SIZE = 1000  # minimal samples solved together
BLOCK_SIZE = 1 << 17  # distances computed together; they fit the cache of a core


def samples_of(solver: str) -> int:
    """Return the number of minimal samples of a pair for a solver, by its name."""
    return NUM_SAMPLES.get(solver, NUMBERS[-1])


@torch.no_grad()
def hypothesis_quality(solver: Solver, matches: Matches, number: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return errors in pixels and MSAC scores at 1 px, (number,) each, of the hypotheses from random minimal samples.

    Of a solver's candidates for a sample the one of highest score counts. A smaller number gives the first of the same
    samples. All are NaN where the pair has no ground truth or fewer than 16 inliers.
    """
    x1, x2 = matches.points1, matches.points2
    inliers = symmetric_epipolar_distance(x1, x2, matches.F_mat) < INLIER_THRESHOLD
    if int(inliers.sum()) < MIN_INLIERS:
        unknown = torch.full((number,), torch.nan, dtype=torch.float64)
        return unknown, unknown
    rows = minimal_samples(len(x1), NUMBERS[-1], seed)[:number]
    found = [_measure(solver, x1, x2, part[:, : solver.size], inliers) for part in torch.split(rows, BATCH_SIZE)]
    errors, scores = (torch.cat(parts) for parts in zip(*found, strict=True))
    return errors, scores


def _measure(solver: Solver, x1: Tensor, x2: Tensor, rows: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors and scores of samples (K, size)."""
    F_mat = solver.solve(x1[rows], x2[rows])
    h1, h2 = convert_points_to_homogeneous(x1), convert_points_to_homogeneous(x2)
    blocks = torch.split(F_mat.flatten(0, 1), max(1, BLOCK_SIZE // len(x1)))
    found = [_measure_block(block, h1, h2, inliers) for block in blocks]
    errors, scores = (torch.cat(parts).view(F_mat.shape[:2]) for parts in zip(*found, strict=True))
    picked = scores.argmax(-1, keepdim=True)
    return errors.gather(-1, picked)[:, 0], scores.gather(-1, picked)[:, 0]


def _measure_block(F_mat: Tensor, h1: Tensor, h2: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors and scores of matrices (K, 3, 3) on homogeneous points (N, 3)."""
    line2, line1 = F_mat @ h1.mT, F_mat.mT @ h2.mT
    residual = (h2.mT * line2).sum(-2).abs()
    normal1, normal2 = (line[:, :2].square().sum(-2) for line in (line1, line2))
    sampson = residual.square() / (normal1 + normal2)
    score = (1 - sampson / INLIER_THRESHOLD**2).clamp(min=0).nan_to_num(nan=0.0).sum(-1)
    symmetric = residual[:, inliers] * (normal1[:, inliers].rsqrt() + normal2[:, inliers].rsqrt())
    return symmetric.nan_to_num(nan=torch.inf).mean(-1).clamp(max=MAX_ERROR), score


def expected_best(errors: Tensor, number: int) -> Tensor:
    r"""Return the exact expectation of the smallest of :math:`k` of the errors (..., n) drawn without replacement.

    The :math:`i`-th smallest of :math:`n` errors is the smallest of :math:`k` with probability
    :math:`\binom{n - i}{k - 1} / \binom{n}{k}`. The expectation is an unbiased estimate for :math:`k` new samples
    (M. Chen et al., Evaluating Large Language Models Trained on Code, 2021, section 2.1).
    """
    total = errors.shape[-1]
    if not 1 <= number <= total:
        raise ValueError(f"number must be from 1 to {total}, the number of errors, got {number}")
    place = torch.arange(1, total, dtype=torch.float64)
    ratio = ((total - place - number + 1) / (total - place)).clamp(min=0)
    weight = torch.cat([ratio.new_ones(1), ratio.cumprod(-1)]) * number / total
    return (errors.sort(-1).values * weight.to(errors.dtype)).sum(-1)


def picked(errors: Tensor, scores: Tensor, number: int) -> Tensor:
    """Return the mean error of the hypotheses of highest score in disjoint groups of ``number`` samples.

    Errors and scores have shape (..., n); samples at the end that do not fill a group are left out.
    """
    groups = errors.shape[-1] // max(1, number)
    if number < 1 or groups < 1:
        raise ValueError(f"number must be from 1 to {errors.shape[-1]}, the number of errors, got {number}")
    errors, scores = (torch.unflatten(x[..., : groups * number], -1, (groups, number)) for x in (errors, scores))
    return errors.gather(-1, scores.argmax(-1, keepdim=True)).mean((-2, -1))

"""The matrices of RANSAC's minimal samples."""

import math

import torch
from torch import Tensor

from kornia_learnnorm.estimators.linear import solve_linear
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.two_view_model import TwoViewModel
from kornia_learnnorm.normalizers.normalizer import Normalizer
from kornia_learnnorm.ransac.scoring import PairScorer

MIN_SAMPLE_SHIFT = 0.01  # thresholds; a sample that a shift of a point by less makes degenerate is dropped


def solve_minimal_samples(
    scorer: PairScorer, rows: Tensor, linear: TwoViewModel, normalizer: Normalizer | None
) -> Tensor:
    """Return the matrices of the non-degenerate minimal samples (K, S); if there are none, that of all their matches.

    Matches on one line give no matrix. Samples for a normaliser, and all matches together, are solved by the DLT of the
    model ``linear``.
    """
    model, shift = scorer.model, MIN_SAMPLE_SHIFT * scorer.threshold
    x1, x2 = (x[:, rows].movedim(0, -1) for x in (scorer.x1, scorer.x2))
    if normalizer is None or rows.shape[1] < model.min_points:
        M = model.solve_samples(x1, x2, shift)
        if len(M) or model is not linear:
            return M
    else:
        determined = are_independent(torch.linalg.qr(model.rows(x1, x2).mT, mode="r")[1], x1, x2, shift)
        if bool(determined.any()):
            return _solve(scorer, rows[determined], linear, normalizer)
    rows = torch.unique(rows)[None]
    if rows.shape[1] < linear.min_points or any(spread_across(points) < shift for points in scorer.pixels):
        return x1.new_zeros(0, 3, 3)
    return _solve(scorer, rows, linear, normalizer)


def _solve(scorer: PairScorer, rows: Tensor, linear: TwoViewModel, normalizer: Normalizer | None) -> Tensor:
    points1, points2 = (points[rows] for points in scorer.pixels)
    return scorer.from_pixels(solve_linear(LinearProblem.from_points(points1, points2, None, linear), normalizer))


def are_independent(R: Tensor, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
    """Return a mask of the non-degenerate minimal samples (K, S, 3), by the R of their transposed design matrices.

    The constraints must be independent: each row of the design matrix is farther from the span of the rows before
    it than the least that a shift of the point, in pixels, moves it.
    """
    distance = R.diagonal(dim1=-2, dim2=-1).abs().amin(-1)
    return torch.gt(distance, shift * torch.minimum(x1[..., 2], x2[..., 2]).amin(-1))


def spread_across(points: Tensor) -> float:
    """Return the standard deviation of points (N, 2) across the direction in which they spread most, pixels."""
    return float(torch.linalg.svdvals(points - points.mean(0))[-1]) / math.sqrt(len(points))

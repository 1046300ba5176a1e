"""The matrices of RANSAC's minimal samples."""

import torch
from torch import Tensor

from kornia_learnnorm.estimators.linear import solve_linear
from kornia_learnnorm.geometry.minimal import are_independent
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.contract import TwoViewModel
from kornia_learnnorm.normalizers.normalizer import Normalizer
from kornia_learnnorm.ransac.scoring import PairScorer

MIN_SAMPLE_SHIFT = 0.01  # thresholds; a sample that a shift of a point by less makes degenerate is dropped


def solve_minimal_samples(
    scorer: PairScorer, rows: Tensor, linear: TwoViewModel, normalizer: Normalizer | None
) -> Tensor:
    """Return the matrices of the non-degenerate minimal samples (K, S), or of all where every one is degenerate.

    Matches on one line give none. Samples that a normaliser must see, and degenerate ones, are solved by the DLT of the
    model ``linear``.
    """
    model, shift = scorer.model, MIN_SAMPLE_SHIFT * scorer.threshold
    x1, x2 = scorer.samples(rows)
    if normalizer is None or model.sample_size < model.min_points:
        M = model.solve_samples(x1, x2, shift)
        if len(M) or model.sample_size < model.min_points:
            return M
        determined = torch.zeros_like(rows[:, 0], dtype=torch.bool)
    else:
        R = torch.linalg.qr(model.rows(x1, x2).mT, mode="r")[1]
        determined = are_independent(R, x1, x2, shift)
    if bool(determined.any()):
        rows = rows[determined]
    elif any(_on_a_line(points, shift) for points in scorer.pixels):
        return x1.new_zeros(0, 3, 3)
    points1, points2 = (points[rows] for points in scorer.pixels)
    problem = LinearProblem.from_points(points1, points2, None, linear)
    return scorer.from_pixels(solve_linear(problem, normalizer))


def _on_a_line(points: Tensor, shift: float) -> bool:
    """Return whether points (N, 2) are less than ``shift`` pixels from one line, in root mean square."""
    distance = torch.linalg.svdvals(points - points.mean(0))[1] / len(points) ** 0.5
    return bool(distance < shift)

"""Samples for the searches of the learned layers, drawn by weight from a low-discrepancy sequence."""

import torch
from torch import Tensor

from kornia_learnnorm.estimators.moments import Evidence
from kornia_learnnorm.geometry.dlt import null_space

MIN_PIVOT = 1e-6  # of the largest one; smaller in a degenerate minimal sample, such as one with a match twice
LARGE_SAMPLE = 20  # matches of a large sample, which averages their noise where there are few outliers
# Roots of x^(d + 1) = x + 1, by the size d of a sample.
EVEN_ROOTS = {4: 1.1673039782614187, 5: 1.1347241384015194, 7: 1.0969815577985598, 20: 1.034397396133807}


def sample_null_spaces(
    evidence: Evidence, weights: Tensor, order: Tensor, number: int, size: int
) -> tuple[Tensor, Tensor]:
    """Return the null spaces (B, S, 9 - size, 3, 3) of minimal samples, and which are not degenerate, (B, S) bool."""
    basis, pivots = null_space(_sample_rows(evidence, weights, order, number, size).mT)
    determined = pivots.amin(-1) > MIN_PIVOT * pivots.amax(-1)
    return torch.unflatten(basis.mT, -1, (3, 3)).mT, determined


def fit_samples(evidence: Evidence, weights: Tensor, order: Tensor, number: int) -> Tensor:
    """Return the least-squares matrices of samples of 20 matches, (B, S, 3, 3)."""
    rows = _sample_rows(evidence, weights, order, number, LARGE_SAMPLE)
    return torch.unflatten(torch.linalg.eigh(rows @ rows.mT)[1][..., 0], -1, (3, 3)).mT


def _sample_rows(evidence: Evidence, weights: Tensor, order: Tensor, number: int, size: int) -> Tensor:
    """Return the design rows of samples, (B, S, 9, size)."""
    drawn = draw_matches(weights, order, number, size)
    rows = evidence.rows.gather(2, drawn[:, None].expand(-1, 9, -1))
    return torch.unflatten(rows, 2, (number, size)).permute(0, 2, 1, 3)


def draw_matches(weights: Tensor, order: Tensor, number: int, size: int) -> Tensor:
    """Return the correspondences of samples drawn by weights, indices (B, number size), one sample after another.

    ``order`` (B, N) sorts the correspondences by their weights (B, N). Match j of sample k is drawn at the fractional
    part of :math:`k r^{-j}`, where :math:`r^{d + 1} = r + 1`, d = ``size``, spreads evenly (M. Roberts, 2018).
    """
    shares = weights.gather(1, order).cumsum(1)
    shares = shares / shares[:, -1:]
    steps = EVEN_ROOTS[size] ** -torch.arange(1, size + 1, dtype=shares.dtype, device=shares.device)
    chances = (torch.arange(1, number + 1, device=shares.device)[:, None] * steps).frac().flatten()
    ranks = torch.searchsorted(shares, chances + 0.0 * shares[:, :1]).clamp(max=shares.shape[1] - 1)
    return order.gather(1, ranks)


def evenly_ranked(order: Tensor, present: Tensor, most: int) -> Tensor:
    """Return at most ``most`` of the sorted correspondences (B, N), evenly spaced over the ranks of the present ones.

    ``present`` (B, N) is one for these, which come first, and zero for others, whose number has no effect.
    """
    few = min(order.shape[1], most)
    number = present.sum(1, keepdim=True, dtype=torch.int64).clamp(min=few)
    return order.gather(1, torch.arange(few, device=order.device) * number // few)

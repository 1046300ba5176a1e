"""Matrices of samples of correspondences, and which correspondences a sample takes."""

import numpy as np
import pytest
import torch
from scenes import uniform

from kornia_learnnorm.estimators.moments import Evidence, draw_matches, draw_samples, fit_samples

NUMBER = 5  # samples of each set


def drawn_rows(size):
    """Evidence of random points, what draws from it, and the rows that are drawn, in NumPy, (B, S, size, 9)."""
    x1, x2 = (torch.cat([uniform(2, 2, 40, seed=s), torch.ones(2, 1, 40)], 1) for s in (0, 1))
    weights = uniform(2, 40, seed=2)
    options = weights, weights.argsort(dim=1, descending=True, stable=True), NUMBER
    index = draw_matches(*options, size).view(2, NUMBER, size)
    rows = [
        np.einsum("knj,knl->knjl", *(x[b][:, index[b]].numpy().transpose(1, 2, 0) for x in (x1, x2))) for b in (0, 1)
    ]
    return Evidence.from_points(x1, x2), options, np.stack(rows).reshape(2, NUMBER, size, 9)


def test_large_samples_against_singular_vectors():
    evidence, options, rows = drawn_rows(20)
    found = fit_samples(evidence, *options).mT.flatten(2).numpy()  # x2^T F x1 of column-major rows
    expected = np.linalg.svd(rows)[2][:, :, -1]
    np.testing.assert_allclose(np.abs((found * expected).sum(-1)), 1.0, rtol=1e-9)


@pytest.mark.parametrize("size", [5, 7])
def test_matrices_of_minimal_samples_leave_no_residual(size):
    evidence, options, rows = drawn_rows(size)
    basis, determined = draw_samples(evidence, *options, size)
    residual = np.einsum("bsnk,bsdk->bsnd", rows, basis.mT.flatten(3).numpy())
    assert basis.shape == (2, NUMBER, 9 - size, 3, 3)
    assert np.abs(residual[determined.numpy()]).max() < 1e-9
    assert determined.double().mean() > 0.5


def test_heavier_correspondences_are_drawn_more_often():
    weights = torch.tensor([[1.0, 3.0, 0.0, 4.0]], dtype=torch.float64)
    drawn = draw_matches(weights, weights.argsort(dim=1, descending=True, stable=True), 2000, 7)
    np.testing.assert_allclose(np.bincount(drawn[0], minlength=4) / 14000, weights[0] / 8, atol=0.01)

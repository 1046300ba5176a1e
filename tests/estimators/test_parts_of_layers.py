"""The block of the learned layers' networks, and matrices of samples of correspondences."""

import numpy as np
import pytest
import torch
from pairwise import pairwise
from scenes import uniform

from kornia_learnnorm.estimators.moments import Evidence, geometric_scale
from kornia_learnnorm.estimators.set_network import MIN_VARIANCE, AttentiveContextBlock
from kornia_learnnorm.estimators.weighted_samples import draw_matches, evenly_ranked, fit_samples, sample_null_spaces

FEW, MANY = 6, 12  # correspondences, for a block of width 8: with many, statistics go into the weights
NUMBER = 5  # samples of each set


def reference(block: AttentiveContextBlock, hidden: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """The block on one set in NumPy, without what is absent."""
    weights = {name: value.detach().numpy() for name, value in block.named_parameters()}
    z = hidden - hidden.mean(-1, keepdims=True)
    z = z / np.sqrt((z**2).mean(-1, keepdims=True) + block.norm.eps) * weights["norm.weight"] + weights["norm.bias"]
    attention = np.where(absent, 0.0, np.exp(z @ weights["attention.weight"][0]))
    mean = attention @ z / attention.sum()
    deviation = np.sqrt(attention @ (z - mean) ** 2 / attention.sum() + MIN_VARIANCE)
    update = np.concatenate([z, (z - mean) / deviation], -1) @ weights["point.weight"].T + weights["point.bias"]
    update += z[~absent].max(0) @ weights["context.weight"].T
    return hidden + np.maximum(update, 0) @ weights["out.weight"].T + weights["out.bias"]


@pairwise(number=[FEW, MANY], masked=[False, True])
def test_block_against_numpy(number, masked):
    block, hidden = AttentiveContextBlock(8).double(), 10 * uniform(3, number, 8)
    absent = torch.arange(number).expand(3, -1) >= number - torch.arange(3)[:, None] * masked
    expected = [reference(block, h, a) for h, a in zip(hidden.numpy(), absent.numpy(), strict=True)]
    with torch.no_grad():
        np.testing.assert_allclose(block(hidden, absent if masked else None), expected, rtol=1e-9)
        block.point.__class__ = type("Adapted", (torch.nn.Linear,), {"forward": lambda self, x: 0 * x - 1e9})
        assert torch.allclose(block(hidden, absent if masked else None), hidden + block.out.bias)


@pytest.mark.parametrize("number", [FEW, MANY])
def test_sums_keep_their_precision_under_autocast(number):
    with torch.autocast("cpu", torch.bfloat16):
        assert AttentiveContextBlock(8)(uniform(2, number, 8).float(), None).dtype == torch.float32


def drawn_rows(size):
    """Evidence of random points, what draws from it, and the rows that are drawn, in NumPy, (B, S, size, 9)."""
    x1, x2 = (torch.cat([uniform(2, 2, 40, seed=s), torch.ones(2, 1, 40)], 1) for s in (0, 1))
    weights = uniform(2, 40, seed=2)
    options = weights, weights.argsort(dim=1, descending=True, stable=True), NUMBER
    index = draw_matches(*options, size).view(2, NUMBER, size)
    views = ([x[b][:, index[b]].numpy().transpose(1, 2, 0) for x in (x1, x2)] for b in (0, 1))
    rows = [np.einsum("knj,knl->knjl", *view) for view in views]
    return Evidence.from_points(x1, x2), options, np.stack(rows).reshape(2, NUMBER, size, 9)


def test_large_samples_against_singular_vectors():
    evidence, options, rows = drawn_rows(20)
    found = fit_samples(evidence, *options).mT.flatten(2).numpy()  # x2^T F x1 of column-major rows
    np.testing.assert_allclose(np.abs((found * np.linalg.svd(rows)[2][:, :, -1]).sum(-1)), 1.0, rtol=1e-9)


@pytest.mark.parametrize("size", [5, 7])
def test_matrices_of_minimal_samples_leave_no_residual(size):
    evidence, options, rows = drawn_rows(size)
    basis, determined = sample_null_spaces(evidence, *options, size)
    residual = np.einsum("bsnk,bsdk->bsnd", rows, basis.mT.flatten(3).numpy())
    assert basis.shape == (2, NUMBER, 9 - size, 3, 3)
    assert np.abs(residual[determined.numpy()]).max() < 1e-9
    assert determined.double().mean() > 0.5


def test_outliers_far_away_do_not_count_in_the_noise():
    squares = torch.cat([uniform(1, 1, 60), torch.full((1, 1, 40), 1e6)], 2)
    among_all, near = (geometric_scale(torch.ones(1, 100).double(), 5, 1e-9, near)(squares) for near in (None, 3.0))
    assert near < 2 * squares[..., :60].log().mean().exp() < among_all / 20


def test_heavier_correspondences_are_drawn_more_often():
    weights = torch.tensor([[1.0, 3.0, 0.0, 4.0]], dtype=torch.float64)
    drawn = draw_matches(weights, weights.argsort(dim=1, descending=True, stable=True), 2000, 7)
    np.testing.assert_allclose(np.bincount(drawn[0], minlength=4) / 14000, weights[0] / 8, atol=0.01)


@pytest.mark.parametrize("number", [20, 150])
def test_ranks_are_even_over_the_present(number):
    """However many rows are masked: all of few, and of many those that are chosen without a mask."""
    order, present = torch.arange(400).expand(2, -1), (torch.arange(400) < number).double().expand(2, -1)
    alone = evenly_ranked(order[:, :number], present[:, :number], 128)
    assert torch.equal(evenly_ranked(order, present, 128)[:, : alone.shape[1]], alone)

"""The block of the learned layers' networks."""

import numpy as np
import pytest
import torch
from scenes import uniform
from torch.autograd import gradcheck

from kornia_learnnorm.estimators.set_network import MIN_VARIANCE, AttentiveContextBlock

FEW, MANY = 6, 12  # correspondences, for a block of width 8: with many, statistics go into the weights


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


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("number", [FEW, MANY])
def test_block_against_numpy(number, masked):
    block, hidden = AttentiveContextBlock(8).double(), 10 * uniform(3, number, 8)
    absent = torch.arange(number).expand(3, -1) >= number - torch.arange(3)[:, None] * masked
    expected = [reference(block, h, a) for h, a in zip(hidden.numpy(), absent.numpy(), strict=True)]
    with torch.no_grad():
        np.testing.assert_allclose(block(hidden, absent if masked else None), expected, rtol=1e-9)


@pytest.mark.parametrize("number", [FEW, MANY])
def test_gradcheck(number):
    block = AttentiveContextBlock(8).double()
    assert gradcheck(lambda hidden: block(hidden, None), uniform(2, number, 8).requires_grad_())


@pytest.mark.parametrize("number", [FEW, MANY])
def test_sums_keep_their_precision_under_autocast(number):
    with torch.autocast("cpu", torch.bfloat16):
        assert AttentiveContextBlock(8)(uniform(2, number, 8).float(), None).dtype == torch.float32

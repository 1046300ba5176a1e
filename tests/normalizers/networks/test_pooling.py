"""The maximum over the points of a set."""

import pytest
import torch
from torch.nn.functional import layer_norm

from kornia_learnnorm.normalizers.networks.crossview import set_maximum


@pytest.fixture
def features():
    return torch.randn(3, 8, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture
def absent():
    """Five points of the first set and all of the second one."""
    return torch.tensor([3, 0, 8])[:, None, None] <= torch.arange(8)[:, None]


class TestSetMaximum:
    def test_leaves_out_absent_points(self, features, absent):
        found = set_maximum(features, absent, 1)
        assert torch.equal(found[0], features[0, :3].amax(0))
        assert torch.equal(found[1], torch.zeros(5).double())
        assert torch.equal(found[2], features[2].amax(0))

    def test_gradient_goes_to_one_of_equal_points(self):
        """That of `amax` would go to all of them, and is NaN where Inductor rounds the maximum alone."""
        features = torch.ones(2, 4, 3, requires_grad=True)
        (gradient,) = torch.autograd.grad(set_maximum(features, None, 1).sum(), features)
        assert (gradient.sort(1, descending=True).values == torch.tensor([1.0, 0, 0, 0])[:, None]).all()

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore")  # Inductor's own
    def test_gradient_of_compiled_bfloat16(self, features):
        features = features.bfloat16().requires_grad_()
        compiled = torch.compile(lambda h: set_maximum(layer_norm(h, (5,)), None, 1))
        (gradient,) = torch.autograd.grad(compiled(features).float().square().sum(), features)
        assert gradient.isfinite().all()

"""The maximum over the points of a set."""

import pytest
import torch
from torch.nn.functional import layer_norm

from kornia_learnnorm.normalizers.networks.pooling import set_maximum


@pytest.fixture
def features():
    return torch.randn(3, 8, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture
def absent():
    """Five points of the first set and all of the second one."""
    return torch.tensor([3, 0, 8])[:, None, None] <= torch.arange(8)[:, None]


class TestSetMaximum:
    @pytest.mark.parametrize(("dim", "keepdim"), [(0, False), (1, True)])
    def test_is_the_maximum(self, features, dim, keepdim):
        assert torch.equal(set_maximum(features, None, dim, keepdim), features.amax(dim, keepdim))
        with_gradient = set_maximum(features.requires_grad_(), None, dim, keepdim)
        assert torch.equal(with_gradient, features.amax(dim, keepdim))

    def test_leaves_out_absent_points(self, features, absent):
        found = set_maximum(features, absent, 1)
        assert torch.equal(found[0], features[0, :3].amax(0))
        assert torch.equal(found[1], torch.zeros(5).double())
        assert torch.equal(found[2], features[2].amax(0))

    def test_gradient(self, features, absent):
        assert torch.autograd.gradcheck(lambda h: set_maximum(h, absent, 1), features.requires_grad_())

    @pytest.mark.long
    @pytest.mark.filterwarnings("ignore")  # Inductor's own
    def test_gradient_of_compiled_bfloat16(self, features):
        features = features.bfloat16().requires_grad_()
        compiled = torch.compile(lambda h: set_maximum(layer_norm(h, (5,)), None, 1))
        (gradient,) = torch.autograd.grad(compiled(features).float().square().sum(), features)
        assert gradient.isfinite().all()

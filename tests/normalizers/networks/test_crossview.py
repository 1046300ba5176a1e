"""The cross-view network and its set network: what each depends on, and which answers are possible."""

from functools import partial

import numpy as np
import pytest
import torch
from scenes import numpy_whitening, prepared, shaken, uniform
from torch.autograd import gradcheck

from kornia_learnnorm import CrossViewNetwork, LearnedNormalizer
from kornia_learnnorm.normalizers.networks.crossview import ContextLayer, SetNetwork

whitened = partial(prepared, numpy_whitening)


def network(**options) -> CrossViewNetwork:
    """A small network in float64 whose answers are not zero."""
    return shaken(LearnedNormalizer(network=CrossViewNetwork(width=16, depth=2, **options))).network.double()


def set_network(outputs: int = 3) -> SetNetwork:
    net = SetNetwork(4, 6, width=16, depth=2, outputs=outputs).double()
    with torch.no_grad():
        net.head[-1].weight.normal_()
    return net


class TestSetNetwork:
    def test_weights_that_are_all_zero_are_finite(self):
        net, points = set_network(), uniform(3, 10, 4).requires_grad_()
        weights = torch.zeros(3, 10).double().requires_grad_()
        found = net(points, uniform(3, 6), weights)
        assert torch.isfinite(found).all()
        for gradient in torch.autograd.grad(found.sum(), [points, weights]):
            assert torch.isfinite(gradient).all()

    @pytest.mark.parametrize("weighted", [False, True])
    def test_parts_of_a_large_batch_change_nothing(self, weighted, monkeypatch):
        net, points, whole = set_network(), uniform(10, 8, 4), uniform(10, 6, seed=1)
        weights = uniform(10, 8, seed=2) if weighted else None
        expected = net(points, whole, weights).detach()
        monkeypatch.setattr("kornia_learnnorm.normalizers.networks.crossview.MAX_POINTS", 24)
        with torch.no_grad():
            torch.testing.assert_close(net(points, whole, weights), expected)

    def test_sums_of_residual_layers_keep_their_precision_under_autocast(self):
        with torch.autocast("cpu", torch.bfloat16):
            assert ContextLayer(16)(uniform(2, 8, 16).float(), None).dtype == torch.float32

    def test_gradcheck(self):
        net = set_network()
        values = [uniform(2, 5, 4), uniform(2, 6, seed=1), uniform(2, 5, low=0.1, seed=2)]
        assert gradcheck(net, [v.requires_grad_() for v in values])


class TestCrossViewNetwork:
    @pytest.mark.parametrize("bound", [0.5, 3.0])
    def test_answers_stay_within_the_bound(self, bound):
        net = CrossViewNetwork(width=8, depth=1, bound=bound).double()
        points1, points2 = whitened()
        for bias in (1e-4, 100.0):
            with torch.no_grad():
                net.set_network.head[-1].bias.fill_(bias)
            for params in net(points1, points2):
                np.testing.assert_allclose(params.detach().numpy(), bound * np.tanh(bias / bound), rtol=1e-12)

    @pytest.mark.parametrize(("features", "num_points"), [("epipolar", 8), ("epipolar", 11), ("both", 11), ("own", 8)])
    def test_gradcheck(self, num_points, features):
        net, points = network(features=features), [p.requires_grad_() for p in whitened("orbit", 1, num_points)]
        assert gradcheck(net, points, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


class TestFeatures:
    """What a view's answer depends on."""

    @pytest.mark.parametrize(("features", "sees"), [("own", False), ("both", True), ("epipolar", True)])
    @pytest.mark.parametrize("num_points", [8, 20])
    def test_the_other_view(self, features, sees, num_points):
        net, (points1, points2) = network(features=features), whitened("handheld", 6, num_points)
        params1, params2 = net(points1, points2)
        other = whitened("driving", 6, num_points, seed=1)[1]
        (found1, moved2), (moved1, found2) = net(points1, other), net(other, points2)
        for found, expected in [(found1, params1), (found2, params2)]:
            assert torch.allclose(found, expected, rtol=1e-12) is not sees
        for moved, before in [(moved1, params1), (moved2, params2)]:
            assert not torch.isclose(moved, before, atol=1e-4).all(-1).any()

    @pytest.mark.parametrize(("features", "sees"), [("own", False), ("both", True), ("epipolar", True)])
    def test_who_corresponds_to_whom(self, features, sees):
        net, (points1, points2) = network(features=features), whitened()
        for found, expected in zip(net(points1, points2.roll(1, 1)), net(points1, points2), strict=True):
            assert torch.allclose(found, expected, rtol=1e-10) is not sees

    @pytest.mark.parametrize("name", ["Own", None])
    def test_unknown(self, name):
        with pytest.raises(ValueError, match=f"features must be one of own, both, epipolar, got {name!r}"):
            CrossViewNetwork(features=name)

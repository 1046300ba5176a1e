"""Set networks: what they are blind to, what they see, and what they may answer."""

from __future__ import annotations

import copy
import inspect

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck
from two_view import correspondences, numpy_whitening, shaken, uniform

from kornia_learnnorm import CrossViewNetwork
from kornia_learnnorm.networks import SetNetwork


def whitened(name="handheld", batch_size=6, num_points=12, seed=0):
    """Correspondences in the coordinates that the network gets."""
    points = correspondences(name, batch_size, num_points, seed)
    T = [torch.from_numpy(numpy_whitening(p)) for p in points]
    return tuple(p @ t[:, :2, :2].mT + t[:, None, :2, 2] for p, t in zip(points, T, strict=True))


def network(**options) -> CrossViewNetwork:
    """A small network in float64 whose answers are not zero."""
    return shaken().network.double() if not options else CrossViewNetwork(**options)


def set_network(outputs: int = 3) -> SetNetwork:
    net = SetNetwork(4, 6, width=16, depth=2, outputs=outputs).double()
    with torch.no_grad():
        net.head[-1].weight.normal_()
    return net


class TestSetNetwork:
    @pytest.mark.parametrize("batch_size", [0, 1, 3])
    @pytest.mark.parametrize("num_points", [1, 8, 30])
    def test_smoke(self, batch_size, num_points, device, dtype):
        net = SetNetwork(4, 6, width=16, depth=3, outputs=5).to(device, dtype)
        points, whole = uniform(batch_size, num_points, 4), uniform(batch_size, 6)
        found = net(points.to(device, dtype), whole.to(device, dtype))
        assert found.shape == (batch_size, 5)
        assert found.dtype == dtype
        assert found.count_nonzero() == 0  # the last layer starts at zero

    def test_depth_and_width(self):
        net = SetNetwork(4, 6, width=16, depth=3, outputs=5)
        assert len(net.layers) == 3
        assert net.point_stem.weight.shape == (16, 4)
        assert net.set_stem.weight.shape == (16, 6)
        assert net.head[-1].weight.shape == (5, 16)

    def test_order_does_not_matter(self):
        net, points, whole = set_network(), uniform(3, 10, 4), uniform(3, 6, seed=1)
        order = torch.randperm(10)
        assert torch.allclose(net(points[:, order], whole), net(points, whole), rtol=1e-12)

    def test_zero_weight_is_absence(self):
        net, points, whole = set_network(), uniform(3, 10, 4), uniform(3, 6, seed=1)
        weights = uniform(3, 10, low=0.1, seed=2)
        junk, zeros = torch.full((3, 5, 4), 1e3).double(), torch.zeros(3, 5).double()
        extended = net(torch.cat([junk, points], 1), whole, torch.cat([zeros, weights], 1))
        assert torch.allclose(extended, net(points, whole, weights), rtol=1e-10)

    def test_equal_weights_are_none(self):
        net, points, whole = set_network(), uniform(3, 10, 4), uniform(3, 6, seed=1)
        assert torch.allclose(net(points, whole, torch.full((3, 10), 0.25).double()), net(points, whole), rtol=1e-12)

    def test_weights_that_are_all_zero_are_finite(self):
        net, points = set_network(), uniform(3, 10, 4).requires_grad_()
        weights = torch.zeros(3, 10).double().requires_grad_()
        found = net(points, uniform(3, 6), weights)
        assert torch.isfinite(found).all()
        for gradient in torch.autograd.grad(found.sum(), [points, weights]):
            assert torch.isfinite(gradient).all()

    def test_sees_points_set_and_their_number(self):
        net, points, whole = set_network(), uniform(1, 10, 4), uniform(1, 6, seed=1)
        expected = net(points, whole)
        assert not torch.allclose(net(points * 1.1, whole), expected)
        assert not torch.allclose(net(points, whole * 1.1), expected)
        assert not torch.allclose(net(points[:, :5], whole), expected)

    def test_gradcheck(self):
        net = set_network()
        values = [uniform(2, 5, 4), uniform(2, 6, seed=1), uniform(2, 5, low=0.1, seed=2)]
        assert gradcheck(net, [v.requires_grad_() for v in values])


class TestCrossViewNetwork:
    @pytest.mark.parametrize("batch_size", [0, 1, 3])
    @pytest.mark.parametrize("num_points", [8, 9, 30])
    @pytest.mark.parametrize("weighted", [False, True])
    @pytest.mark.parametrize("num_parameters", [3, 5])
    def test_untrained_answers_zero(self, batch_size, num_points, weighted, num_parameters, device, dtype):
        net = CrossViewNetwork(width=8, depth=1, num_parameters=num_parameters).to(device)
        points = [uniform(batch_size, num_points, 2, low=-1, seed=k).to(device, dtype) for k in (0, 1)]
        weights = uniform(batch_size, num_points, low=0.1).to(device, dtype) if weighted else None
        for params in net(*points, weights):
            assert params.shape == (batch_size, num_parameters)
            assert params.dtype == dtype
            assert params.count_nonzero() == 0

    @pytest.mark.parametrize("num_points", [8, 20])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_swapped_views_swap_the_answers(self, num_points, weighted):
        net, (points1, points2) = network(), whitened("driving", 10, num_points)
        weights = uniform(10, num_points, low=0.1) if weighted else None
        params1, params2 = net(points1, points2, weights)
        swapped2, swapped1 = net(points2, points1, weights)
        assert not torch.allclose(params1, params2, atol=1e-3)
        assert torch.allclose(swapped1, params1, atol=1e-8)
        assert torch.allclose(swapped2, params2, atol=1e-8)

    @given(st.integers(0, 2**31), st.sampled_from([8, 9, 20]), st.randoms())
    def test_order_does_not_matter(self, seed, num_points, random):
        net, (points1, points2) = network(), whitened("handheld", 3, num_points, seed)
        order = random.sample(range(num_points), num_points)
        for found, expected in zip(net(points1[:, order], points2[:, order]), net(points1, points2), strict=True):
            assert torch.allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize("num_points", [8, 9, 20])
    def test_zero_weight_is_absence(self, num_points):
        net, (points1, points2) = network(), whitened("handheld", 10, num_points)
        weights = uniform(10, num_points, low=0.5) if num_points > 8 else torch.ones(10, 8).double()
        junk1, junk2 = (uniform(10, 5, 2, low=-20, high=20, seed=seed) for seed in (1, 2))
        extended = [torch.cat(p, 1) for p in [(junk1, points1), (junk2, points2), (weights[:, :5] * 0, weights)]]
        for found, expected in zip(net(*extended), net(points1, points2, weights), strict=True):
            assert torch.allclose(found, expected, atol=1e-8)

    def test_whole_weights_are_repetitions(self):
        net, (points1, points2) = network(), whitened("handheld", 10, 9)
        counts = torch.tensor([1, 2, 3, 1, 2, 1, 1, 4, 1])
        repeated = [p.repeat_interleave(counts, 1) for p in (points1, points2)]
        weighted = net(points1, points2, counts.double().expand(10, -1))
        for found, expected in zip(weighted, net(*repeated), strict=True):
            assert torch.allclose(found, expected, atol=1e-8)

    @pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
    @pytest.mark.parametrize("num_points", [8, 12])
    def test_equal_weights_are_none(self, factor, num_points):
        net, (points1, points2) = network(), whitened("handheld", 10, num_points)
        weights = torch.full((10, num_points), factor).double()
        for found, expected in zip(net(points1, points2, weights), net(points1, points2), strict=True):
            assert torch.allclose(found, expected, atol=1e-8)

    @pytest.mark.parametrize("bound", [0.5, 3.0])
    def test_answers_stay_within_the_bound(self, bound):
        net = CrossViewNetwork(width=8, depth=1, bound=bound).double()
        points1, points2 = whitened()
        for bias in (1e-4, 100.0):
            with torch.no_grad():
                net.set_network.head[-1].bias.fill_(bias)
            for params in net(points1, points2):
                np.testing.assert_allclose(params.detach().numpy(), bound * np.tanh(bias / bound), rtol=1e-12)

    def test_size(self):
        net = CrossViewNetwork(width=24, depth=3, num_parameters=3)
        assert (net.width, net.depth, net.num_parameters, net.bound) == (24, 3, 3, 3.0)
        assert len(net.set_network.layers) == 3
        assert list(inspect.signature(CrossViewNetwork).parameters) == ["width", "depth", "num_parameters", "bound"]

    def test_computes_in_its_own_dtype(self):
        points = whitened()
        net = network()
        assert net.dtype == torch.float64
        double, single = net(*points), copy.deepcopy(net).float()(*points)
        for exact, rounded in zip(double, single, strict=True):
            assert rounded.dtype == torch.float64  # that of the points
            assert torch.allclose(rounded, exact, atol=1e-4)
            assert not torch.equal(rounded, exact)

    @pytest.mark.parametrize("num_points", [8, 11])
    def test_gradcheck(self, num_points):
        net, points = network(), [p.requires_grad_() for p in whitened("orbit", 1, num_points)]
        assert gradcheck(net, points, eps=1e-7, atol=1e-4, rtol=1e-3)

    def test_every_parameter_learns(self):
        net, (points1, points2) = network(), whitened()
        torch.cat(net(points1, points2)).square().sum().backward()
        for name, parameter in net.named_parameters():
            assert parameter.grad.count_nonzero() > 0, name

    def test_an_untrained_network_can_start_to_learn(self):
        net, (points1, points2) = CrossViewNetwork(width=8, depth=1), whitened()
        torch.cat(net(points1, points2)).sum().backward()
        assert net.set_network.head[-1].weight.grad.abs().sum() > 0
        assert all(torch.isfinite(parameter.grad).all() for parameter in net.parameters())

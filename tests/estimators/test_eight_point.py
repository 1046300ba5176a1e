"""The eight-point algorithm as a layer."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import nn
from two_view import correspondences, eight_point, numpy_whitening, shaken, uniform, up_to_sign

from kornia_learnnorm import EightPoint, Hartley, Identity, ReweightedWhitening, Whitening, find_fundamental


def halves(points1, points2, weights=None):
    """A normaliser that is a plain function."""
    T = torch.diag(torch.tensor([0.5, 0.5, 1.0])).to(points1).expand(len(points1), 3, 3)
    return T, T


class TestEightPoint:
    @pytest.mark.parametrize("batch_size", [0, 1, 4])
    @pytest.mark.parametrize("num_points", [8, 20])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_smoke(self, batch_size, num_points, weighted, device, dtype):
        points = [uniform(batch_size, num_points, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
        weights = uniform(batch_size, num_points).to(device, dtype) if weighted else None
        F_mat = EightPoint().to(device)(*points, weights)
        assert F_mat.shape == (batch_size, 3, 3)
        assert F_mat.dtype == dtype
        assert F_mat.device.type == device.type

    def test_agrees_with_numpy(self):
        points, weights = correspondences("handheld", 10, 20), uniform(10, 20, low=0.1)
        expected = eight_point(*points, *(numpy_whitening(p, weights) for p in points), weights)
        assert up_to_sign(EightPoint(Whitening())(*points, weights), expected) < 1e-9

    @pytest.mark.parametrize(
        "normalizer", [Identity(), Hartley(), Whitening(), ReweightedWhitening(), shaken(), halves]
    )
    def test_is_find_fundamental(self, normalizer):
        points, weights = correspondences("driving", 5, 12), uniform(5, 12)
        assert torch.equal(EightPoint(normalizer)(*points), find_fundamental(*points, normalizer=normalizer))
        assert torch.equal(EightPoint(normalizer)(*points, weights), find_fundamental(*points, weights, normalizer))

    def test_rank2_is_that_of_the_function(self):
        points, weights = correspondences("driving", 5, 12), uniform(5, 12)
        expected = find_fundamental(*points, weights, Whitening(), "optimal")
        assert torch.equal(EightPoint(Whitening(), "optimal")(*points, weights), expected)
        assert not torch.equal(expected, find_fundamental(*points, weights, Whitening()))

    def test_default_is_hartley(self):
        points = correspondences()
        assert isinstance(EightPoint().normalizer, Hartley)
        assert torch.equal(EightPoint()(*points), find_fundamental(*points))

    def test_owns_its_normalizer(self):
        normalizer = shaken()
        layer = EightPoint(normalizer)
        assert [id(p) for p in layer.parameters()] == [id(p) for p in normalizer.parameters()]
        assert all(key.startswith("normalizer.") for key in layer.state_dict())
        assert not layer.train(False).normalizer.training
        assert not list(EightPoint(halves).parameters())

    def test_round_trips(self):
        layer, points = EightPoint(shaken()), correspondences()
        other = EightPoint(shaken(seed=1))
        assert not torch.equal(other(*points), layer(*points))
        other.load_state_dict(layer.state_dict())
        for again in (other, copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
            assert torch.equal(again(*points), layer(*points))

    def test_in_a_model(self):
        """Between a module that moves the points and a loss; everything learns."""

        class Model(nn.Module):
            def __init__(self):
                super().__init__()
                self.move, self.layer = nn.Linear(2, 2), EightPoint(shaken())

            def forward(self, points1, points2):
                return self.layer(self.move(points1), self.move(points2), torch.sigmoid(points1[..., 0]))

        model, (points1, points2) = Model(), (p.float() for p in correspondences("handheld", 4, 12))
        model(points1, points2).square()[:, 0, 0].sum().backward()
        for parameter in model.parameters():
            assert torch.isfinite(parameter.grad).all()
            assert parameter.grad.count_nonzero() > 0

    def test_errors_are_those_of_the_function(self):
        with pytest.raises(ValueError, match="at least 8 correspondences are needed, got 7"):
            EightPoint()(torch.rand(2, 7, 2), torch.rand(2, 7, 2))


@pytest.mark.parametrize(
    ("normalizer", "error", "message"),
    [
        (Hartley, TypeError, "normalizer must be a module or function, got <class"),
        ("hartley", TypeError, "normalizer must be a module or function, got 'hartley'"),
        (lambda *_: (torch.eye(3), torch.eye(3)), ValueError, r"two transforms of shape \(2, 3, 3\), got \[\(3, 3\)"),
        (lambda *_: torch.zeros(2, 3, 3), ValueError, r"two transforms of shape \(2, 3, 3\), got .*Tensor"),
        (lambda *_: (torch.full((2, 3, 3), torch.nan),) * 2, ValueError, "the transforms of function are not finite"),
    ],
)
def test_a_normaliser_that_breaks_the_contract(normalizer, error, message):
    with pytest.raises(error, match=message):
        EightPoint(normalizer)(torch.rand(2, 8, 2), torch.rand(2, 8, 2))

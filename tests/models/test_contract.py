"""Swapped views and the optimiser of the contract, beside what the tests of layers and RANSAC have."""

import pytest
import torch
from scenes import corner_error, correspondences, plane, uniform, up_to_sign

from kornia_learnnorm import GemanMcClure
from kornia_learnnorm.estimators.linear import LinearLayer
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.homography import Homography


@pytest.mark.parametrize("model", [Homography(), Fundamental()], ids=["homography", "fundamental"])
def test_swap(model):
    points = plane(noise=0.2)[:2] if model.name == "homography" else correspondences("handheld", 3, 40)
    layer = LinearLayer(model)
    largest = 2e-2 if model.name == "homography" else 1e-9  # its algebraic errors are those of view 2 alone
    assert up_to_sign(unit_matrix(model.swap(layer(*points))), layer(*reversed(points))) < largest
    assert up_to_sign(unit_matrix(model.swap(model.swap(layer(*points)))), layer(*points)) < 1e-9


def test_minimizer():
    points1, points2, H = plane(noise=0.5, outliers=0.2)
    x1, x2 = (torch.cat([p / 300, torch.ones_like(p[..., :1])], -1).mT for p in (points1, points2))
    T = torch.diag(torch.tensor([300.0, 300, 1], dtype=torch.float64))
    model = Homography()
    start = model.carry(H, T, T) + 0.01 * uniform(3, 3, 3, low=-1)
    cost = RobustCost(model, x1, x2, torch.ones_like(x1[:, 0]), GemanMcClure(0.01))
    before, best = minimize(cost, model.state(start), 100, 1e-6)
    assert best.converged.all()
    assert (best.cost < before).all()
    assert corner_error(model.carry(best.state.matrix(), T.inverse(), T.inverse()), H) < 2

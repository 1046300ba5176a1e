"""Homographies, which have two rows a point, run through everything that is written once, against the contract."""

from __future__ import annotations

import pytest
import torch
from scenes import corner_error, correspondences, plane, uniform, up_to_sign

from kornia_learnnorm import RANSAC, GemanMcClure, LearnedEightPoint, Whitening
from kornia_learnnorm.estimators.learned import LearnedLayer
from kornia_learnnorm.estimators.linear import LinearLayer
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.homography import Homography


@pytest.mark.parametrize("number", [4, 5, 40])
@pytest.mark.parametrize("normalizer", [None, Whitening()])
def test_linear_layer(number, normalizer):
    points1, points2, H = plane(number=number)
    layer = LinearLayer(Homography(), normalizer)
    assert corner_error(layer(points1, points2), H) < 1e-6
    weights = uniform(3, number, low=0.1)
    assert corner_error(layer(points1, points2, weights), H) < 1e-6
    line = points1[:, :1] * torch.linspace(0, 1, number, dtype=torch.float64)[:, None]
    line.requires_grad_()
    layer(line, line).sum().backward()
    assert line.grad.isfinite().all()


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


@pytest.mark.parametrize("number", [4, 40])
def test_learned_layer(number):
    points1, points2, H = plane(number=number)
    points2.requires_grad_()
    layer = LearnedLayer(Homography(), width=8, depth=1, stages=2, learn_transforms=True, refine_steps=3)
    M = layer(points1, points2)
    assert corner_error(M.detach(), H) < 1e-4
    M.sum().backward()
    assert points2.grad.isfinite().all()


@pytest.mark.parametrize("normalizer", [None, Whitening()])
def test_ransac(normalizer):
    points1, points2, H = plane(1, 200, noise=0.3, outliers=0.6)
    result = RANSAC(normalizer, model="homography", seed=0).estimate(points1[0], points2[0])
    assert result.inliers[120:].float().mean() > 0.95
    assert result.inliers[:120].sum() <= 3
    assert corner_error(result.F_mat[None], H) < 1


def test_files_name_the_model(tmp_path):
    layer = LearnedLayer(Homography(), width=8, depth=1, stages=1, learn_transforms=True, refine_steps=0)
    layer.save_pretrained(tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"homography.*fundamental"):
        LearnedEightPoint.from_pretrained(tmp_path / "other.safetensors")

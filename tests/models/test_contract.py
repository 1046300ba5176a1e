"""A third model of a few lines runs through everything that is written once, against the contract."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from scenes import correspondences, uniform, up_to_sign
from torch.nn.functional import normalize, one_hot

from kornia_learnnorm import RANSAC, GemanMcClure, LearnedEightPoint, Whitening
from kornia_learnnorm.estimators.learned import LearnedLayer
from kornia_learnnorm.estimators.linear import LinearLayer
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.contract import TwoViewModel
from kornia_learnnorm.models.fundamental import Fundamental


class UnitMatrix(NamedTuple):
    """Any matrix of unit norm: steps are orthogonal to it."""

    M: torch.Tensor

    def matrix(self):
        return self.M

    def tangents(self):
        m = self.M.mT.flatten(1)  # column-major; a Householder reflection moves the first unit vector to m or -m
        sign = torch.where(m[:, :1] < 0, -1.0, 1.0)
        v = normalize(m + sign * one_hot(torch.zeros(1, dtype=torch.int64), 9).to(m), dim=-1)[..., None]
        return (torch.eye(9).to(m) - 2 * v @ v.mT)[..., 1:]

    def retract(self, step):
        moved = self.M.mT.flatten(1) + (self.tangents() @ step[..., None])[..., 0]
        return UnitMatrix(torch.unflatten(normalize(moved, dim=-1), -1, (3, 3)).mT)


class ToyHomography(TwoViewModel):
    """Homographies with their error in view 2: two rows and two residuals a point, no constraint."""

    name, min_points, dof, sample_size, components = "toy", 4, 8, 4, 2
    preferred = (3**-0.5, 0.0, 0.0, 0.0, 3**-0.5, 0.0, 0.0, 0.0, 3**-0.5)

    def rows(self, x1, x2):
        zero, (u, v, w) = torch.zeros_like(x1), x2[..., None].unbind(-2)
        first, second = torch.cat([-w * x1, zero, u * x1], -1), torch.cat([zero, -w * x1, v * x1], -1)
        return torch.stack([first, second], 2).flatten(1, 2)

    def row_weights(self, weights):
        return weights.repeat_interleave(2, -1)

    def carry(self, M, T1, T2):
        return torch.linalg.solve(T2, M @ T1)

    def swap(self, M):
        return torch.linalg.inv(M)

    def constrain(self, M):
        return M

    def linearise(self, M, x1, x2, weights=None):
        moved = M @ x1
        depth = moved[:, 2:] / x2[:, 2:]
        depth = torch.where(depth.abs() < 1e-9, 1e-9, depth)
        offset, ray = moved[:, :2] / depth - x2[:, :2], x1 / depth  # d(offset) = (dM x1)_{1:2} / d - (dM x1)_3 m / d
        zero = torch.zeros_like(ray)
        image = (moved[:, :2] / moved[:, 2:])[:, None]
        rows = ([ray, zero, -ray * image[:, :, 0]], [zero, ray, -ray * image[:, :, 1]])
        return offset.flatten(1), torch.cat([torch.stack(row, 2).flatten(1, 2) for row in rows], -1)

    def state(self, M):
        return UnitMatrix(M / torch.linalg.matrix_norm(M, keepdim=True))


def plane(batch_size: int = 3, number: int = 40, noise: float = 0.0, outliers: float = 0.0):
    """Points of a plane in two views, and its homographies of unit norm with a positive first entry."""
    H = torch.eye(3, dtype=torch.float64) + 0.1 * uniform(batch_size, 3, 3, low=-1, seed=1)
    H[:, :2, 2], H[:, 2, :2] = 30 * H[:, :2, 2], 1e-4 * H[:, 2, :2]
    points1 = uniform(batch_size, number, 2, high=600)
    moved = torch.cat([points1, torch.ones_like(points1[..., :1])], -1) @ H.mT
    points2 = moved[..., :2] / moved[..., 2:] + noise * uniform(batch_size, number, 2, low=-1, seed=2)
    wrong = int(outliers * number)
    points2[:, :wrong] = uniform(batch_size, wrong, 2, high=600, seed=3)
    return points1, points2, H / torch.linalg.matrix_norm(H, keepdim=True)


def corner_error(M, H):
    corners = torch.tensor([[0.0, 0, 1], [600, 0, 1], [600, 600, 1], [0, 600, 1]], dtype=torch.float64).mT
    a, b = (X @ corners for X in (M, H))
    return float((a[..., :2, :] / a[..., 2:, :] - b[..., :2, :] / b[..., 2:, :]).norm(dim=-2).max())


@pytest.mark.parametrize("number", [4, 5, 40])
@pytest.mark.parametrize("normalizer", [None, Whitening()])
def test_linear_layer(number, normalizer):
    points1, points2, H = plane(number=number)
    layer = LinearLayer(ToyHomography(), normalizer)
    assert corner_error(layer(points1, points2), H) < 1e-6
    weights = uniform(3, number, low=0.1)
    assert corner_error(layer(points1, points2, weights), H) < 1e-6
    line = points1[:, :1] * torch.linspace(0, 1, number, dtype=torch.float64)[:, None]
    line.requires_grad_()
    layer(line, line).sum().backward()
    assert line.grad.isfinite().all()


@pytest.mark.parametrize("model", [ToyHomography(), Fundamental()], ids=["toy", "fundamental"])
def test_swap(model):
    points = plane(noise=0.2)[:2] if model.name == "toy" else correspondences("handheld", 3, 40)
    layer = LinearLayer(model)
    largest = 2e-2 if model.name == "toy" else 1e-9  # the toy measures errors in view 2 alone
    assert up_to_sign(unit_matrix(model.swap(layer(*points))), layer(*reversed(points))) < largest
    assert up_to_sign(unit_matrix(model.swap(model.swap(layer(*points)))), layer(*points)) < 1e-9


def test_minimizer():
    points1, points2, H = plane(noise=0.5, outliers=0.2)
    x1, x2 = (torch.cat([p / 300, torch.ones_like(p[..., :1])], -1).mT for p in (points1, points2))
    T = torch.diag(torch.tensor([300.0, 300, 1], dtype=torch.float64))
    model = ToyHomography()
    start = model.carry(H, T, T) + 0.01 * uniform(3, 3, 3, low=-1)
    cost = RobustCost(model, x1, x2, torch.ones_like(x1[:, 0]), GemanMcClure(0.01))
    before, best = minimize(cost, model.state(start), 100, 1e-7)
    assert best.converged.all()
    assert (best.cost < before).all()
    assert corner_error(model.carry(best.state.matrix(), T.inverse(), T.inverse()), H) < 2


@pytest.mark.parametrize("number", [4, 40])
def test_learned_layer(number):
    points1, points2, H = plane(number=number)
    points2.requires_grad_()
    layer = LearnedLayer(ToyHomography(), width=8, depth=1, stages=2, learn_transforms=True, refine_steps=3)
    M = layer(points1, points2)
    assert corner_error(M.detach(), H) < 1e-4
    M.sum().backward()
    assert points2.grad.isfinite().all()


@pytest.mark.parametrize("normalizer", [None, Whitening()])
def test_ransac(normalizer):
    points1, points2, H = plane(1, 200, noise=0.3, outliers=0.6)
    result = RANSAC(normalizer, model=ToyHomography(), seed=0).estimate(points1[0], points2[0])
    assert result.inliers[120:].float().mean() > 0.95
    assert result.inliers[:120].sum() <= 3
    assert corner_error(result.F_mat[None], H) < 1


def test_files_name_the_model(tmp_path):
    layer = LearnedLayer(ToyHomography(), width=8, depth=1, stages=1, learn_transforms=True, refine_steps=0)
    layer.save_pretrained(tmp_path / "toy.safetensors")
    with pytest.raises(ValueError, match=r"toy.*fundamental"):
        LearnedEightPoint.from_pretrained(tmp_path / "toy.safetensors")

"""A model of your own runs through all that is written for models: the fundamental matrix of affine cameras."""

from typing import NamedTuple

import pytest
import torch
from scenes import uniform
from torch.nn.functional import normalize

from kornia_learnnorm import RANSAC, GemanMcClure, sampson_distance
from kornia_learnnorm.estimators.learned_layer import LearnedLayer
from kornia_learnnorm.estimators.linear import LinearLayer
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.two_view_model import TwoViewModel

ENTRIES = torch.eye(9, dtype=torch.float64)[[2, 5, 6, 7, 8]]  # that are not zero, row by row and column by column


class UnitEntries(NamedTuple):
    """Matrices of unit norm by their five entries."""

    entries: torch.Tensor  # column by column, (B, 5)

    def matrix(self):
        return torch.unflatten(self.entries @ ENTRIES, -1, (3, 3)).mT

    def tangents(self):
        first = torch.eye(5).to(self.entries)[0]  # a Householder reflection moves it to the entries, or minus them
        v = normalize(self.entries + first.copysign(self.entries) * first, dim=-1)[..., None]
        return ENTRIES.T @ (torch.eye(5).to(v) - 2 * v @ v.mT)[..., 1:]

    def retract(self, step):
        return UnitEntries(normalize(self.entries + (ENTRIES @ self.tangents() @ step[..., None])[..., 0], dim=-1))


class AffineFundamental(TwoViewModel):
    """R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, section 14.2."""

    name, min_points, dof, sample_size, preferred = "affine", 4, 4, 4, Fundamental.preferred

    def rows(self, x1, x2):
        return design_matrix(x1, x2)

    def null_vector(self, x1, x2, weights):
        rows = self.rows(x1, x2) @ ENTRIES.T  # four columns of nine are not the matrix's
        _, values, Vh = torch.linalg.svd(rows if weights is None else rows * weights.sqrt()[..., None])
        return Vh[:, -1] @ ENTRIES, values[:, 3] / values[:, 0]

    def carry(self, M, T1, T2):
        return T2.mT @ M @ T1

    def swap(self, M):
        return M.mT

    def constrain(self, M):
        return M * ENTRIES.sum(0).view(3, 3)

    def linearise(self, M, x1, x2, weights=None):
        return Fundamental().linearise(M, x1, x2, weights)

    def state(self, M):
        return UnitEntries(normalize(M.mT.flatten(1) @ ENTRIES.T, dim=-1))


def scene(number=40, outliers=0.0, batch_size=3, noise=0.0):
    """Matches of affine cameras, the last ones false and the others noisy; and the same without noise."""
    cameras, space = uniform(2, batch_size, 4, 2, low=-1), uniform(batch_size, number, 3, seed=1)
    true = 300 * (torch.cat([space, torch.ones_like(space[..., :1])], -1) @ cameras)
    points = true + noise * uniform(*true.shape, low=-1, seed=2)
    wrong = int(outliers * number)
    points[:, :, number - wrong :] = uniform(2, batch_size, wrong, 2, high=600, seed=3)
    return points, true


@pytest.mark.parametrize("number", [4, 5, 40])
@pytest.mark.parametrize(
    "make", [LinearLayer, lambda model: LearnedLayer(model, 8, 1, 2, 3, 0)], ids=["linear", "learned"]
)
def test_layers(make, number):
    points, true = scene(number)
    M = make(AffineFundamental())(*points.requires_grad_(), uniform(3, number, low=0.5))
    assert sampson_distance(*true, M).max() < 1e-5
    (gradient,) = torch.autograd.grad(M.sum(), points)
    assert gradient.isfinite().all()


def test_optimiser():
    points, true = scene(outliers=0.3, noise=0.5)
    x1, x2 = (torch.cat([view, torch.ones_like(view[..., :1])], -1).mT for view in points)
    model, loss = AffineFundamental(), GemanMcClure(3.0)
    start = LinearLayer(model)(*scene(noise=9.0)[0])
    before, best = minimize(RobustCost(model, x1, x2, torch.ones_like(x1[:, 0]), loss), model.state(start), 100, 1e-7)
    assert (best.cost < before).all()
    assert sampson_distance(*true, best.state.matrix()).max() < 1


def test_ransac():
    points, true = scene(200, outliers=0.6, noise=0.3, batch_size=1)
    found = RANSAC(model=AffineFundamental(), seed=0).estimate(*points[:, 0])
    assert found.inliers[:80].float().mean() > 0.95
    assert sampson_distance(*true, found.F_mat[None]).max() < 1

"""Steps on the manifolds against what they must keep, and tangents against central differences."""

import numpy as np
import pytest
import torch
from scenes import corner_error, correspondences, plane, uniform, up_to_sign

from kornia_learnnorm import GemanMcClure
from kornia_learnnorm.estimators.linear import LinearLayer
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.essential import Essential, nearest_essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.homography import Homography


def states(kind: str, batch_size: int = 4):
    matrices = [uniform(batch_size, 3, 3, low=-1, seed=k) for k in range(3)]
    if kind == "calibrated":
        return Essential(*matrices[1:]).calibrated(matrices[0])
    return (Fundamental() if kind == "rank 2" else Homography()).state(matrices[0])


@pytest.mark.parametrize(("kind", "size"), [("rank 2", 7), ("calibrated", 5), ("any rank", 8)])
class TestManifold:
    def test_tangents(self, kind, size):
        state = states(kind)
        D = state.tangents()
        assert D.shape == (4, 9, size)
        for k in range(size):
            step = torch.zeros(4, size, dtype=torch.float64)
            step[:, k] = 1e-6
            slope = (state.retract(step).matrix() - state.retract(-step).matrix()) / 2e-6
            np.testing.assert_allclose(D[..., k], slope.mT.flatten(1), atol=1e-8)
        assert (torch.linalg.matrix_rank(D) == size).all()

    def test_steps_stay_on_the_manifold(self, kind, size):
        state = states(kind).retract(uniform(4, size, low=-1, seed=5))
        matrix = state.essential() if kind == "calibrated" else state.matrix()
        values = torch.linalg.svdvals(matrix)
        assert torch.allclose(values.norm(dim=-1), torch.ones(4, dtype=torch.float64))
        assert kind == "any rank" or (values[:, 2] < 1e-14).all()
        if kind == "calibrated":
            assert torch.allclose(values[:, 0], values[:, 1])


def test_calibrated():
    E, C1, C2 = (uniform(4, 3, 3, low=-1, seed=k) for k in range(3))
    state = Essential(C1, C2).calibrated(E)
    U, _, Vh = np.linalg.svd(E.numpy())
    nearest = U[..., :2] @ Vh[..., :2, :] / 2**0.5
    np.testing.assert_allclose(state.essential(), nearest, atol=1e-14)
    np.testing.assert_allclose(nearest_essential(E), nearest, atol=1e-14)
    F = C2.numpy().swapaxes(1, 2) @ nearest @ C1.numpy()
    scale = np.linalg.norm(C1, axis=(1, 2)) * np.linalg.norm(C2, axis=(1, 2))
    np.testing.assert_allclose(state.matrix(), F / scale[:, None, None], atol=1e-14)


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

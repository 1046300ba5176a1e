"""Losses against hand computation."""

import math

import numpy as np
import pytest
import torch
from pairwise import pairwise
from references import epipolar_distances
from scenes import ORIGIN, ROWS, raises, scenes, uniform
from torch.autograd import gradcheck

import kornia_learnnorm as kln
from kornia_learnnorm import BoundedEpipolarLoss, EpipolarLoss, LogEpipolarLoss


def rows(*differences, dtype=torch.float32):
    """Correspondences whose symmetric distances are twice the given numbers, ``(B, N)``."""
    y = torch.tensor(differences, dtype=dtype)
    points1 = torch.stack([torch.arange(y.numel(), dtype=dtype).view_as(y), torch.zeros_like(y)], -1)
    return points1, points1 + torch.stack([7 * torch.ones_like(y), y], -1), ROWS.to(dtype).expand(len(y), 3, 3)


class TestEpipolarLoss:
    def test_mean(self, dtype, device):
        values = [v.to(device) for v in rows([1.0, 2.0], [3.0, 0.0], dtype=dtype)]
        loss = EpipolarLoss(log=False)(*values)
        assert (loss.shape, loss.dtype) == ((), dtype)
        assert loss.item() == pytest.approx((3 + 3) / 2)  # distances 2, 4 and 6, 0

    @pairwise(share=[0.0, 0.25, 1.0], log=[False, True])
    def test_log_and_heldout_part(self, share, log):
        assert EpipolarLoss()(*rows([0.0] * 8)).item() == pytest.approx(math.log(1e-3))  # the default floor
        points1, points2, F_mat = rows([1.0, 2.0], [4.0, 0.0], dtype=torch.float64)
        heldout1, heldout2, _ = rows([5.0, 0.5, 0.0], [1.0, 1.0, 2.0], dtype=torch.float64)
        loss = EpipolarLoss(log=log, heldout_weight=share, floor=0.01, heldout_floor=0.2)
        if log:  # of samples' means, but of each held-out distance
            own = (math.log(3.01) + math.log(4.01)) / 2
            rest = sum(math.log(d + 0.2) for d in (10, 1, 0, 2, 2, 4)) / 6
        else:
            own, rest = (3 + 4) / 2, (10 + 1 + 0 + 2 + 2 + 4) / 6
        found = loss(points1, points2, F_mat, heldout1, heldout2)
        assert found.item() == pytest.approx((1 - share) * own + share * rest)

    @pytest.mark.parametrize("residual", [None, kln.sampson_distance, kln.algebraic_distance])
    def test_residuals(self, residual):
        """By default those of equation 7."""
        scene, options = scenes("handheld", 5, 10), {} if residual is None else {"residual": residual}
        values = scene.points1, scene.points2, scene.F_mat
        expected = (residual or epipolar_distances)(*values).mean().item()
        assert EpipolarLoss(**options, log=False)(*values).item() == pytest.approx(expected)

    @pairwise(log=[False, True], where=["own", "heldout"])
    def test_infinite_residual_counts_as_the_ceiling_and_sends_no_gradient(self, log, where):
        # x2^T F x1 = v x - u y; a point at the origin is on the epipole.
        F_mat, points2 = ORIGIN[None].double().requires_grad_(), torch.tensor([[[3.0, 4.0], [2.0, 1.0]]]).double()
        whole = torch.tensor([[[1.0, 2.0], [1.0, 2.0]]]).double().requires_grad_()
        epipole = torch.tensor([[[0.0, 0.0], [1.0, 2.0]]]).double().requires_grad_()
        points1, heldout1 = (epipole, whole) if where == "own" else (whole, epipole)
        options = {"log": log, "heldout_weight": 0.5, "floor": 1.0, "heldout_floor": 2.0, "ceiling": 50.0}
        loss = EpipolarLoss(**options)(points1, points2, F_mat, heldout1, points2)
        # Distances: |4 - 6| (1 / 5 + 1 / 5 ** 0.5) or infinite, and |1 - 4| 2 / 5 ** 0.5.
        a, b = 2 / 5 + 2 / 5**0.5, 6 / 5**0.5
        own, rest = ((50, b), (a, b)) if where == "own" else ((a, b), (50, b))
        if log:
            expected = (math.log(np.mean(own) + 1) + np.mean(np.log(np.array(rest) + 2))) / 2
        else:
            expected = (np.mean(own) + np.mean(rest)) / 2
        assert loss.item() == pytest.approx(expected)
        gradients = torch.autograd.grad(loss, [F_mat, whole, epipole])
        assert all(torch.isfinite(gradient).all() for gradient in gradients)
        assert gradients[2][0, 0].count_nonzero() == 0
        assert gradients[2][0, 1].count_nonzero() > 0

    @pytest.mark.parametrize("step", [0.0, 1e-30, 1e-22, 1e-20, 1e-15, 1e-10])
    def test_gradients_are_finite_next_to_the_epipole(self, step, dtype):
        F_mat = ORIGIN[None].to(dtype, copy=True).requires_grad_()
        points1 = torch.tensor([[[step, 0.0], [1.0, 2.0]]], dtype=dtype).requires_grad_()
        loss = EpipolarLoss()(points1, torch.tensor([[[3.0, 4.0], [2.0, 1.0]]], dtype=dtype), F_mat)
        for value in (loss, *torch.autograd.grad(loss, [F_mat, points1])):
            assert torch.isfinite(value).all()

    @pairwise(log=[False, True], heldout_weight=[0.0, 0.5])
    def test_gradcheck(self, log, heldout_weight):
        points = [uniform(2, 5, 2, low=-1, seed=k).requires_grad_() for k in range(4)]
        loss = EpipolarLoss(log=log, heldout_weight=heldout_weight)
        F_mat = uniform(2, 3, 3, low=-1, seed=4).requires_grad_()
        points = points if heldout_weight else points[:2]
        assert gradcheck(lambda F_mat, a, b, *rest: loss(a, b, F_mat, *rest), [F_mat, *points])

    def test_exceptions(self):
        for name, value in [
            *(("heldout_weight", value) for value in (-0.1, 1.1, math.nan)),
            *((name, value) for name in ("floor", "heldout_floor", "ceiling") for value in (0.0, -1.0, math.nan)),
        ]:
            raises(ValueError, f"must be .* got .*{value}", EpipolarLoss, **{name: value})
        *points, F_mat = rows([1.0, 2.0], [3.0, 0.0])
        raises(TypeError, "points1 .* got torch.float16", LogEpipolarLoss(), points[0].half(), points[1], F_mat)
        raises(ValueError, "one matrix per set", EpipolarLoss(), *points, F_mat[:1])
        raises(ValueError, "needs a correspondence, got none", EpipolarLoss(), *(p[:, :0] for p in points), F_mat)
        raises(ValueError, r"F_mat .*\(B, 3, 3\), got \[2, 1, 3, 3\]", EpipolarLoss(), *points, F_mat[:, None])

    @pytest.mark.parametrize("heldout", [(), (None, None), (torch.zeros(1, 3, 2), None), (torch.zeros(1, 0, 2),) * 2])
    def test_heldout_points_are_needed_only_with_a_weight(self, heldout):
        assert EpipolarLoss()(*rows([1.0, 2.0]), *heldout) == EpipolarLoss()(*rows([1.0, 2.0]))
        with pytest.raises(ValueError, match=r"heldout_weight=0\.5 needs held-out correspondences, got none"):
            EpipolarLoss(heldout_weight=0.5)(*rows([1.0, 2.0]), *heldout)


class TestLossesOfSets:
    def test_by_hand(self):
        values = rows([1.0, 0.0], [2.0, 50.0], dtype=torch.float64)
        expected = [(4 / 8 + 0) / 2, (16 / 20 + 10_000 / 10_004) / 2]
        assert BoundedEpipolarLoss(2.0)(*values).tolist() == pytest.approx(expected)
        expected = [(math.log(2.5) + math.log(0.5)) / 2, (math.log(4.5) + math.log(100.5)) / 2]
        assert LogEpipolarLoss(0.5)(*values).tolist() == pytest.approx(expected)
        logits = torch.tensor([[0.0, 2.0, torch.nan], [1.0, 1.0, 1.0]])
        inliers = torch.tensor([[1.0, 0.0, torch.nan], [torch.nan] * 3])
        expected = [(math.log(2) + math.log(1 + math.exp(2))) / 2, 0.0]
        assert kln.InlierLoss()(logits, inliers).tolist() == pytest.approx(expected)

    @pytest.mark.parametrize("loss", [BoundedEpipolarLoss(), LogEpipolarLoss()])
    def test_gradcheck_and_epipole(self, loss):
        F_mat = uniform(3, 3, 3, low=-1).requires_grad_()  # entries of one size, as in normalised coordinates
        points = uniform(3, 12, 2, low=-1, seed=1), uniform(3, 12, 2, low=-1, seed=2)
        assert gradcheck(lambda F: loss(*points, F), F_mat, eps=1e-6, atol=1e-4)
        compiled = torch.compile(loss, fullgraph=True, dynamic=True, backend="eager")
        assert torch.equal(compiled(*points, F_mat), loss(*points, F_mat))
        on_epipole = ORIGIN.clone().requires_grad_()
        value = loss(torch.zeros(1, 2, 2), torch.ones(1, 2, 2), on_epipole[None])
        (gradient,) = torch.autograd.grad(value.sum(), on_epipole)
        assert value.isfinite().all()
        assert not gradient.any()
        near = torch.tensor([[[1e-22, 0.0]]], requires_grad=True)
        loss(near, torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]])).sum().backward()
        assert near.grad.isfinite().all()

    def test_log_essential(self):
        E_mat, true = uniform(4, 3, 3, low=-1), uniform(4, 3, 3, low=-1, seed=1)
        loss = kln.LogEssentialLoss(0.1)
        E, T = (M.numpy() / np.linalg.norm(M.numpy(), axis=(1, 2))[:, None, None] for M in (E_mat, true))
        distance = np.minimum(*(np.linalg.norm(E - sign * T, axis=(1, 2)) for sign in (1, -1)))
        np.testing.assert_allclose(loss(-3 * E_mat, true), np.log(np.hypot(distance, 0.1)))
        assert gradcheck(lambda E: loss(E, true), E_mat.requires_grad_(), eps=1e-6, atol=1e-4)
        (gradient,) = torch.autograd.grad(loss(E_mat, -E_mat.detach()).sum(), E_mat)
        assert gradient.abs().max() < 1e-6

    @pairwise(loss=[BoundedEpipolarLoss, LogEpipolarLoss, kln.LogEssentialLoss], number=[0.0, -1.0, math.nan])
    def test_exceptions(self, loss, number):
        raises(ValueError, "must be positive, got", loss, number)

"""Minimal samples solved many at once against the solver that takes any, and samples that determine nothing."""

import numpy as np
import pytest
import torch
from scenes import SCENES, correspondences, plane, up_to_sign

from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.minimal import are_independent, solve_samples
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import PairScorer


def coordinates(points1, points2):
    """Homogeneous points (K, 8, 3) in coordinates of all samples together."""
    scorer = PairScorer(points1.flatten(0, 1), points2.flatten(0, 1), 1.0, Fundamental())
    return scorer.samples(torch.arange(points1[..., 0].numel()).view(-1, 8))


def reference(x1, x2) -> np.ndarray:
    """Null vectors by SVD, covariances by pseudo-inverses, one sample after another."""
    corrected = []
    for a, b in zip(x1.numpy(), x2.numpy(), strict=True):
        xi = np.stack([np.kron(q, p) for p, q in zip(a, b, strict=True)])
        u = np.linalg.svd(xi)[2][8]
        lines1, lines2 = (b @ u.reshape(3, 3))[:, :2], (a @ u.reshape(3, 3).T)[:, :2]
        variances = (lines1**2).sum(1) + (lines2**2).sum(1)
        V = np.linalg.pinv(xi.T / variances @ xi, rcond=1e-12)
        for _ in range(3):
            F = u.reshape(3, 3)
            cofactors = np.stack([np.cross(F[1], F[2]), np.cross(F[2], F[0]), np.cross(F[0], F[1])]).ravel()
            u = u - np.linalg.det(F) / (cofactors @ V @ cofactors) * V @ cofactors
            u = u / np.linalg.norm(u)
        corrected.append(u.reshape(3, 3))
    return np.stack(corrected)


class TestSolve:
    @pytest.mark.parametrize("name", SCENES)
    def test_against_a_loop_in_numpy(self, name):
        x1, x2 = coordinates(*correspondences(name, 30))
        F = solve_samples(x1, x2, 0.01)
        assert torch.allclose(torch.linalg.matrix_norm(F), torch.ones(len(F), dtype=F.dtype))
        assert up_to_sign(F, reference(x1, x2)) < 1e-5

    def test_leaves_undetermined_samples_out(self):
        points1, points2 = correspondences("handheld", 6)
        for points in (points1, points2):
            points[2, 5] = points[2, 4]
        x1, x2 = coordinates(points1, points2)
        others = torch.tensor([0, 1, 3, 4, 5])
        assert torch.allclose(solve_samples(x1, x2, 0.01), solve_samples(x1[others], x2[others], 0.01))
        for few in (slice(2, 3), slice(0)):
            assert solve_samples(x1[few], x2[few], 0.01).shape == (0, 3, 3)


@pytest.mark.parametrize("kind", ["coincident", "on a line", "on a plane", "seven on a plane"])
def test_degenerate_samples(kind):
    points1, points2 = plane(50, 8)[:2] if kind == "on a plane" else correspondences("handheld", 50)
    if kind == "coincident":
        points1[:, 5], points2[:, 5] = points1[:, 2], points2[:, 2]
    elif kind == "on a line":
        along = torch.linspace(0, 300, 8, dtype=torch.float64)
        points1 = torch.stack([along, 2 * along + 5], -1).repeat(50, 1, 1)
        points2[..., 1] = 3 * points2[..., 0]
    elif kind == "seven on a plane":
        points2 = points1 + torch.tensor([30.0, -12.0])
        points2[:, 7] += 20
    x1, x2 = coordinates(points1, points2)
    assert not are_independent(torch.linalg.qr(design_matrix(x1, x2).mT, mode="r")[1], x1, x2, 0.01).any()

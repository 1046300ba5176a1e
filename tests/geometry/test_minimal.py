"""Minimal samples: of seven against a loop, of five against the truth, degenerate ones."""

from functools import partial

import numpy as np
import pytest
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from references import true_essential
from scenes import SCENES, correspondences, plane, scenes

from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.five_point import essential_in_span
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.minimal_solver import are_independent
from kornia_learnnorm.ransac.scoring import PairScorer


def coordinates(points1, points2, size=7):
    """Homogeneous points (K, size, 3) of the first points of samples, in coordinates of all samples together."""
    points1, points2 = points1[:, :size], points2[:, :size]
    scorer = PairScorer(points1.flatten(0, 1), points2.flatten(0, 1), 1.0, Fundamental())
    return [x.mT.view(-1, size, 3) for x in (scorer.x1, scorer.x2)]


def reference(x1, x2) -> list[torch.Tensor]:
    """The real singular matrices in the null spaces by SVD, roots of polynomials, one sample after another."""
    found = []
    for a, b in zip(x1.numpy(), x2.numpy(), strict=True):
        rows = np.stack([np.kron(q, p) for p, q in zip(a, b, strict=True)])
        first, second = np.linalg.svd(rows)[2][7:].reshape(2, 3, 3)
        values = [np.linalg.det(first + x * second) for x in (-1.0, 0.0, 1.0, 2.0)]
        roots = np.roots(np.polyfit((-1.0, 0.0, 1.0, 2.0), values, 3))
        found += [first + x.real * second for x in roots if abs(x.imag) < 1e-9 * (1 + abs(x))]
    return [torch.from_numpy(F / np.linalg.norm(F)) for F in found]


class TestSolve:
    @pytest.mark.parametrize("name", SCENES)
    def test_against_a_loop_in_numpy(self, name):
        x1, x2 = coordinates(*correspondences(name, 30))
        found, expected = Fundamental().solve_samples(x1, x2, 0.01), reference(x1, x2)
        assert len(found) == len(expected)
        assert torch.linalg.det(found).abs().max() < 1e-12
        for F in expected:
            assert torch.stack([found - F, found + F]).flatten(2).norm(dim=-1).min() < 1e-5

    def test_leaves_undetermined_samples_out(self):
        points1, points2 = correspondences("handheld", 6)
        for points in (points1, points2):
            points[2, 5] = points[2, 4]
        x1, x2 = coordinates(points1, points2)
        others, solve = torch.tensor([0, 1, 3, 4, 5]), partial(Fundamental().solve_samples, shift=0.01)
        assert torch.allclose(solve(x1, x2), solve(x1[others], x2[others]))
        for few in (slice(2, 3), slice(0)):
            assert solve(x1[few], x2[few]).shape == (0, 3, 3)


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
    x1, x2 = coordinates(points1, points2, 8)
    assert not are_independent(torch.linalg.qr(design_matrix(x1, x2).mT, mode="r")[1], x1, x2, 0.01).any()
    if kind != "seven on a plane":
        assert len(Fundamental().solve_samples(*coordinates(points1, points2), 0.01)) == 0


@pytest.mark.parametrize("kind", ["orbit", "handheld", "driving"])
def test_five_points_find_the_truth(kind):
    scene = scenes(kind, 100, 5, noise=0.0)
    views = (scene.points1, scene.K1), (scene.points2, scene.K2)
    x1, x2 = (torch.linalg.solve(K, convert_points_to_homogeneous(p).mT).mT for p, K in views)
    rows = (x2[..., :, None] * x1[..., None, :]).flatten(2)
    found, real = essential_in_span(torch.linalg.svd(rows)[2][:, 5:].unflatten(-1, (3, 3)))
    assert found.shape == (100, 10, 3, 3)
    assert torch.allclose(found.flatten(2).norm(dim=-1), torch.ones(100, 10, dtype=found.dtype))
    known = torch.where(real[..., None, None], found, torch.inf)
    gaps = torch.stack([(known - sign * true_essential(scene)[:, None]).flatten(2).norm(dim=-1) for sign in (1, -1)])
    assert (gaps.amin((0, 2)) < 1e-5).double().mean() > 0.97  # not where an image point is next to an epipole
    values = torch.linalg.svdvals(found[real])
    assert (values[:, :2] - 0.5**0.5).abs().median() < 1e-9
    assert values[:, 2].median() < 1e-9


def test_degenerate_spans_are_finite():
    same = torch.eye(3, dtype=torch.float64).expand(1, 4, 3, 3)
    for basis in (same, 0 * same, torch.zeros(0, 4, 3, 3, dtype=torch.float64)):
        found, real = essential_in_span(basis)
        assert found.isfinite().all()
        assert real.shape == found.shape[:2]

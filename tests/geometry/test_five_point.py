"""Essential matrices in the span of four: those of minimal samples, beside Kornia's solver."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.epipolar import find_essential
from scenes import scenes, true_essential

from kornia_learnnorm.geometry.five_point import essential_in_span

pytestmark = pytest.mark.numerical


def null_spaces(scene):
    """Bases (B, 4, 3, 3) of the matrices that five correspondences allow for, and their directions."""
    rays = [
        torch.linalg.solve(K, torch.cat([p, torch.ones_like(p[..., :1])], -1).mT).mT
        for p, K in ((scene.points1, scene.K1), (scene.points2, scene.K2))
    ]
    rows = (rays[1][..., :, None] * rays[0][..., None, :]).flatten(2)
    return torch.linalg.svd(rows)[2][:, 5:].unflatten(-1, (3, 3)), rays


def nearest(found, matrices):
    """The distance of each matrix (B, M, 3, 3) from the nearest one found, up to sign."""
    gaps = [(found[:, :, None] - sign * matrices[:, None]).flatten(3).norm(dim=-1) for sign in (1, -1)]
    return torch.stack(gaps).amin((0, 2))


@pytest.mark.parametrize("kind", ["orbit", "handheld", "driving"])
def test_finds_the_truth(kind):
    scene = scenes(kind, 100, 5, noise=0.0)
    found, real = essential_in_span(null_spaces(scene)[0])
    assert found.shape == (100, 10, 3, 3)
    assert torch.allclose(found.flatten(2).norm(dim=-1), torch.ones(100, 10, dtype=found.dtype))
    gaps = nearest(torch.where(real[..., None, None], found, torch.inf), true_essential(scene)[:, None])
    assert (gaps < 1e-5).double().mean() > 0.97  # not where an image point is next to an epipole
    values = torch.linalg.svdvals(found[real])
    assert (values[:, :2] - 0.5**0.5).abs().median() < 1e-9
    assert values[:, 2].median() < 1e-9


def test_finds_what_kornia_finds():
    basis, rays = null_spaces(scenes("orbit", 100, 5))
    found, real = essential_in_span(basis)
    theirs = find_essential(*(r[..., :2] / r[..., 2:] for r in rays))
    known = theirs.isfinite().all(-1).all(-1)
    theirs = torch.where(known[..., None, None], theirs, torch.inf)
    gaps = nearest(theirs, found)[real]
    assert (gaps < 1e-6).double().mean() > 0.97
    assert abs(int(real.sum()) - int(known.sum())) <= 4


def test_degenerate_spans_are_finite():
    same = torch.eye(3, dtype=torch.float64).expand(1, 4, 3, 3)
    for basis in (same, 0 * same, torch.zeros(0, 4, 3, 3, dtype=torch.float64)):
        found, real = essential_in_span(basis)
        assert found.isfinite().all()
        assert real.shape == found.shape[:2]

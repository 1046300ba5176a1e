"""Essential matrices in the span of four: those of minimal samples."""

import pytest
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from scenes import scenes, true_essential

from kornia_learnnorm.geometry.five_point import essential_in_span


def null_spaces(scene):
    """Bases (B, 4, 3, 3) of the matrices that five correspondences allow for."""
    views = (scene.points1, scene.K1), (scene.points2, scene.K2)
    rays1, rays2 = (torch.linalg.solve(K, convert_points_to_homogeneous(p).mT).mT for p, K in views)
    rows = (rays2[..., :, None] * rays1[..., None, :]).flatten(2)
    return torch.linalg.svd(rows)[2][:, 5:].unflatten(-1, (3, 3))


@pytest.mark.parametrize("kind", ["orbit", "handheld", "driving"])
def test_finds_the_truth(kind):
    scene = scenes(kind, 100, 5, noise=0.0)
    found, real = essential_in_span(null_spaces(scene))
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

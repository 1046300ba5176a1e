"""Distances from a plane that a lens may bend."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import kornia_learnnorm as kln
from kornia_learnnorm.two_view.parallax import parallax
from kornia_learnnorm.two_view.plane_distances import distances_from_plane

SIZE = (1600, 1200)
H = torch.tensor([[1.05, -0.08, 30.0], [0.06, 0.98, -20.0], [4e-5, -2e-5, 1.0]], dtype=torch.float64)


def bend(points, distortion):
    """Return where a lens sees points: the radius r of a pinhole camera is that of the image times 1 + k r^2."""
    centre, radius = torch.tensor(SIZE).double() / 2, np.hypot(*SIZE) / 2
    ideal = seen = (points - centre) / radius
    for _ in range(50):
        seen = ideal / (1 + distortion * seen.square().sum(-1, keepdim=True))
    return seen * radius + centre


def matches(distortion, relief=0.0, noise=0.1, number=300):
    rng = np.random.default_rng(0)
    ideal1 = torch.from_numpy(rng.uniform([100, 100], [1400, 1050], (number, 2)))
    homogeneous = torch.cat([ideal1, torch.ones(number, 1)], 1) @ H.mT
    ideal2 = homogeneous[:, :2] / homogeneous[:, 2:]
    ideal2[::2] += relief * torch.tensor([1.0, 0.5]) * torch.linspace(-1, 1, len(ideal2[::2]))[:, None]
    points = bend(ideal1, distortion), bend(ideal2, distortion)
    return tuple(p + noise * torch.from_numpy(rng.normal(size=(number, 2))) for p in points)


@pytest.fixture(scope="module")
def relief():
    """Matches of a bent plane with relief, and their distances from it."""
    points = matches(0.05, relief=5.0)
    return points, distances_from_plane(*points, H, SIZE, SIZE, 1.0)


class TestDistancesFromPlane:
    @pytest.mark.parametrize("distortion", [-0.1, -0.04, 0.0, 0.05, 0.15])
    def test_a_bent_plane_is_a_plane(self, distortion):
        points = matches(distortion, noise=0.0)
        assert distances_from_plane(*points, H, SIZE, SIZE, 1.0).max() < 1e-3
        if distortion:
            assert parallax(*points, H).max() > 1

    @pytest.mark.parametrize("distortion", [0.0, 0.08])
    def test_parallax_stays(self, distortion):
        points = matches(distortion, relief=10.0)
        off = distances_from_plane(*points, H, SIZE, SIZE, 1.0)
        expected = 10 * np.hypot(1, 0.5) * torch.linspace(-1, 1, 150).abs()
        assert off[1::2].max() < 0.6
        assert (off[::2] / expected)[expected > 2].median() == pytest.approx(1, abs=0.15)

    def test_points_at_infinity(self):
        points1, points2 = matches(0.0)
        points1[0] = torch.tensor([0.0, 50000.0])  # on the line that this homography moves to infinity
        assert distances_from_plane(points1, points2, H, SIZE, SIZE, 1.0).isnan().sum() == 0

    @given(scale=st.floats(0.1, 10))
    def test_moves_with_the_scale_of_the_images(self, relief, scale):
        (points1, points2), expected = relief
        S = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        size = (SIZE[0] * scale, SIZE[1] * scale)
        scaled = distances_from_plane(scale * points1, scale * points2, S @ H @ S.inverse(), size, size, scale)
        torch.testing.assert_close(scaled, scale * expected, rtol=1e-4, atol=1e-4 * scale)

    @given(seed=st.integers(0, 100))
    def test_does_not_depend_on_the_order(self, relief, seed):
        (points1, points2), expected = relief
        order = torch.randperm(len(points1), generator=torch.Generator().manual_seed(seed))
        moved = distances_from_plane(points1[order], points2[order], H, SIZE, SIZE, 1.0)
        torch.testing.assert_close(moved, expected[order], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("distortion", [-0.08, 0.08])
def test_a_bent_plane_is_planar(distortion):
    """Without the distortion, the bend counts as parallax, and the wrong matrix comes without a warning."""
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    found = kln.estimate_matches(*matches(distortion), size1=SIZE, size2=SIZE)
    assert "planar" in [warning.code for warning in found.warnings]

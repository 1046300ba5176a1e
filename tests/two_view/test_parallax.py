"""The evidence for an epipole, and distances from a plane that a lens bends."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from plane_scene import H, fit_parallax, make_scene

import kornia_learnnorm as kln
from kornia_learnnorm.two_view import parallax as module

ROWS = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()  # epipolar lines are the rows


class TestEvidence:
    def test_parallax_is_the_distance_from_the_homography(self):
        points1, points2 = make_scene(3, 3, 0, 0.0)
        moved = np.c_[points1, np.ones(6)] @ H.numpy().T
        expected = np.linalg.norm(moved[:, :2] / moved[:, 2:] - points2.numpy(), axis=1)
        assert np.allclose(module.parallax(points1, points2, H), expected, atol=1e-9)
        assert torch.isinf(module.parallax(torch.zeros(1, 2), torch.zeros(1, 2), torch.diag(torch.tensor([1.0, 1, 0]))))

    def test_by_hand(self):
        """Ten matches at 20 px, six of them on their lines and four across; two of the six determine the epipole."""
        points1 = torch.from_numpy(np.random.default_rng(0).uniform([0, 0], [640, 480], (10, 2)))
        points2 = points1 + torch.tensor([[20.0, 0]] * 6 + [[0.0, 20]] * 4)
        ratio, shares = math.exp(100) / np.i0(100), np.arange(0.05, 1, 0.1)
        gain = (4 * np.log1p(shares * (ratio - 1)) + 4 * np.log1p(-shares)).max()
        found = module.parallax_evidence(points1, points2, ROWS, torch.full((10,), 20.0), 1.0, (1.0,))
        assert found == pytest.approx(math.log10(10 * 45) - gain / math.log(10))

    def test_too_few_matches_off_the_plane(self):
        distance = torch.tensor([9.0, 9, 0, 0, 0])
        assert module.parallax_evidence(*torch.rand(2, 5, 2).double(), ROWS, distance, 1.0) == math.inf

    @given(st.integers(3, 40), st.integers(0, 40))
    def test_more_inliers_are_stronger_evidence(self, inliers, outliers):
        points1 = torch.zeros(inliers + outliers + 1, 2).double()
        distance = torch.full((len(points1),), 30.0)
        less, more = (torch.where(torch.arange(len(points1)) < n, 0.0, 30.0) for n in (inliers, inliers + 1))
        less, more = (torch.stack([torch.zeros(len(points1)), across], 1).double() for across in (less, more))
        evidence = [module.parallax_evidence(points1, points2, ROWS, distance, 1.0) for points2 in (less, more)]
        assert evidence[1] <= evidence[0]

    @pytest.mark.parametrize("seed", range(6))
    def test_of_a_plane_there_is_none(self, seed):
        """Although the epipole is the best one, and a third of the matches is random."""
        points = make_scene(200, 0, 100, 0.5, seed)
        evidence = module.parallax_evidence(*points, fit_parallax(points)[0], module.parallax(*points, H), 1.0)
        assert evidence > module.MAX_LOG_CHANCE_PARALLAX


def test_signs_of_neighbours_by_hand():
    """Of a hundred pairs, on a row, all agree, or all but two; of too few or too near ones, nothing is known."""

    def evidence(signs, gap=20.0):
        x = (gap * 1.02 ** torch.arange(len(signs))).cumsum(0).double()  # of each, the one before is the nearest
        points1, offsets = (torch.stack([value, 0 * x], 1) for value in (x, 3 * signs.double()))
        return module.sign_evidence(points1, points1 + offsets, ROWS, offsets, 1.0)

    one_side, lost = torch.ones(101), 0.98 * math.log10(0.98) + 0.02 * math.log10(0.02)
    two = torch.where((torch.arange(101) - 40).abs() < 10, -one_side, one_side)
    for signs, less in ((one_side, 0), (two, lost)):
        assert evidence(signs) == pytest.approx(math.log10(4) - 100 * (math.log10(2) + less))
    assert [evidence(one_side[:99]), evidence(one_side, gap=1e-3)] == [-math.inf, 0]


@pytest.mark.parametrize("agree", [False, True])
def test_errors_along_edges_are_no_parallax(agree, monkeypatch):
    """A tenth of the matches of a plane is off along the rows, to either side, or to that of their neighbours."""
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform([0, 0], [640, 480], (2000, 2)))
    signs = torch.where(points[:, 0] < 320, -1.0, 1.0) if agree else torch.from_numpy(rng.choice([-1.0, 1.0], 2000))
    offsets = torch.stack([2 * signs * (torch.arange(2000) % 10 == 0), torch.zeros(2000)], 1).double()
    monkeypatch.setattr(module, "find_main_plane", lambda *_: torch.eye(3).double())
    monkeypatch.setattr(module, "offsets_from_plane", lambda *_: offsets)
    found = module.measure_parallax(points, points + offsets, ROWS, 1.0, (640, 480), (640, 480))
    assert (found.near, found.planar) == (pytest.approx(0.9), not agree)


def test_main_plane():
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    points = torch.from_numpy(np.random.default_rng(0).uniform([0, 0], [640, 480], (40, 2)))
    found = module.find_main_plane(points, points + 7.0, 1.0)
    assert np.allclose(found / found[2, 2], [[1, 0, 7], [0, 1, 7], [0, 0, 1]], atol=1e-6)


SIZE = (1600, 1200)
BENT = torch.tensor([[1.05, -0.08, 30.0], [0.06, 0.98, -20.0], [4e-5, -2e-5, 1.0]], dtype=torch.float64)


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
    homogeneous = torch.cat([ideal1, torch.ones(number, 1)], 1) @ BENT.mT
    ideal2 = homogeneous[:, :2] / homogeneous[:, 2:]
    ideal2[::2] += relief * torch.tensor([1.0, 0.5]) * torch.linspace(-1, 1, len(ideal2[::2]))[:, None]
    points = bend(ideal1, distortion), bend(ideal2, distortion)
    return tuple(p + noise * torch.from_numpy(rng.normal(size=(number, 2))) for p in points)


class TestOffsetsFromPlane:
    @pytest.mark.parametrize("distortion", [-0.1, 0.0, 0.15])
    def test_a_bent_plane_is_a_plane(self, distortion):
        points = matches(distortion, noise=0.0)
        assert module.offsets_from_plane(*points, BENT, SIZE, SIZE, 1.0).norm(dim=1).max() < 1e-3
        if distortion:
            assert module.parallax(*points, BENT).max() > 1

    @pytest.mark.parametrize("distortion", [0.0, 0.08])
    def test_parallax_stays(self, distortion):
        points = matches(distortion, relief=10.0)
        off = module.offsets_from_plane(*points, BENT, SIZE, SIZE, 1.0).norm(dim=1)
        expected = 10 * np.hypot(1, 0.5) * torch.linspace(-1, 1, 150).abs()
        assert off[1::2].max() < 0.6
        assert (off[::2] / expected)[expected > 2].median() == pytest.approx(1, abs=0.15)

    def test_points_at_infinity(self):
        points1, points2 = matches(0.0)
        points1[0] = torch.tensor([0.0, 50000.0])  # on the line that this homography moves to infinity
        assert module.offsets_from_plane(points1, points2, BENT, SIZE, SIZE, 1.0).isnan().sum() == 0

    @given(scale=st.floats(0.1, 10))
    def test_moves_with_the_scale_of_the_images(self, scale):
        points1, points2 = matches(0.05, relief=5.0)
        expected = module.offsets_from_plane(points1, points2, BENT, SIZE, SIZE, 1.0)
        S = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        size = (SIZE[0] * scale, SIZE[1] * scale)
        moved = scale * points1, scale * points2, S @ BENT @ S.inverse()
        scaled = module.offsets_from_plane(*moved, size, size, scale)
        torch.testing.assert_close(scaled, scale * expected, rtol=1e-4, atol=1e-4 * scale)


@pytest.mark.parametrize("distortion", [-0.08, 0.08])
def test_a_bent_plane_is_planar(distortion):
    """Without the distortion, the bend counts as parallax, and the wrong matrix comes without a warning."""
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    found = kln.estimate_matches(*matches(distortion), size1=SIZE, size2=SIZE, model="fundamental")
    assert "planar" in [warning.code for warning in found.warnings]


SHIFT = torch.cat([torch.zeros(60), torch.linspace(10, 60, 40)])


@pytest.mark.parametrize(
    ("shift", "distance", "near", "planar"),
    [
        (0 * SHIFT, 0.3, 1.0, True),
        (SHIFT, 0.3, 0.6, False),
        (1.5 * (SHIFT == 0), 0.3, 0.4, False),  # Parallax is evidence where the matches fit within much less than it.
        *((0.9 * (SHIFT == 0), distance, 1.0, distance > 0.5) for distance in (0.3, 0.95)),
        *((0.4 * (SHIFT == 0), distance, 1.0, distance > 0.2) for distance in (0.1, 0.5)),
    ],
)
def test_measure_parallax(shift, distance, near, planar, monkeypatch):
    """Of the identity, under which a hundred points stay or move along one direction."""
    monkeypatch.setattr(module, "find_main_plane", lambda *_: torch.eye(3).double())
    monkeypatch.setattr(module, "offsets_from_plane", lambda *_: torch.stack([shift, 0 * shift], 1))
    points = torch.from_numpy(np.random.default_rng(0).uniform([0, 0], [640, 480], (100, 2)))
    across = torch.tensor([0, distance / 2], dtype=torch.float64)  # in each image
    found = module.measure_parallax(points, points + across, ROWS, 1.0, (640, 480), (640, 480))
    assert (found.near, found.planar) == (pytest.approx(near), planar)
    assert f"explains {near:.0%} of the inliers within 1 px" in found.describe(1.0)

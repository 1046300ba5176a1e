"""The matrix of matches: searches among many outliers, and scenes that are nearly a plane."""

import numpy as np
import pytest
import torch
from scenes import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import orbit
from kornia_learnnorm.two_view.solver import TwoViewSolver

pytest.importorskip("cv2", reason="OpenCV is not installed")


@pytest.mark.parametrize("seed", [1, 2])
def test_search_near_a_coarse_matrix(seed):
    """Of 100 true matches among 900 random ones, few fit the matrix of a part; most lie near it."""
    generator = torch.Generator().manual_seed(seed)
    scene = orbit(1, 1000, generator, noise=0.0)
    exact = torch.cat([scene.points1[0], scene.points2[0]], -1)
    true = exact[:100] + 0.5 * torch.randn(100, 4, generator=generator).double()
    false = torch.rand(900, 4, generator=generator).double() * scene.image_size[0].repeat(2)
    solver = TwoViewSolver(*torch.cat([true, false]).split(2, -1), torch.ones(1000).double(), 1.0, 0)
    noisy1, noisy2 = (exact + 4.0 * torch.randn(1000, 4, generator=generator).double())[None, :100].split(2, -1)
    coarse = kln.find_fundamental(noisy1, noisy2)
    assert int(solver.support(coarse)) < 40
    found = solver.improve(torch.zeros(3, 3).double(), coarse)
    assert np.median(epipolar_distances(exact[100:, :2], exact[100:, 2:], found)) < 1


def test_relief_below_the_threshold():
    """A wall with boards whose parallax is 0.5 px: a tenth of the matches with errors of 0.5 px do not decide."""
    rng = np.random.default_rng(0)
    K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    number, t = 1200, np.array([0.3, 0.02, 0.05])
    depth = np.where(rng.uniform(size=number) < 0.3, 5.9, 6.0)
    x1 = rng.uniform([0, 0], [640, 480], (number, 2))
    x2 = (np.c_[x1, np.ones(number)] @ np.linalg.inv(K).T * depth[:, None] + t) @ K.T
    exact = torch.from_numpy(x1), torch.from_numpy(x2[:, :2] / x2[:, 2:])
    noise = np.where(rng.uniform(size=(number, 1)) < 0.1, 0.5, 0.05)
    noisy = tuple(points + torch.from_numpy(noise * rng.normal(size=(number, 2))) for points in exact)
    scores = torch.ones(number).double()
    ransac = kln.RANSAC(inl_th=1.0, seed=0).estimate(*noisy, scores).F_mat
    found = TwoViewSolver(*noisy, scores, 1.0, 0).solve().matrix
    error, worse = (np.median(epipolar_distances(*exact, F_mat)) for F_mat in (found, ransac))
    assert error < 0.7 * worse

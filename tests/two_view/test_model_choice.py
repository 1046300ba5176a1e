"""Searches among many outliers and near planes, and which of both matrices is the answer."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from references import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import orbit
from kornia_learnnorm.two_view import model_choice
from kornia_learnnorm.two_view.model_choice import choose_model, compute_gric
from kornia_learnnorm.two_view.parallax import Parallax
from kornia_learnnorm.two_view.result import NoReliableMatrixError
from kornia_learnnorm.two_view.solver import TwoViewSolver

pytest.importorskip("cv2", reason="OpenCV is not installed")

SIZE = (640, 480)


def make_solver(relief: float, outliers: int = 0, plane: int = 150) -> TwoViewSolver:
    """Matches of a camera that moves sideways along a wall, of which a third stands out by a share of its distance."""
    rng = np.random.default_rng(0)
    x1 = rng.uniform([0, 0], SIZE, (plane, 2))
    x2 = x1 + np.where(np.arange(plane)[:, None] % 3, [40.0, 10], np.array([40.0, 10]) / (1 - relief))
    x1, x2 = (x + rng.normal(0, 0.2, x.shape) for x in (x1, x2))
    wrong = rng.uniform([0, 0, 0, 0], [*SIZE, *SIZE], (outliers, 4))
    points = (torch.from_numpy(x) for x in (np.r_[x1, wrong[:, :2]], np.r_[x2, wrong[:, 2:]]))
    return TwoViewSolver(*points, torch.ones(plane + outliers).double(), 1.0, 0)


class TestChooseModel:
    @pytest.mark.parametrize(("relief", "model"), [(0.0, "homography"), (0.1, "fundamental")])
    def test_relief_decides(self, relief, model):
        choice, found, H_mat = choose_model(make_solver(relief, outliers=50), "auto", SIZE, SIZE)
        assert (choice.model, choice.parallax.planar) == (model, model == "homography")
        assert choice.reason == choice.parallax.describe(1.0)
        assert found.matrix.shape == H_mat.shape == (3, 3)
        assert choice.fundamental_inliers > 100
        assert choice.homography_inliers > 60

    def test_gric_must_agree(self, monkeypatch):
        """Where parallax is no more than chance but F explains the matches better, it stays, with its warning."""
        monkeypatch.setattr(model_choice, "measure_parallax", lambda *_: Parallax(1.0, 1.0, 0.0))
        for relief, model in ((0.1, "fundamental"), (0.0, "homography")):
            solver, K = make_solver(relief), torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]).double()
            choice = choose_model(solver, "auto", SIZE, SIZE)[0]
            assert (choice.model, choice.by_gric) == (model, model)
            assert choose_model(replace(solver, cameras=(K, K)), "auto", SIZE, SIZE)[0].model == model

    def test_what_is_asked_for(self):
        solver = make_solver(0.0)
        choice, found, H_mat = choose_model(solver, "fundamental", SIZE, SIZE)
        assert (choice.model, choice.parallax.planar, H_mat) == ("fundamental", True, None)
        choice, found, H_mat = choose_model(solver, "homography", SIZE, SIZE)
        assert (choice.model, choice.parallax.planar, found) == ("homography", True, None)
        assert np.allclose(H_mat / H_mat[2, 2], [[1, 0, 40], [0, 1, 10], [0, 0, 1]], atol=0.5)

    @pytest.mark.parametrize("missed", ["all", "most"])
    def test_a_search_for_the_fundamental_matrix_that_failed(self, missed, monkeypatch):
        """Random matrices agree with few of the matches of a wall with relief."""
        solver = make_solver(0.1)

        def search(self, first, size2):
            if missed == "all":
                raise NoReliableMatrixError("no_consensus", "8 of 150 matches agree")
            return first._replace(matrix=torch.tensor([[0.0, 0, 1], [0, 0, 0], [-1, 0, 90]]).double())

        monkeypatch.setattr(TwoViewSolver, "search", search)
        choice, found, H_mat = choose_model(solver, "auto", SIZE, SIZE)
        assert choice.model == "homography"
        assert (found is None) == (missed == "all")
        assert H_mat is not None

    def test_no_matrix(self):
        solver = make_solver(0.0, outliers=20, plane=0)
        for model in ("auto", "homography"):
            with pytest.raises(NoReliableMatrixError, match="20 matches agree") as caught:
                choose_model(solver, model, SIZE, SIZE)
            assert caught.value.code == "no_consensus"


def test_gric():
    """By hand: of six matches, three have a distance of 0.5 px to the lines, and two are moved 3 px too far."""
    x1 = torch.from_numpy(np.random.default_rng(0).uniform(100, 500, (6, 2)))
    x2 = x1 + torch.tensor([[0, 0.5**0.5], [0, -(0.5**0.5)], [0, 0.5**0.5], [0, 0.1], [3, 0], [3, 0]])
    rows = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()  # epipolar lines are the rows
    found = compute_gric(x1, x2, rows, torch.eye(3).double(), 1.0, False)
    squares1 = np.array([0.25, 0.25, 0.25, 0.005, 0, 0])
    variance = 0.25 / (2 * np.log(2))  # by the four that are not moved too far; by the lines it is smaller
    for cost, squares, most, dimension, dof in zip(
        found, (squares1, [0.25, 0.25, 0.25, 0.005, 4.5, 4.5]), (2, 4), (3, 2), (7, 8), strict=True
    ):
        misfit = np.minimum(np.array(squares) / variance, most).sum()
        assert cost == pytest.approx(misfit + 6 * dimension * np.log(4) + dof * np.log(24))
    assert compute_gric(x1, x2, rows, torch.eye(3).double(), 1.0, True)[0] == pytest.approx(found[0] - 2 * np.log(24))
    exact = compute_gric(x1, x1, rows, torch.eye(3).double(), 1.0, False)
    assert np.isfinite(exact).all()
    assert exact[1] < exact[0]


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

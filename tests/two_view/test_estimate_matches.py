"""The estimate of matches, its errors and its invariances."""

from __future__ import annotations

import json
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from two_view import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.two_view import estimate_matches as matches_module
from kornia_learnnorm.two_view.solver import TwoViewSolver

pytest.importorskip("cv2", reason="OpenCV is not installed")


def make_matches(inliers: int = 160, outliers: int = 40, noise: float = 0.3, seed: int = 0):
    """Matches of a scene with random ones among them, and the scene."""
    generator = torch.Generator().manual_seed(seed)
    scene = handheld(1, inliers, generator, noise=noise)
    size = scene.image_size[0]
    wrong = torch.rand(outliers, 4, generator=generator, dtype=torch.float64) * size.repeat(2)
    matches = torch.cat([torch.cat([scene.points1[0], scene.points2[0]], -1), wrong])
    return matches[:, :2], matches[:, 2:], scene


class TestEstimateMatches:
    def test_finds_the_geometry(self):
        points1, points2, _ = make_matches()
        exact = handheld(1, 160, torch.Generator().manual_seed(0), noise=0.0)
        found = kln.estimate_matches(points1, points2)
        assert found.warnings == ()
        error = np.median(epipolar_distances(exact.points1[0], exact.points2[0], found.F_mat))
        assert error < 0.3
        assert 0.2 < found.predicted_error / error < 5
        json.dumps(found.as_dict(), allow_nan=False)

    def test_cameras_give_the_pose(self):
        points1, points2, scene = make_matches()
        found = kln.estimate_matches(points1, points2, K1=scene.K1[0], K2=scene.K2[0])
        error = kln.pose_error(found.R[None], found.t[None], scene.R, scene.t)
        assert float(error) < 5
        assert found.front[found.inliers].double().mean() > 0.9

    def test_cameras_solve_a_plane(self):
        """Points of the plane Z = 5: not determined without cameras."""
        rng = np.random.default_rng(0)
        K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
        x1 = rng.uniform([0, 0], [640, 480], (150, 2))
        X = np.c_[x1, np.ones(150)] @ np.linalg.inv(K).T * 5
        t = np.array([0.8, 0.1, 0.1])
        x2 = (X + t) @ K.T
        x2 = x2[:, :2] / x2[:, 2:] + rng.normal(0, 0.2, (150, 2))
        without = kln.estimate_matches(x1, x2, size1=(640, 480), size2=(640, 480))
        assert "planar" in [warning.code for warning in without.warnings]
        found = kln.estimate_matches(x1, x2, size1=(640, 480), size2=(640, 480), K1=K, K2=K)
        assert "planar" not in [warning.code for warning in found.warnings]

    def test_a_tie_between_poses(self, monkeypatch):
        points1, points2, scene = make_matches()
        nothing = torch.full((1, 3, 3), torch.nan).double()
        monkeypatch.setattr(matches_module, "relative_pose", lambda *_: (nothing, nothing[:, 0]))
        found = kln.estimate_matches(points1, points2, K1=scene.K1[0], K2=scene.K2[0])
        assert (found.R, found.t, found.front) == (None, None, None)
        assert [warning.code for warning in found.warnings] == ["no_pose"]
        json.dumps(found.as_dict(), allow_nan=False)

    @pytest.mark.parametrize(
        ("number", "agree", "solved"), [(60, 0, 1 + 2), (450, 0, 1 + 12), (60, 14, 1 + 6), (450, 30, 1 + 12)]
    )
    def test_random_matches_are_given_up_early(self, number, agree, solved, monkeypatch):
        """Of few matches after two parts with no more inliers than a search finds by chance, after six with more."""
        solve, calls = TwoViewSolver.solve, []

        def counted(self):
            calls.append(self)
            F_mat = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()  # of a sideways motion
            return F_mat if agree else torch.zeros(3, 3).double(), torch.zeros(number).double()

        points = torch.rand(2, number, 2, generator=torch.Generator().manual_seed(0)).double() * 500
        points[1, :, 1] += 1000 + torch.arange(number)  # no row in common with image 1
        points[1, :agree, 1] = points[0, :agree, 1]
        monkeypatch.setattr(TwoViewSolver, "solve", counted)
        with nullcontext() if agree else pytest.raises(kln.NoReliableMatrixError, match=f"0 of {number} matches agree"):
            kln.estimate_matches(*points, size1=(500, 500), size2=(500, 500))
        assert len(calls) == solved

        calls.clear()
        monkeypatch.setattr(TwoViewSolver, "solve", lambda self: calls.append(self) or solve(self))
        kln.estimate_matches(*make_matches()[:2])
        assert len(calls) == 13

    def test_the_learned_layer(self):
        points1, points2, _ = make_matches()
        found = kln.estimate_matches(points1, points2, layer=kln.LearnedEightPoint.from_pretrained())
        assert found.estimator == "LearnedEightPoint"
        assert found.weights[found.inliers].mean() > found.weights[~found.inliers].mean() + 0.3

    def test_order_has_no_effect(self):
        points1, points2, _ = make_matches()
        scores = torch.rand(len(points1), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        order = torch.randperm(len(points1), generator=torch.Generator().manual_seed(2))
        first, second = (kln.estimate_matches(points1[o], points2[o], scores[o]) for o in (slice(None), order))
        assert torch.equal(first.F_mat, second.F_mat)
        assert first.predicted_error == second.predicted_error

    def test_rows_that_are_not_finite_or_far_away_are_left_out(self):
        """As in RANSAC; their scores do not matter."""
        points1, points2, _ = make_matches()
        wrong = torch.tensor([[torch.nan, 5.0], [5.0, torch.inf], [1e12, 5.0]], dtype=torch.float64)
        scores = torch.cat([torch.ones(len(points1)), torch.tensor([torch.nan, 0.5, 0.5])])
        found = kln.estimate_matches(torch.cat([points1, wrong]), torch.cat([points2, wrong + 1]), scores)
        expected = kln.estimate_matches(points1, points2)
        assert torch.equal(found.F_mat, expected.F_mat)
        assert found.num_matches == expected.num_matches
        assert found.size1 == expected.size1

    def test_arrays_of_any_number_type(self):
        """Whole numbers, other strides and byte orders are what float64 of the same values is."""
        points1, points2 = (points.round().numpy() for points in make_matches(noise=0.0)[:2])
        expected = kln.estimate_matches(points1, points2)
        for convert in (
            lambda points: points.astype(np.int32),
            lambda points: points.astype(">f4"),
            lambda points: points[::-1, ::-1].copy()[::-1, ::-1],
            lambda points: torch.from_numpy(points).int(),
            lambda points: torch.from_numpy(points).requires_grad_(),
        ):
            assert torch.equal(kln.estimate_matches(convert(points1), convert(points2)).F_mat, expected.F_mat)

    def test_no_ratio_test_is_reported_where_none_was_made(self):
        found = kln.estimate_matches(*make_matches()[:2])
        assert (found.ratio, found.as_dict()["ratio"]) == (None, None)
        assert "ratio" not in found.summary()
        assert f"predicted error of F: {found.predicted_error:.2f} px (typical error" in found.summary()

    def test_what_stands_still_is_left_out(self):
        points1, points2, _ = make_matches(outliers=0)
        overlay = torch.rand(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
        found = kln.estimate_matches(torch.cat([points1, overlay]), torch.cat([points2, overlay]))
        assert found.num_matches <= len(points1)
        assert found.num_inliers > 100

    def test_shared_points_count_once(self):
        points1, points2, _ = make_matches(outliers=0)
        shared = torch.where(torch.arange(160)[:, None] < 60, points2[:1], points2)
        found = kln.estimate_matches(points1, shared)
        assert found.num_matches == 101
        assert len(found.points2.unique(dim=0)) == 101

    @pytest.mark.parametrize(
        ("changes", "code"),
        [
            ({"points1": np.zeros((5, 2)), "points2": np.ones((5, 2))}, "few_matches"),
            ({"points1": np.random.default_rng(0).uniform(0, 500, (50, 2)), "points2": None}, "no_motion"),
        ],
    )
    def test_no_matrix(self, changes, code):
        if changes["points2"] is None:
            changes = {**changes, "points2": changes["points1"] + 0.01}
        with pytest.raises(kln.NoReliableMatrixError) as caught:
            kln.estimate_matches(**changes)
        assert caught.value.code == code

    @pytest.mark.parametrize(
        ("changes", "error", "message"),
        [
            ({"points1": torch.zeros(9, 3)}, ValueError, "shape"),
            ({"points2": torch.zeros(8, 2)}, ValueError, "shape"),
            ({"scores": torch.full((9,), 2.0)}, ValueError, "from 0 to 1, got 9 others, the first 2"),
            ({"scores": torch.full((9,), torch.nan)}, ValueError, "from 0 to 1, got 9 others, the first nan"),
            ({"points1": [[0.0, 1.0]]}, TypeError, r"points1 must be .* got <class 'list'>; numpy\.array\(points1"),
            ({"points1": np.zeros((9, 2), bool)}, TypeError, "points1 must be .* of bool"),
            ({"points1": torch.zeros(9, 2, dtype=torch.complex64)}, TypeError, "points1 must be .* of torch.complex64"),
            ({"points1": np.full((9, 2), "a")}, TypeError, "points1 must be .* of <U1"),
            ({"threshold": -1.0}, ValueError, "threshold must be positive"),
            ({"threshold": "x"}, TypeError, "threshold must be a number, got 'x'"),
            ({"seed": -1}, ValueError, r"seed must lie in \[0, 2\^63\), got -1"),
            ({"seed": None}, TypeError, "seed must be a whole number, got None"),
            ({"layer": "robust"}, TypeError, "layer must be a LearnedEightPoint or None, got <class 'str'>"),
            ({"size1": (0, 0)}, ValueError, r"size1 must be a positive width and height, got \(0, 0\)"),
            ({"size2": (640.5, 480)}, TypeError, "width and height of size2 must be a whole number, got 640.5"),
            ({"size2": (640,)}, ValueError, r"size2 must be a width and a height, got \(640,\)"),
            ({"K1": torch.eye(3)}, ValueError, "given together"),
            ({"K1": torch.zeros(3, 3), "K2": torch.eye(3)}, ValueError, "K1 must be finite and invertible"),
            ({"K1": torch.eye(3), "K2": torch.eye(3)[None]}, ValueError, r"K2 must have .* got \[1, 3, 3\]"),
        ],
    )
    def test_wrong_arguments(self, changes, error, message):
        points = dict(zip(("points1", "points2"), torch.rand(2, 9, 2) * 100, strict=True))
        with pytest.raises(error, match=message):
            kln.estimate_matches(**{**points, **changes})

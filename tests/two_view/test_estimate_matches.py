"""The estimate of matches, its errors and its invariances."""

import json
import pickle

import numpy as np
import pytest
import torch
from references import epipolar_distances
from scenes import raises, seeded, uniform

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view import estimate_matches as module

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")

SCENE = handheld(1, 160, seeded(), noise=0.3)
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
TINY = kln.LearnedEightPoint.from_pretrained("robust-tiny")
SIZES = {"size1": (640, 480), "size2": (640, 480)}


def make_matches(outliers: int = 40):
    """The matches of the scene with random ones among them."""
    wrong = uniform(outliers, 4) * SCENE.image_size[0].repeat(2)
    return torch.cat([torch.cat([SCENE.points1[0], SCENE.points2[0]], -1), wrong]).split(2, -1)


def see_plane(R, t, noise: float = 0.2, depth: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """Matches of points of the plane Z = depth in coordinates of camera 1."""
    rng = np.random.default_rng(int(depth))
    x1 = rng.uniform([0, 0], [640, 480], (150, 2))
    x2 = (np.c_[x1, np.ones(150)] @ np.linalg.inv(K).T * depth @ R.T + t) @ K.T
    return x1, x2[:, :2] / x2[:, 2:] + rng.normal(0, 1, (150, 2)) * noise


MATCHES = make_matches()


@pytest.fixture(scope="module")
def result():
    with torch.autocast("cpu", torch.bfloat16):  # changes nothing
        return kln.estimate_matches(*MATCHES)


def codes(found) -> list[str]:
    return [warning.code for warning in found.warnings]


class TestEstimateMatches:
    def test_finds_the_geometry(self, result):
        exact = handheld(1, 160, seeded(), noise=0.0)
        error = np.median(epipolar_distances(exact.points1[0], exact.points2[0], result.F_mat))
        assert error < 0.3
        assert 0.2 < result.predicted_error / error < 5
        assert result.warnings == ()
        content = json.loads(json.dumps(result.as_dict(), allow_nan=False))
        assert (result.ratio, content["ratio"]) == (None, None)
        assert "ratio" not in str(result)

    def test_a_plane(self):
        """Points of the plane Z = 5: it determines no fundamental matrix without cameras."""
        x1, x2 = see_plane(np.eye(3), [0.8, 0.1, 0.1])
        found = kln.estimate_matches(x1, x2, **SIZES, model="fundamental")
        assert (found.model, found.H_mat) == ("fundamental", None)
        assert "planar" in codes(found)
        found = kln.estimate_matches(x1, x2, **SIZES)
        assert (found.model, codes(found), found.R) == ("homography", [], None)
        assert found.num_inliers > 140
        exact1, exact2 = see_plane(np.eye(3), [0.8, 0.1, 0.1], noise=0.0)
        moved = np.c_[exact1, np.ones(150)] @ found.matrix.numpy().T
        error = np.median(np.linalg.norm(moved[:, :2] / moved[:, 2:] - exact2, axis=1))
        assert 0.2 < found.predicted_error / error < 5
        assert "\nmodel    homography: one homography explains" in found.summary()
        content = json.loads(json.dumps(found.as_dict(), allow_nan=False))
        assert (content["model"], content["H"]) == ("homography", found.H_mat.tolist())
        assert content["choice"]["parallax"]["wide"] == 1.0

    def test_the_pose_of_a_plane(self):
        R, t = cv2.Rodrigues(np.array([0.02, -0.05, 0.01]))[0], np.array([0.8, 0.1, 0.1])
        found = kln.estimate_matches(*see_plane(R, t), **SIZES, K1=K, K2=K)
        assert (found.model, codes(found), found.other_pose) == ("homography", [], None)
        assert np.degrees(np.arccos((np.trace(found.R.numpy().T @ R) - 1) / 2)) < 0.5
        assert found.t.numpy() @ t / np.linalg.norm(t) > np.cos(np.radians(2))
        assert found.n[2] > np.cos(np.radians(2))
        assert found.front[found.inliers].all()
        assert np.median(epipolar_distances(*see_plane(R, t, noise=0.0), found.F_mat)) < 0.5

    def test_two_poses_of_a_plane(self):
        """Of a camera that moves forwards: matches off the plane agree with the true one alone."""
        R, t = np.eye(3), np.array([0.3, 0.1, 0.8])
        plane = see_plane(R, t)
        matches = map(np.concatenate, zip(plane, see_plane(R, t, depth=4.0), strict=True))
        found, alone = (kln.estimate_matches(*v, **SIZES, K1=K, K2=K, model="homography") for v in (matches, plane))
        assert found.t.numpy() @ t / np.linalg.norm(t) > np.cos(np.radians(3))
        assert found.other_pose.t.numpy() @ t / np.linalg.norm(t) < np.cos(np.radians(6))
        assert {*found.as_dict()["other_pose"]} == {"R", "t", "n"}
        assert (codes(found), codes(alone)) == (["relief"], ["ambiguous"])
        noisy = kln.estimate_matches(*see_plane(R, t, noise=1.5), **SIZES, K1=K, K2=K)
        assert (noisy.model, codes(noisy)) == ("fundamental", ["ambiguous"])

    def test_a_camera_that_turns(self):
        R = cv2.Rodrigues(np.array([0.02, -0.1, 0.01]))[0]
        found = kln.estimate_matches(*see_plane(R, [0.0, 0, 0]), **SIZES, K1=K, K2=K)
        assert (found.model, codes(found), found.t, found.n, found.E_mat) == ("homography", [], None, None, None)
        assert np.allclose(found.R, R, atol=2e-3)

    def test_a_homography_that_is_asked_for(self):
        """Of a plane: no warning. Of a mirror with cameras: no pose."""
        found = kln.estimate_matches(*see_plane(np.eye(3), [0.8, 0.1, 0.1]), **SIZES, model="homography")
        assert (found.F_mat, found.choice.parallax.planar, found.estimator, codes(found)) == (None, True, "RANSAC", [])
        json.dumps(found.as_dict(), allow_nan=False)
        points1 = uniform(60, 2, high=400)
        points2 = points1 * torch.tensor([-1.0, 1]) + torch.tensor([400.0, 0])
        mirrored = kln.estimate_matches(points1, points2, **SIZES, K1=K, K2=K, model="homography")
        assert (codes(mirrored), mirrored.R) == (["no_pose"], None)

    def test_a_tie_between_poses(self, monkeypatch):
        nothing = torch.full((1, 3, 3), torch.nan).double()
        monkeypatch.setattr(module, "relative_pose", lambda *_: (nothing, nothing[:, 0]))
        found = kln.estimate_matches(*MATCHES, K1=SCENE.K1[0], K2=SCENE.K2[0])
        assert (found.R, found.t, found.front, codes(found)) == (None, None, None, ["no_pose"])

    def test_another_motion(self):
        other = handheld(1, 150, seeded(2), noise=0.3)
        points1, points2 = torch.cat([MATCHES[0], other.points1[0]]), torch.cat([MATCHES[1], other.points2[0]])
        ((code, text),) = kln.estimate_matches(points1, points2).warnings
        assert (code, "others on one whose pose differs by" in text) == ("ambiguous", True)
        assert codes(kln.estimate_matches(*make_matches(outliers=250))) == []  # others of no common motion

    def test_a_camera_that_stands_still(self):
        still = MATCHES[0], MATCHES[0] + 0.3 * torch.randn(200, 2, generator=seeded(3), dtype=torch.float64)
        assert "small_motion" in codes(kln.estimate_matches(*still, model="fundamental"))

    def test_order_has_no_effect(self):
        scores, order = uniform(200, seed=1), torch.randperm(200, generator=seeded(2))
        first, second = (kln.estimate_matches(*(x[o] for x in (*MATCHES, scores))) for o in (slice(None), order))
        assert torch.equal(first.F_mat, second.F_mat)
        assert first.predicted_error == second.predicted_error

    def test_rows_that_are_not_finite_or_far_away_are_left_out(self, result):
        wrong = torch.tensor([[torch.nan, 5.0], [5.0, torch.inf], [1e12, 5.0]], dtype=torch.float64)
        scores = torch.cat([torch.ones(200), torch.tensor([torch.nan, 0.5, 0.5])])
        found = kln.estimate_matches(*(torch.cat([x, wrong + i]) for i, x in enumerate(MATCHES)), scores)
        for name in ("F_mat", "num_matches", "num_inliers", "size1", "predicted_error"):
            assert torch.equal(*(torch.as_tensor(getattr(one, name)) for one in (found, result)))

    def test_arrays_of_any_number_type(self):
        points = [x.round().numpy() for x in MATCHES]
        turned = [x[::-1, ::-1].copy()[::-1, ::-1] for x in points]
        tensors = [[torch.from_numpy(x).int() for x in points], [torch.from_numpy(x).requires_grad_() for x in points]]
        for given in ([x.astype(np.int32) for x in points], turned, *tensors):
            read = module.read_matches(*given, None)
            assert all(torch.equal(found, torch.from_numpy(x)) for found, x in zip(read, points, strict=False))
            assert not any(found.requires_grad for found in read)
        assert module.read_size("size1", torch.tensor([640.0, 480.0]), MATCHES[0]) == (640, 480)
        outlier = torch.cat([MATCHES[0], torch.tensor([[5e4, -3e4]])])
        assert module.read_size("size1", None, outlier) == module.read_size("size1", None, MATCHES[0])

    def test_what_stands_still_is_left_out(self):
        overlay = uniform(60, 2, high=400)
        found = kln.estimate_matches(*(torch.cat([x, overlay]) for x in make_matches(outliers=0)))
        assert 100 < found.num_inliers <= found.num_matches <= 160

    def test_shared_points_count_once(self):
        points1, points2 = (torch.cat([torch.full((1, 2), torch.nan), points]) for points in make_matches(outliers=0))
        found = kln.estimate_matches(points1, torch.where(torch.arange(161)[:, None] < 61, points2[1:2], points2))
        assert found.num_matches == len(found.points2.unique(dim=0)) == 101
        assert torch.equal(points1[found.rows], found.points1)


def test_no_matrix():
    for points1, shift, code in [
        (torch.zeros(5, 2), 1.0, "few_matches"),
        (500 * uniform(50, 2), 0.01, "no_motion"),
        (500 * uniform(30, 2), 500 * (uniform(30, 2, seed=2) - uniform(30, 2)), "no_consensus"),
    ]:
        with pytest.raises(kln.NoReliableMatrixError) as caught:
            kln.estimate_matches(points1, points1 + shift)
        assert pickle.loads(pickle.dumps(caught.value)).code == code  # a process may have raised it


@pytest.mark.parametrize("seed", [4, 8, 13])
def test_a_plane_seen_by_known_cameras(seed):
    """Its few matches have two poses, and an essential matrix is that of either; the homography has both."""
    rng = np.random.default_rng(seed)
    R, t = cv2.Rodrigues(0.05 * rng.normal(size=3))[0], rng.normal(size=3) * [0.6, 0.2, 0.2]
    views = zip(see_plane(R, t, noise=0.0), rng.uniform(0, SIZES["size1"], (2, 12, 2)), strict=True)
    x1, x2 = (np.r_[exact[:40] + 0.3 * rng.normal(size=(40, 2)), wrong] for exact, wrong in views)
    found = kln.estimate_matches(x1, x2, **SIZES, K1=K, K2=K)
    poses = [found, *([] if found.other_pose is None else [found.other_pose])]
    assert min(pose_error(pose.R, pose.t, *map(torch.from_numpy, (R, t))) for pose in poses) < 10


def test_wrong_arguments():
    points = dict(zip(("points1", "points2"), torch.rand(2, 9, 2) * 100, strict=True))
    for changes, error, message in [
        *(({name: torch.zeros(*s)}, ValueError, "shape") for name, s in (("points1", (9, 3)), ("points2", (8, 2)))),
        ({"scores": torch.full((9,), 2.0)}, ValueError, "from 0 to 1, got 9 others, the first 2"),
        ({"points1": [[0.0, 1.0]]}, TypeError, r"points1 must be .* got <class 'list'>; numpy\.array\(points1"),
        ({"points1": np.full((9, 2), "a")}, TypeError, "points1 must be .* of <U1"),
        *(({"threshold": t}, ValueError, "threshold must be positive and at most 1000 px, got") for t in (-1.0, 1e9)),
        *(({"K1": K, "K2": K * [f, f, 1]}, ValueError, r"K2 must have positive focal .* got \[") for f in (-1, 1e30)),
        *(({"seed": n}, error, f"seed must .* got {n}") for n, error in ((-1, ValueError), (None, TypeError))),
        ({"layer": "robust"}, TypeError, "layer must be a LearnedEightPoint or None, got <class 'str'>"),
        ({"model": "affine"}, ValueError, "model must be 'auto' or 'fundamental' or 'homography', got 'affine'"),
        ({"layer": TINY, "model": "homography"}, ValueError, "layer estimates fundamental matrices: leave it out"),
        *(({"size1": s}, ValueError, rf"size1 must be a positive width .* got \({s[0]}") for s in ((0, 0), (640,))),
        ({"size1": (9, 9)}, ValueError, "of 9 points lie in the image of size1, 9 x 9 pixels: points are pixels from"),
        ({"points2": torch.rand(9, 2) * 100 - 200}, ValueError, "0 of 9 points lie in the image of size2, 2 x 2"),
        ({"points2": torch.rand(9, 2)}, ValueError, "pixels expected, got points up to"),
        ({"size1": 640}, TypeError, "size1 must be a width and a height, got 640"),
        ({"size2": (640.5, 480)}, TypeError, "width and height of size2 must be a whole number, got 640.5"),
        ({"K1": torch.eye(3)}, ValueError, "given together"),
        ({"K1": torch.eye(3), "K2": torch.eye(3)[None]}, ValueError, r"K2 must have .* got \[1, 3, 3\]"),
    ]:
        raises(error, message, kln.estimate_matches, **{**points, **changes})

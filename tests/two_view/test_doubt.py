"""The predicted error of a matrix against the true one, and reasons to doubt it or the cameras."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import epipolar_distances
from scenes import seeded

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.data.synthetic.random_matches import random_planes
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view import pair_warnings, predicted_error, random_parts
from kornia_learnnorm.two_view.camera_misfit import camera_misfit, lens_misfit
from kornia_learnnorm.two_view.pair_warnings import drop_contradiction, find_warnings, log_false_alarms
from kornia_learnnorm.two_view.solver import TwoViewSolver


def test_failed_searches_do_not_count():
    """Of 100 inliers, a matrix of a part must have 75; with fewer than four such matrices all count."""
    F_parts = torch.eye(3).double() * torch.arange(1.0, 7.0)[:, None, None]
    support = torch.tensor([110, 75, 74, 20, 90, 80])
    assert random_parts.drop_failed_parts(F_parts, support, 100)[:, 0, 0].tolist() == [1, 2, 5, 6]
    assert len(random_parts.drop_failed_parts(F_parts, support, 101)) == 6
    assert torch.equal(random_parts.drop_failed_parts(F_parts, support, 10), F_parts)


@pytest.mark.parametrize("number", [40, 200])
def test_predicted_error_is_near_the_true_one(number):
    """Of exact correspondences, over scenes: the medians agree within a factor of two."""
    generator = torch.Generator().manual_seed(number)
    exact = handheld(24, number + 200, generator, noise=0.0)
    noise = 0.5 * torch.randn(24, number, 4, generator=generator, dtype=torch.float64)
    x1, x2 = exact.points1[:, :number] + noise[..., :2], exact.points2[:, :number] + noise[..., 2:]
    rows = random_parts.draw_parts(number, number, 0)

    def solve(points1, points2):
        return kln.refine_fundamental(points1, points2, kln.find_fundamental(points1, points2)).F_mat

    F_mat, F_parts = solve(x1, x2), solve(x1[:, rows].flatten(0, 1), x2[:, rows].flatten(0, 1)).unflatten(0, (24, -1))
    predicted = [
        predicted_error.predict_error(parts, rows.shape[1], *points, F, ALL[:number], K, K).distance
        for parts, *points, F, K in zip(F_parts, x1, x2, F_mat, exact.K1, strict=True)
    ]
    true = np.median(epipolar_distances(exact.points1[:, number:], exact.points2[:, number:], F_mat), axis=-1)
    assert 0.5 < np.median(predicted) / np.median(true) < 2


def test_predicted_error_is_infinite_where_parts_have_no_matrix():
    scene = handheld(1, 50, torch.Generator().manual_seed(0), noise=0.0)
    x1, x2, F_mat, K1, K2 = (value[0] for value in (scene.points1, scene.points2, scene.F_mat, scene.K1, scene.K2))
    found = predicted_error.predict_error(torch.zeros(12, 3, 3).double(), 40, x1, x2, F_mat, ALL[:50], K1, K2)
    assert found.distance == math.inf
    assert found.angle > 100


SIZE = (640, 480)
ALL = torch.ones(200, dtype=torch.bool)
MOST = torch.arange(100) < 80


def codes(points1, points2, inliers, angle=0.1) -> list[str]:
    found = find_warnings(points1, points2, inliers, 1.0, SIZE, angle)
    assert all(warning.text and "\n" not in warning.text for warning in found)
    return [warning.code for warning in found]


def test_warnings():
    rng = np.random.default_rng(0)
    points1, points2 = (torch.from_numpy(rng.uniform([0, 0], SIZE, (100, 2))) for _ in range(2))
    assert codes(points1, points2, MOST) == []
    assert codes(points1, points2, torch.arange(100) < 12) == ["few_inliers", "chance"]
    assert codes(points1, points2, MOST, angle=20.0) == ["unstable"]
    assert codes(points1 * torch.tensor([1.0, 0.01]), points2, ALL[:100]) == ["clustered"]


def test_support_that_chance_would_give():
    """By hand for 12 of 100 in 1226 x 370: 10^(15.0 + 2.9 + 2.0 - 5 * 2.25) models expected, far more than one.

    For 9 of 100 in 640 x 480, 10^(12.3 + 2.1 + 2.0 - 5 * 4.99) homographies from four matches are expected.
    """
    found = [log_false_alarms(100, inliers, 1.0, (1226, 370)) for inliers in (12, 16, 29, 60)]
    assert [value > -2 for value in found] == [True, True, False, False]
    assert found[0] == pytest.approx(15.02 + 2.90 + 1.97 - 5 * 2.248, abs=0.02)
    found = log_false_alarms(100, 9, 1.0, SIZE, "homography")
    assert found == pytest.approx(12.28 + 2.10 + 1.98 - 5 * 4.990, abs=0.02)


def test_false_samples():
    """No less than the binomial tail, summed term by term, and small where the tail is."""
    strip, others = 2 * 800 / (640 * 480), 300 - 8
    for inliers in (12, 18, 24):
        terms = [math.comb(others, k) * strip**k * (1 - strip) ** (others - k) for k in range(inliers - 8, others)]
        value, exact = pair_warnings.log_false_samples(300, inliers, 1.0, (640, 480)), math.log10(50_000 * sum(terms))
        assert exact < value < exact + 1
    assert pair_warnings.log_false_samples(5, 0, 1.0, (640, 480)) > 0


@pytest.mark.parametrize("number", [40, 200])
def test_of_homographies(number):
    """The medians of exact points that are moved agree within a factor of two; no pose has a zero angle."""
    generator = torch.Generator().manual_seed(number)
    exact = random_planes(24, 1, 2 * number, generator)
    truth, H_true = exact.exact1, kln.find_homography(exact.exact1, exact.exact2)
    noise = 0.5 * torch.randn(24, number, 4, generator=generator, dtype=torch.float64)
    x1, x2 = exact.exact1[:, :number] + noise[..., :2], exact.exact2[:, :number] + noise[..., 2:]
    rows = random_parts.draw_parts(number, number, 0)
    H_mat = kln.find_homography(x1, x2)
    H_parts = kln.find_homography(x1[:, rows].flatten(0, 1), x2[:, rows].flatten(0, 1)).unflatten(0, (24, -1))
    found = [
        predicted_error.predict_transfer_error(parts, rows.shape[1], points1, H, ALL[:number])
        for parts, points1, H in zip(H_parts, x1, H_mat, strict=True)
    ]
    moved = [np.dstack([truth, np.ones(truth.shape[:2])]) @ H.mT.numpy() for H in (H_mat, H_true)]
    error = np.linalg.norm(moved[0][..., :2] / moved[0][..., 2:] - moved[1][..., :2] / moved[1][..., 2:], axis=-1)
    assert 0.5 < np.median([one.distance for one in found]) / np.median(error[:, :number]) < 2
    assert {one.angle for one in found} == {0.0}


def test_angles_of_homographies():
    """Half of the matches have as large an error as what they differ by from all."""
    about = torch.eye(3).double().repeat(3, 1, 1), 50, torch.rand(100, 2).double(), torch.eye(3).double(), ALL[:100]
    assert predicted_error.predict_transfer_error(*about, torch.tensor([1.0, 2.0, 180.0])) == (0.0, 2.0)


SCENE = handheld(1, 300, seeded(), noise=0.3)
K, F_MAT, POINTS = SCENE.K1[0], SCENE.F_mat[0], (SCENE.points1[0], SCENE.points2[0])
CAMERA_SIZE = tuple(SCENE.image_size[0].int().tolist())


def with_focal(factor: float) -> torch.Tensor:
    return K @ torch.diag(torch.tensor([factor, factor, 1.0], dtype=torch.float64))


def test_warnings_of_an_estimate():
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    for K1, K2, text in [
        (K, K, None),
        (with_focal(1.1), with_focal(1.1), None),  # which they contradict too, but the pose hardly changes
        (with_focal(1.5), with_focal(1.5), "the matches contradict K1 and K2: without them the pose"),
        (with_focal(2.0), K, "the matches contradict K1 and K2: without them 2"),  # 217 of 300 agree
    ]:
        found = kln.estimate_matches(*POINTS, size1=CAMERA_SIZE, size2=CAMERA_SIZE, K1=K1, K2=K2)
        warned = [warning.text for warning in found.warnings if warning.code == "cameras"]
        assert len(warned) == (text is not None)
        assert text is None or text in warned[0]
        assert len(drop_contradiction(found.warnings)) == len(found.warnings) - ("contradict" in str(text))


def test_samples_with_cameras_are_those_that_the_support_without_them_takes():
    solver = TwoViewSolver(*POINTS, torch.ones(300), 1.0, 0, cameras=(K, K))
    assert [solver.limit_samples(free).max_samples for free in (0, 150, 300)] == [50_000, 895, 24]


def test_cameras_that_cannot_be():
    scaled = [torch.diag(torch.tensor([x, y, 1.0])).double() @ K for x, y in ((2.0, 2.0), (1.0, 2.9))]
    for camera, text in [
        (scaled[0], "the principal point of K2 is at 100% of the width"),
        (scaled[1], "px, which is implausible"),
        (with_focal(1e6), "px, which is implausible"),
        (torch.eye(3), "K2 has the focal lengths 1 and 1 px, too short for these points"),
        *((centre, None) for centre in ((320, 240), (420, 300))),  # a cropped or shifted image
        *((centre, "K2") for centre in ((640, 480), (160, 120), (320, 500))),  # twice or half the size, outside
    ]:
        if isinstance(camera, tuple):
            camera = torch.tensor([[600.0, 0, camera[0]], [0, 600, camera[1]], [0, 0, 1]])
        doubt = pair_warnings.find_camera_doubt((K, camera), (None, CAMERA_SIZE), *POINTS, None, 1.0)
        assert [text in warning.text for warning in doubt] == ([] if text is None else [True])
    for scale in (0.5, 1.0, 2.0):  # of images of unknown size
        camera = torch.diag(torch.tensor([scale, scale, 1.0])).double() @ K
        assert bool(pair_warnings.find_camera_doubt((K, camera), (None, None), *POINTS, None, 1.0)) == (scale != 1)


@pytest.fixture(scope="module")
def misfit():
    return camera_misfit(*POINTS, F_MAT, 1.0, (with_focal(1.3),) * 2)


class TestCameraMisfit:
    def test_against_the_distances_to_both_matrices(self):
        """Wrong cameras add what the squared distances to the essential matrix have more, over the inliers."""
        cameras = (with_focal(1.2),) * 2
        points, E_mat = [x[None] for x in POINTS], (cameras[1].mT @ F_MAT @ cameras[0])[None]
        tied = kln.refine_essential(*points, E_mat, *cameras).F_mat
        free = kln.refine_fundamental(*points, F_MAT[None]).F_mat
        more, less = (kln.sampson_distance(*points, F_mat)[0].square() for F_mat in (tied, free))
        found, log_chance, angle = camera_misfit(*POINTS, F_MAT, 30.0, cameras)  # so that all count alike
        medians = (more.median() - less.median()).item() / 0.455
        assert found == pytest.approx(min((more - less).mean().item(), medians) ** 0.5, rel=0.05)
        assert log_chance < -20
        poses = [kln.relative_pose(F_mat, *(K[None] for K in cameras), *points) for F_mat in (tied, free)]
        assert angle == pytest.approx(pose_error(*poses[0], *poses[1]).item(), abs=0.2)

    def test_false_matches_that_agree_do_not_count(self):
        other = handheld(1, 100, seeded(5), noise=0.3)
        points = (torch.cat([x, y[0]]) for x, y in zip(POINTS, (other.points1, other.points2), strict=True))
        assert camera_misfit(*points, F_MAT, 1.0, (K, K))[0] < 0.03

    def test_few_matches_tell_nothing(self):
        options = F_MAT, 1.0, (with_focal(1.4),) * 2
        assert camera_misfit(*(x[:12] for x in POINTS), *options)[1] > -3
        assert camera_misfit(*(x[:8] for x in POINTS), *options) == (0.0, 0.0, 0.0)

    @given(scale=st.floats(0.2, 5))
    def test_has_the_unit_of_the_points(self, misfit, scale):
        S = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        F_mat = torch.linalg.inv(S) @ F_MAT @ torch.linalg.inv(S)
        found = camera_misfit(*(scale * x for x in POINTS), F_mat, scale, (S @ with_focal(1.3),) * 2)
        assert found == pytest.approx((scale * misfit[0], *misfit[1:]), rel=1e-3)


@pytest.mark.parametrize("k1", [-0.25, 0.0, 0.15])
def test_lens_misfit(k1):
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    rays = [(torch.nn.functional.pad(x, (0, 1), value=1.0) @ torch.linalg.inv(K).mT).numpy() for x in POINTS]
    bent = [cv2.projectPoints(x, *np.zeros((2, 3)), K.numpy(), np.array([k1, 0, 0, 0]))[0][:, 0] for x in rays]
    found = kln.estimate_matches(*bent, size1=CAMERA_SIZE, size2=CAMERA_SIZE, K1=K, K2=K)
    misfit, estimate = lens_misfit(*map(torch.from_numpy, bent), found.F_mat, 1.0, (2 * K, K))
    assert estimate == pytest.approx(k1, abs=0.04)
    assert misfit.angle == pytest.approx(pose_error(found.R, found.t, SCENE.R[0], SCENE.t[0]).item(), abs=2)
    text = f"the matches contradict K1 and K2: with a lens distortion of about k1 = {estimate:.2g} the pose differs by"
    assert [warning.text.startswith(text) for warning in found.warnings] == [True] * (k1 != 0)
    assert lens_misfit(*(x[:7] for x in POINTS), F_MAT, 1.0, (K, K)) == ((0.0, 0.0, 0.0), 0.0)

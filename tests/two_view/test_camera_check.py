"""Cameras that their matches contradict, and those of another image size."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import seeded

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.two_view.camera_check import (
    camera_misfit,
    drop_contradiction,
    find_camera_doubt,
    is_of_other_size,
)

SCENE = handheld(1, 300, seeded(), noise=0.3)
K, F_MAT, POINTS = SCENE.K1[0], SCENE.F_mat[0], (SCENE.points1[0], SCENE.points2[0])
SIZE = tuple(SCENE.image_size[0].int().tolist())


def with_focal(factor: float) -> torch.Tensor:
    return K @ torch.diag(torch.tensor([factor, factor, 1.0], dtype=torch.float64))


def test_warnings_of_an_estimate():
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    for camera, text in [
        (K, None),
        (with_focal(1.02), None),
        (with_focal(1.5), "the matches contradict K1 and K2"),
        (torch.diag(torch.tensor([2.0, 2, 1])).double() @ K, "the principal point of K1 is at 100% of the width"),
    ]:
        found = kln.estimate_matches(*POINTS, size1=SIZE, size2=SIZE, K1=camera, K2=camera)
        warned = [warning.text for warning in found.warnings if warning.code == "cameras"]
        assert len(warned) == (text is not None)
        assert text is None or text in warned[0]
        assert len(drop_contradiction(found.warnings)) == len(found.warnings) - ("contradict" in str(text))


def test_principal_points():
    for centre, expected in [
        ((320, 240), False),
        ((420, 300), False),  # a cropped or shifted image
        ((640, 480), True),  # twice the size
        ((160, 120), True),  # half of it
        ((320, 500), True),  # outside
    ]:
        camera = torch.tensor([[600.0, 0, centre[0]], [0, 600, centre[1]], [0, 0, 1]])
        assert is_of_other_size(camera, (640, 480)) == expected
        doubt = find_camera_doubt((K, camera), (None, (640, 480)), *POINTS, None, 1.0)
        assert ["K2" in warning.text for warning in doubt] == [True] * expected


class TestCameraMisfit:
    def test_against_the_distances_to_both_matrices(self):
        """Wrong cameras add what the squared distances to the essential matrix have more, over the inliers."""
        cameras = (with_focal(1.2),) * 2
        points, E_mat = [x[None] for x in POINTS], (cameras[1].mT @ F_MAT @ cameras[0])[None]
        tied = kln.refine_essential(*points, E_mat, *cameras).F_mat
        free = kln.refine_fundamental(*points, F_MAT[None]).F_mat
        more, less = (kln.sampson_distance(*points, F_mat)[0].square() for F_mat in (tied, free))
        found, log_chance = camera_misfit(*POINTS, F_MAT, 30.0, cameras)  # so that all count alike
        medians = (more.median() - less.median()).item() / 0.455
        assert found == pytest.approx(min((more - less).mean().item(), medians) ** 0.5, rel=0.05)
        assert log_chance < -20

    def test_grows_with_the_error_of_the_focal_length(self):
        found = [camera_misfit(*POINTS, F_MAT, 1.0, (with_focal(f),) * 2) for f in (1.0, 1.1, 1.2, 1.4)]
        assert found == sorted(found, key=lambda pair: (pair[0], -pair[1]))
        assert found[0][1] > -3

    def test_false_matches_that_agree_do_not_count(self):
        """A third as many, of another motion."""
        other = handheld(1, 100, seeded(5), noise=0.3)
        points = (torch.cat([x, y[0]]) for x, y in zip(POINTS, (other.points1, other.points2), strict=True))
        assert camera_misfit(*points, F_MAT, 1.0, (K, K))[0] < 0.03

    def test_few_matches_tell_nothing(self):
        cameras = (with_focal(1.4),) * 2
        assert camera_misfit(*(x[:12] for x in POINTS), F_MAT, 1.0, cameras)[1] > -3
        assert camera_misfit(*(x[:8] for x in POINTS), F_MAT, 1e-6, cameras) == (0.0, 0.0)

    @given(scale=st.floats(0.2, 5))
    def test_has_the_unit_of_the_points(self, scale):
        S = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        F_mat = torch.linalg.inv(S) @ F_MAT @ torch.linalg.inv(S)
        found = camera_misfit(*(scale * x for x in POINTS), F_mat, scale, (S @ with_focal(1.3),) * 2)
        misfit, log_chance = camera_misfit(*POINTS, F_MAT, 1.0, (with_focal(1.3),) * 2)
        assert found == pytest.approx((scale * misfit, log_chance), rel=1e-3)

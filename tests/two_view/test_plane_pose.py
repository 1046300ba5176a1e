"""Poses of homographies, against those that they were made of."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_learnnorm.two_view.plane_pose import PlanePose, angle_between, plane_poses

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")

K1, K2 = (torch.tensor([[f, 0, 320.0], [0, f, 240.0], [0, 0, 1]]).double() for f in (600.0, 700.0))
R = torch.from_numpy(cv2.Rodrigues(np.array([0.05, -0.1, 0.03]))[0])
N = torch.tensor([0.2, -0.1, 1.0]).double() / 1.05**0.5
SIDEWAYS, FORWARDS = torch.tensor([0.5, 0.1, 0.1]).double(), torch.tensor([0.1, 0.0, 0.6]).double()


def seen(t: torch.Tensor, scale: float = 1.0) -> tuple[torch.Tensor, ...]:
    """The homography of the plane N^T X = 5, the cameras and the pixels of points on it."""
    H_mat = K2 @ (R + torch.outer(t, N) / 5) @ torch.linalg.inv(K1)
    x1 = torch.from_numpy(np.random.default_rng(0).uniform([0, 0, 1], [640, 480, 1], (50, 3)))
    rays = x1 @ torch.linalg.inv(K1).mT
    x2 = (5 * rays / (rays @ N)[:, None] @ R.mT + t) @ K2.mT
    return scale * H_mat, K1, K2, x1[:, :2], x2[:, :2] / x2[:, 2:]


@given(scale=st.floats(0.01, 100), sign=st.sampled_from([-1, 1]))
def test_a_plane(scale, sign):
    """One pose where the camera moves sideways, since the other plane would cross the image; of any scale and sign."""
    (pose,) = plane_poses(*seen(SIDEWAYS, sign * scale))
    for found, true in zip(pose, (R, SIDEWAYS / SIDEWAYS.norm(), N), strict=True):
        torch.testing.assert_close(found, true, rtol=0, atol=1e-9)


def test_two_poses_of_a_camera_that_moves_forwards():
    H_mat, *others = seen(FORWARDS)
    poses = plane_poses(H_mat, *others)
    assert len(poses) == 2
    assert min(angle_between(PlanePose(R, FORWARDS, N), [pose]) for pose in poses) < 1e-6
    normalized = torch.linalg.inv(K2) @ H_mat @ K1
    for pose in poses:  # both give the homography
        rest = normalized / torch.linalg.svdvals(normalized)[1] - pose.R
        torch.testing.assert_close(torch.outer(pose.t, pose.n) * (pose.t @ rest @ pose.n), rest, rtol=0, atol=1e-9)


def test_matrices_of_a_pose():
    (pose,) = plane_poses(*seen(SIDEWAYS))
    x1, x2 = (np.c_[x, np.ones(50)] for x in seen(SIDEWAYS)[3:])
    assert np.abs(np.einsum("ni,ij,nj->n", x2, pose.fundamental(K1, K2).numpy(), x1)).max() < 1e-9
    assert np.allclose(np.linalg.svd(pose.essential().numpy())[1], [0.5**0.5, 0.5**0.5, 0])


@pytest.mark.parametrize("baseline", [0.0, 0.002])
def test_a_rotation(baseline):
    (pose,) = plane_poses(*seen(baseline * SIDEWAYS, -2.0))
    assert (pose.t, pose.n) == (None, None)
    assert torch.linalg.det(pose.R) == pytest.approx(1)
    assert angle_between(PlanePose(R), [pose]) < 0.02


def test_no_pose():
    """Of a mirror, which no two cameras see of one side of a plane."""
    H_mat, *cameras, x1, _ = seen(SIDEWAYS)
    assert plane_poses(torch.diag(torch.tensor([-1.0, 1, 1])).double() @ H_mat, *cameras, x1, x1) == []


def test_angle_to_the_nearest_pose():
    turned = torch.from_numpy(cv2.Rodrigues(np.array([0, 0, np.deg2rad(30)]))[0]) @ R
    pose = PlanePose(R, SIDEWAYS, N)
    assert angle_between(pose, [PlanePose(turned, SIDEWAYS, N), PlanePose(R)]) == pytest.approx(30)
    assert angle_between(PlanePose(R), [PlanePose(turned)]) == pytest.approx(30)
    assert angle_between(pose, []) == angle_between(pose, [PlanePose(R)]) == 180

"""Relative poses against ground truth and Kornia's triangulation."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.geometry.epipolar import essential_from_fundamental, motion_from_essential_choose_solution
from references import cross
from scenes import SCENES, raises, scenes, uniform

from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import pose_error

INF, NAN = float("inf"), float("nan")


def pair(name="handheld", *args, **options):
    """What relative_pose takes, of scenes whose second camera has pixels of half the size, and the true pose."""
    scene = scenes(name, *args, **options)
    double = torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64).diag()
    F = double.inverse() @ scene.F_mat
    return (F, scene.K1, double @ scene.K2, scene.points1, 2 * scene.points2), (scene.R, scene.t)


class TestRelativePose:
    @pytest.mark.parametrize("name", SCENES)
    def test_exact_correspondences(self, name, device):
        arguments, truth = pair(name, 20, 30)
        R, t = relative_pose(*(value.to(device) for value in arguments))
        assert pose_error(R.cpu(), t.cpu(), *truth).max() < 1e-6
        torch.testing.assert_close((t.norm(dim=-1).cpu(), torch.linalg.det(R).cpu()), (torch.ones(20).double(),) * 2)

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_noise_and_outliers_against_kornias_triangulation(self, name):
        arguments, _ = pair(name, 8, 50, noise=0.5, outliers=0.3)
        F, *rest = arguments
        expected = motion_from_essential_choose_solution(essential_from_fundamental(F, *rest[:2]), *rest)[:2]
        torch.testing.assert_close(relative_pose(*arguments), (expected[0], expected[1][..., 0]), rtol=0, atol=1e-8)

    @given(st.integers(0, 2**31), st.sampled_from([-1.0, 1e-9, -1e9]))
    def test_what_does_not_matter(self, seed, factor):
        (F, *rest), _ = pair("handheld", 4, 25, seed, noise=1.0, outliers=0.4)
        K1, K2, points1, points2 = rest
        R, t = relative_pose(F, *rest)
        order = torch.randperm(25, generator=torch.Generator().manual_seed(seed))
        scaled = relative_pose(factor * F, 2 * K1, 1e-3 * K2, points1, points2)
        for found in (scaled, relative_pose(F, K1, K2, points1[:, order], points2[:, order])):
            torch.testing.assert_close(found, (R, t), rtol=0, atol=1e-8, equal_nan=True)
        back = relative_pose(F.mT, K2, K1, points2, points1)  # the way from the second camera to the first
        expected = (R.mT, -(R.mT @ t[..., None])[..., 0])
        torch.testing.assert_close(back, expected, rtol=0, atol=1e-8, equal_nan=True)

    def test_mask(self):
        arguments, truth = pair("handheld", 6, 40)
        arguments[4][:, :30] = arguments[4][:, :30].flip(1) + 300  # three quarters are wrong
        mask = torch.arange(40).expand(6, 40) >= 30
        assert pose_error(*relative_pose(*arguments, mask=mask), *truth).max() < 1e-6
        arguments[4][:, :30] = NAN
        assert pose_error(*relative_pose(*arguments, mask=mask), *truth).max() < 1e-6
        assert torch.cat([v.flatten() for v in relative_pose(*arguments, mask=mask & False)]).isnan().all()

    def test_failures_leave_the_others_alone(self):
        (F, *rest), truth = pair("orbit", 6, 20)
        vector = torch.tensor([[1.1], [2.3], [3.7]], dtype=torch.float64)
        F[0], F[1], F[2], F[3, 0, 0] = NAN, 0.0, vector @ vector.mT, INF
        mask = torch.ones(6, 20, dtype=torch.bool)
        mask[4] = False
        R, t = relative_pose(F, *rest, mask=mask)
        assert torch.cat([R[:5].flatten(), t[:5].flatten()]).isnan().all()
        assert relative_pose(*(value.float() for value in (F, *rest)), mask=mask)[0][:5].isnan().all()
        error = pose_error(R, t, *truth)
        assert (error[:5] == INF).all()
        assert error[5] < 1e-6

    def test_a_tie_is_no_pose(self):
        """Points seen after a step forward and after one back have the same epipolar lines."""
        X, t = uniform(1, 9, 3) + torch.tensor([0.0, 0.0, 5.0]), torch.tensor([[0.1, 0.2, 1.0]]).double()
        seen = [(Y / Y[..., 2:])[..., :2] for Y in (X, X + t, X - t)]
        points1, points2 = torch.cat([seen[0], seen[0]], 1), torch.cat(seen[1:], 1)
        K, F = torch.eye(3).double(), torch.from_numpy(cross(t[0].numpy()))[None]
        assert relative_pose(F, K, K, points1, points2)[1].isnan().all()
        for part, sign in ((slice(10), 1.0), (slice(-10, None), -1.0)):
            assert pose_error(*relative_pose(F, K, K, points1[:, part], points2[:, part]), K[None], sign * t) < 1e-6

    def test_exceptions(self):
        for change, error, message in [
            (lambda F, K1, K2, a, b: (F.int(), K1, K2, a, b), TypeError, "F_mat must be .* got torch.int32"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a.half(), b), TypeError, "points1 must be .* got torch.float16"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a.tolist(), b), TypeError, "points1 must be .* <class 'list'>"),
            (lambda F, K1, K2, a, b: (F[0], K1, K2, a, b), ShapeError, "shape"),
            (lambda F, K1, K2, a, b: (F, K1[:, :2], K2, a, b), ValueError, "shape"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a[:, :9], b), ValueError, "must pair up"),
            (lambda F, K1, K2, a, b: (F, K1[:2], K2, a, b), ValueError, r"K1 must have shape .* got \[2, 3, 3\]"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a, b, a[..., 0]), TypeError, "mask must be a boolean tensor"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a, b, a[0] > 0), ValueError, r"shape \[3, 10\] .*got \[10, 2\]"),
            (lambda F, K1, K2, a, b: (F, K1.long(), K2, a, b), TypeError, "K1 must be a floating-point .*int64"),
            (lambda F, K1, K2, a, b: (F, 0 * K1, K2, a, b), ValueError, "K1 must be finite and invertible"),
            (lambda F, K1, K2, a, b: (F, NAN * K1, K2, a, b), ValueError, r"K1 must be finite .* got \[\[nan"),
            (lambda F, K1, K2, a, b: (F, -K1, K2, a, b), ValueError, "^K1 .*got -0 -0 -1; transposed"),
            (lambda F, K1, K2, a, b: (F, K1, K2.mT.requires_grad_(), a, b), ValueError, "^K2 .* 1; transposed"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a[:2], b[:2]), ValueError, "one matrix per set .* 3 .* 2 sets"),
        ]:
            raises(error, message, relative_pose, *change(*pair("orbit", 3, 10)[0]))

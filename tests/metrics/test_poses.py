"""Relative poses against OpenCV and triangulation in NumPy, angles by construction, recall curves by hand."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from two_view import SCENES, homogeneous, scenes

from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import (
    mean_average_accuracy,
    pose_auc,
    pose_error,
    rotation_error,
    translation_error,
)

INF, NAN = float("inf"), float("nan")


def pair(name="handheld", *args, **options):
    """What relative_pose takes, of scenes whose second camera has pixels of half the size, and the true pose."""
    scene = scenes(name, *args, **options)
    double = torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64).diag()
    F = double.inverse() @ scene.F_mat
    return (F, scene.K1, double @ scene.K2, scene.points1, 2 * scene.points2), (scene.R, scene.t)


def triangulated_pose(F, K1, K2, points1, points2):
    """Try all four poses: linear triangulation of each correspondence, count of positive depths."""
    U, _, Vh = np.linalg.svd(K2.T @ F @ K1)
    U, Vh = U * np.sign(np.linalg.det(U)), Vh * np.sign(np.linalg.det(Vh))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rays1, rays2 = (homogeneous(p) @ np.linalg.inv(K).T for p, K in ((points1, K1), (points2, K2)))
    best = (-1, None, None)
    for R in (U @ W @ Vh, U @ W.T @ Vh):
        for t in (U[:, 2], -U[:, 2]):
            P, count = np.column_stack([R, t]), 0
            for a, b in zip(rays1, rays2, strict=True):
                rows = [a[0] * np.eye(4)[2] - np.eye(4)[0], a[1] * np.eye(4)[2] - np.eye(4)[1]]
                X = np.linalg.svd(np.stack([*rows, b[0] * P[2] - P[0], b[1] * P[2] - P[1]]))[2][-1]
                count += X[2] / X[3] > 0 and P[2] @ X / X[3] > 0
            best = max(best, (count, R, t), key=lambda found: found[0])
    return best[1:]


class TestRelativePose:
    @pytest.mark.parametrize("name", SCENES)
    def test_exact_correspondences(self, name, device):
        arguments, truth = pair(name, 20, 30)
        R, t = relative_pose(*(value.to(device) for value in arguments))
        assert pose_error(R.cpu(), t.cpu(), *truth).max() < 1e-6
        assert torch.allclose(t.norm(dim=-1).cpu(), torch.ones(20).double())
        assert torch.allclose(torch.linalg.det(R).cpu(), torch.ones(20).double())

    @pytest.mark.parametrize("name", SCENES)
    def test_opencv(self, name):
        cv2 = pytest.importorskip("cv2")
        scene = scenes(name, 10, 30)
        R, t = relative_pose(scene.F_mat, scene.K1, scene.K2, scene.points1, scene.points2)
        for k in range(10):
            K, points1, points2 = (v[k].numpy() for v in (scene.K1, scene.points1, scene.points2))
            found = cv2.recoverPose(K.T @ scene.F_mat[k].numpy() @ K, points1, points2, K, distanceThresh=1e9)
            np.testing.assert_allclose(R[k].numpy(), found[1], atol=1e-8)
            np.testing.assert_allclose(t[k].numpy(), found[2][:, 0], atol=1e-8)

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_noise_and_outliers_against_triangulation(self, name):
        arguments, _ = pair(name, 8, 50, noise=0.5, outliers=0.3)
        R, t = relative_pose(*arguments)
        for k in range(8):
            expected = triangulated_pose(*(value[k].numpy() for value in arguments))
            np.testing.assert_allclose(R[k].numpy(), expected[0], atol=1e-8)
            np.testing.assert_allclose(t[k].numpy(), expected[1], atol=1e-8)

    @given(st.integers(0, 2**31), st.sampled_from([-1.0, 1e-9, -1e9]))
    def test_what_does_not_matter(self, seed, factor):
        (F, *rest), _ = pair("handheld", 4, 25, seed, noise=1.0, outliers=0.4)
        K1, K2, points1, points2 = rest
        R, t = relative_pose(F, *rest)
        order = torch.randperm(25, generator=torch.Generator().manual_seed(seed))
        for found in (relative_pose(factor * F, *rest), relative_pose(F, K1, K2, points1[:, order], points2[:, order])):
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
        vector = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
        F[0], F[1], F[2], F[3, 0, 0] = NAN, 0.0, vector @ vector.mT, INF
        mask = torch.ones(6, 20, dtype=torch.bool)
        mask[4] = False
        R, t = relative_pose(F, *rest, mask=mask)
        assert R[:5].isnan().all()
        assert t[:5].isnan().all()
        error = pose_error(R, t, *truth)
        assert (error[:5] == INF).all()
        assert error[5] < 1e-6

    def test_a_tie_is_no_pose(self):
        """Points seen after a step forward and after one back have the same epipolar lines."""
        X = torch.rand(1, 9, 3, generator=torch.Generator().manual_seed(0)).double() + torch.tensor([0.0, 0.0, 5.0])
        t = torch.tensor([[0.1, 0.2, 1.0]]).double()
        seen = [(Y / Y[..., 2:])[..., :2] for Y in (X, X + t, X - t)]
        points1, points2 = torch.cat([seen[0], seen[0]], 1), torch.cat(seen[1:], 1)
        K = torch.eye(3).double()[None]
        F = torch.tensor([[[0.0, -1.0, 0.2], [1.0, 0.0, -0.1], [-0.2, 0.1, 0.0]]]).double()  # [t]x
        assert relative_pose(F, K, K, points1, points2)[1].isnan().all()
        for number, sign in ((10, 1.0), (9, 1.0), (-9, -1.0), (-10, -1.0)):
            part = slice(0, number) if number > 0 else slice(number, None)
            R, found = relative_pose(F, K, K, points1[:, part], points2[:, part])
            assert pose_error(R, found, K, sign * t) < 1e-6

    def test_float32(self):
        arguments, truth = pair("orbit", 6, 20)
        R, t = relative_pose(*(value.float() for value in arguments))
        assert R.dtype == t.dtype == torch.float32
        assert pose_error(R.double(), t.double(), *truth).max() < 0.05

    @pytest.mark.parametrize("batch_size", [0, 1])
    def test_small_batches(self, batch_size):
        arguments, _ = pair("orbit", 1, 20)
        R, t = relative_pose(*(value[:batch_size] for value in arguments))
        assert R.shape == (batch_size, 3, 3)
        assert t.shape == (batch_size, 3)

    @pytest.mark.parametrize(
        ("change", "error", "message"),
        [
            (lambda F, K1, K2, a, b: (F.int(), K1, K2, a, b), TypeError, "F_mat must be .* got torch.int32"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a.tolist(), b), TypeError, "points1 must be .* <class 'list'>"),
            (lambda F, K1, K2, a, b: (F[0], K1, K2, a, b), ShapeError, "shape"),
            (lambda F, K1, K2, a, b: (F, K1[:, :2], K2, a, b), ShapeError, "shape"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a[:, :9], b), ValueError, "must pair up"),
            (lambda F, K1, K2, a, b: (F, K1[:1], K2, a, b), ValueError, "one batch, got {'F_mat': 3, 'K1': 1"),
            (lambda F, K1, K2, a, b: (F, K1, K2, a, b, a[..., 0]), TypeError, "mask must be a boolean tensor"),
            (
                lambda F, K1, K2, a, b: (F, K1, K2, a, b, a[0] > 0),
                ValueError,
                r"must have shape \[3, 10\], got \[10, 2\]",
            ),
            (lambda F, K1, K2, a, b: (F, 0 * K1, K2, a, b), torch.linalg.LinAlgError, "singular"),
        ],
    )
    def test_exceptions(self, change, error, message):
        with pytest.raises(error, match=message):
            relative_pose(*change(*pair("orbit", 3, 10)[0]))

    def test_real_correspondences(self):
        folder = os.environ.get("LEARNNORM_DATA")
        if not folder:
            pytest.skip("LEARNNORM_DATA does not name a folder of real correspondences")
        store = read_store(f"{folder}/correspondences/kitti_06.h5@0:10")
        truth = [torch.tensor(value) for value in (store.R, store.t)]
        for i in range(len(store)):
            rows = slice(store.offsets[i], store.offsets[i + 1])
            F, K1, K2 = (torch.tensor(value)[None] for value in (store.F[i], store.K[i, 0], store.K[i, 1]))
            points1, points2 = (torch.tensor(value[rows])[None] for value in (store.points1, store.points2))
            R, t = relative_pose(F, K1, K2, points1, points2)
            assert pose_error(R, t, *(value[i : i + 1] for value in truth)) < 1e-3


def rotations(degrees, seed=0):
    """Random rotations, and others by so many degrees from them."""
    generator = torch.Generator().manual_seed(seed)
    axes, start = torch.randn(2, len(degrees), 3, generator=generator, dtype=torch.float64).unbind(0)
    axes = axes / axes.norm(dim=-1, keepdim=True) * torch.deg2rad(degrees)[:, None]
    R = axis_angle_to_rotation_matrix(start)
    return axis_angle_to_rotation_matrix(axes) @ R, R


ANGLES = torch.tensor([0.0, 1e-10, 1e-6, 1e-3, 1.0, 45.0, 90.0, 120.0, 179.0, 179.999, 180 - 1e-6, 180.0]).double()


class TestAngles:
    def test_rotations_near_0_and_180(self):
        angles = torch.cat([ANGLES, 180 - torch.logspace(-9, 0, 10, dtype=torch.float64)])
        torch.testing.assert_close(rotation_error(*rotations(angles)), angles, rtol=0, atol=1e-12)

    def test_an_arc_cosine_would_not_do(self):
        R, R_true = rotations(torch.tensor([1e-7], dtype=torch.float64))
        cosine = ((R @ R_true.mT).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
        assert abs(torch.rad2deg(cosine.clamp(max=1).acos()) - 1e-7) > 1e-8
        assert abs(rotation_error(R, R_true) - 1e-7) < 1e-12

    @given(st.floats(0, 180), st.integers(0, 2**31))
    def test_rotation_symmetries(self, angle, seed):
        R, R_true = rotations(torch.tensor([angle], dtype=torch.float64), seed)
        for found in ((R, R_true), (R_true, R), (R.mT @ R_true, torch.eye(3).double()), (R @ R, R_true @ R)):
            assert rotation_error(*found).item() == pytest.approx(angle, abs=1e-10)

    def test_translations(self):
        radians = torch.deg2rad(ANGLES)
        t = torch.stack([radians.cos(), radians.sin(), 0 * radians], -1)
        R = rotations(ANGLES)[1][0]
        for scale in (1.0, 1e-6, 1e6):
            found = translation_error(scale * t @ R.mT, 3 * R[:, 0])
            torch.testing.assert_close(found, ANGLES, rtol=0, atol=1e-12)
            torch.testing.assert_close(translation_error(-scale * t @ R.mT, R[:, 0]), 180 - ANGLES, rtol=0, atol=1e-12)

    def test_no_direction(self):
        t = torch.tensor([[0.0, 0.0, 0.0], [NAN, 0.0, 1.0], [0.0, 0.0, 1.0]])
        assert translation_error(t, torch.tensor([0.0, 0.0, 1.0])).isnan().tolist() == [True, True, False]
        assert translation_error(torch.tensor([0.0, 0.0, 1.0]), t).isnan().tolist() == [True, True, False]

    def test_smoke(self, device, dtype):
        R, t = torch.eye(3, device=device, dtype=dtype).repeat(2, 5, 1, 1), torch.rand(2, 5, 3, device=device).to(dtype)
        for found in (rotation_error(R, R), translation_error(t, t), pose_error(R, t, R, t)):
            assert found.shape == (2, 5)
            assert found.dtype == dtype
            assert found.device.type == device.type
            assert (found < 1e-3).all()

    def test_exceptions(self):
        R, t = torch.eye(3), torch.ones(3)
        for call in (
            lambda: rotation_error(R[:2], R),
            lambda: rotation_error(R, R[:, :2]),
            lambda: translation_error(t[:2], t),
            lambda: translation_error(t, t[:2]),
            lambda: pose_error(R, t[:2], R, t),
        ):
            with pytest.raises(ShapeError):
                call()


class TestPoseError:
    def test_is_the_larger(self):
        R, R_true = rotations(torch.tensor([10.0, 10.0, 1.0]).double())
        t_true = torch.tensor([0.0, 0.0, 2.0]).double().expand(3, 3)
        radians = torch.deg2rad(torch.tensor([5.0, 20.0, 180.0]).double())
        t = torch.stack([radians.sin(), 0 * radians, radians.cos()], -1)
        assert pose_error(R, t, R_true, t_true).tolist() == pytest.approx([10, 20, 180])

    @pytest.mark.parametrize(
        ("R", "t", "R_true", "t_true", "expected"),
        [
            (1.0, 1.0, 1.0, 1.0, 0.0),
            (NAN, 1.0, 1.0, 1.0, INF),
            (1.0, NAN, 1.0, 1.0, INF),
            (1.0, 0.0, 1.0, 1.0, INF),
            (1.0, 1.0, NAN, 1.0, NAN),
            (1.0, 1.0, 1.0, NAN, NAN),
            (1.0, 1.0, 1.0, 0.0, NAN),
            (NAN, NAN, 1.0, 0.0, NAN),  # a failure on a pair that cannot be measured is no failure
        ],
    )
    def test_failures_and_unknown_truth(self, R, t, R_true, t_true, expected):
        found = pose_error(R * torch.eye(3), t * torch.ones(3), R_true * torch.eye(3), t_true * torch.ones(3))
        assert found.item() == pytest.approx(expected, abs=1e-4, nan_ok=True)


ERRORS = st.lists(st.one_of(st.floats(0, 30), st.integers(0, 12), st.just(INF)), min_size=1, max_size=30)


def trapezoids(errors, threshold):
    """The recall curve point by point, level behind the last error."""
    below = [error for error in sorted(errors) if error < threshold]
    recall = [i / len(errors) for i in range(len(below) + 1)]
    return np.trapezoid([*recall, recall[-1]], [0.0, *below, threshold]) / threshold


class TestPoseAUC:
    @pytest.mark.parametrize(
        ("errors", "threshold", "expected"),
        [
            ([0.0], 5, 1.0),
            ([0.0, 0.0, 0.0], 5, 1.0),
            ([INF, 7.0], 5, 0.0),
            ([5.0], 5, 0.0),  # not below
            ([2.0], 4, (2 / 2 + 2) / 4),  # up to (2, 1), then level
            ([0.0, INF], 10, 0.5),  # a failure counts
            ([4.0, 1.0], 8, (1 * 0.25 + 3 * 0.75 + 4) / 8),
            ([1.0, 3.0, INF, INF], 4, (1 * 0.125 + 2 * 0.375 + 1 * 0.5) / 4),
        ],
    )
    def test_by_hand(self, errors, threshold, expected, dtype, device):
        found = pose_auc(torch.tensor(errors, dtype=dtype, device=device), (threshold,))
        assert found == (pytest.approx(expected),)
        assert trapezoids(errors, threshold) == pytest.approx(expected)

    @given(ERRORS)
    def test_numpy(self, errors):
        found = pose_auc(torch.tensor(errors, dtype=torch.float64))
        assert found == pytest.approx(tuple(trapezoids(errors, threshold) for threshold in (5, 10, 20)))
        assert all(type(area) is float and 0 <= area <= 1 for area in found)

    @given(ERRORS, st.randoms())
    def test_order_does_not_matter(self, errors, random):
        shuffled = random.sample(errors, len(errors))
        found, expected = (pose_auc(torch.tensor(v, dtype=torch.float64)) for v in (shuffled, errors))
        assert found == pytest.approx(expected, rel=1e-12)

    @pytest.mark.parametrize("thresholds", [(0,), (5, -1), (NAN,)])
    def test_thresholds(self, thresholds):
        with pytest.raises(ValueError, match=f"a threshold must be positive, got {thresholds[-1]}"):
            pose_auc(torch.ones(3), thresholds)


class TestMeanAverageAccuracy:
    @pytest.mark.parametrize(
        ("errors", "expected"),
        [([0.0], 1.0), ([0.99], 1.0), ([1.0], 0.9), ([9.5], 0.1), ([10.0], 0.0), ([INF], 0.0), ([0.0, INF], 0.5)],
    )
    def test_by_hand(self, errors, expected, dtype, device):
        found = mean_average_accuracy(torch.tensor(errors, dtype=dtype, device=device))
        assert found == pytest.approx(expected)
        assert type(found) is float

    @given(ERRORS, st.integers(1, 25))
    def test_counting(self, errors, limit):
        expected = np.mean([np.mean([error < degrees for error in errors]) for degrees in range(1, limit + 1)])
        assert mean_average_accuracy(torch.tensor(errors, dtype=torch.float64), limit) == pytest.approx(expected)

    @given(ERRORS)
    def test_cumulative_histogram(self, errors):
        """As its authors count, who differ at exactly 10 degrees."""
        clipped = [1e6 if error in (10.0, INF) else error for error in errors]
        histogram = np.histogram(clipped, np.arange(11))[0] / len(errors)
        found = mean_average_accuracy(torch.tensor(errors, dtype=torch.float64))
        assert found == pytest.approx(histogram.cumsum().mean())

    @pytest.mark.parametrize("limit", [0, -3])
    def test_limit(self, limit):
        with pytest.raises(ValueError, match=f"limit must be one degree or more, got {limit}"):
            mean_average_accuracy(torch.ones(3), limit)


@pytest.mark.parametrize("summary", [pose_auc, mean_average_accuracy])
@pytest.mark.parametrize(
    ("errors", "message"),
    [
        (torch.rand(0), r"at least one pair, got shape \[0\]"),
        (torch.rand(3, 1), r"a \(P,\) tensor of at least one pair, got shape \[3, 1\]"),
        (torch.tensor([1.0, NAN, -1.0]), "got 2 NaN or negative ones"),
    ],
)
def test_exceptions(summary, errors, message):
    with pytest.raises(ValueError, match=message):
        summary(errors)

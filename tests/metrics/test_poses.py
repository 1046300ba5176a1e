"""Pose errors by construction, recall curves and accuracies by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from kornia_learnnorm.metrics.poses import mean_average_accuracy as maa
from kornia_learnnorm.metrics.poses import pose_auc, pose_error, rotation_error, translation_error

INF, NAN = float("inf"), float("nan")


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

    def test_smoke(self, device, dtype):
        R, t = torch.eye(3, device=device, dtype=dtype).repeat(2, 5, 1, 1), torch.rand(2, 5, 3, device=device).to(dtype)
        for found in (rotation_error(R, R), translation_error(t, t), pose_error(R, t, R, t)):
            assert (found.shape, found.dtype, found.device.type) == ((2, 5), dtype, device.type)
            assert (found < 1e-3).all()

    def test_exceptions(self):
        R, t = torch.eye(3), torch.ones(3)
        pairs = [(rotation_error, R[:2], R), (rotation_error, R, R[:, :2]), (translation_error, t[:2], t)]
        for function, *values in (*pairs, (translation_error, t, t[:2]), (pose_error, R, t[:2], R, t)):
            with pytest.raises(ShapeError):
                function(*values)


class TestPoseError:
    def test_is_the_larger(self):
        R, R_true = rotations(torch.tensor([10.0, 10.0, 1.0]).double())
        t_true = torch.tensor([0.0, 0.0, 2.0]).double().expand(3, 3)
        radians = torch.deg2rad(torch.tensor([5.0, 20.0, 180.0]).double())
        t = torch.stack([radians.sin(), 0 * radians, radians.cos()], -1)
        assert pose_error(R, t, R_true, t_true).tolist() == pytest.approx([10, 20, 180])

    def test_failures_and_unknown_truth(self):
        for R, t, R_true, t_true, expected in [
            (1.0, 1.0, 1.0, 1.0, 0.0),
            (NAN, 1.0, 1.0, 1.0, INF),
            (1.0, NAN, 1.0, 1.0, INF),
            (1.0, 0.0, 1.0, 1.0, INF),
            (1.0, 1.0, NAN, 1.0, NAN),
            (1.0, 1.0, 1.0, NAN, NAN),
            (1.0, 1.0, 1.0, 0.0, NAN),
            (NAN, NAN, 1.0, 0.0, NAN),  # a failure on a pair that cannot be measured is no failure
        ]:
            found = pose_error(R * torch.eye(3), t * torch.ones(3), R_true * torch.eye(3), t_true * torch.ones(3))
            assert found.item() == pytest.approx(expected, abs=1e-4, nan_ok=True)


ERRORS = st.lists(st.one_of(st.floats(0, 30), st.integers(0, 12), st.just(INF)), min_size=1, max_size=30)


def trapezoids(errors, threshold):
    """The recall curve point by point, level behind the last error."""
    below = [error for error in sorted(errors) if error < threshold]
    recall = [i / len(errors) for i in range(len(below) + 1)]
    heights, bounds = np.array([*recall, recall[-1]]), np.array([0.0, *below, threshold])
    return (np.diff(bounds) * (heights[1:] + heights[:-1]) / 2).sum() / threshold  # np.trapezoid needs NumPy 2


class TestPoseAUC:
    def test_by_hand(self, dtype, device):
        """Up to (1, 1 / 4), then to (4, 1 / 2), then level; an error at the threshold and a failure are not below."""
        found = pose_auc(torch.tensor([8.0, 4.0, INF, 1.0], dtype=dtype, device=device), (8,))
        assert found == (pytest.approx((1 * 0.125 + 3 * 0.375 + 4 * 0.5) / 8),)

    @given(ERRORS)
    def test_numpy(self, errors):
        found = pose_auc(torch.tensor(errors, dtype=torch.float64))
        assert found == pytest.approx(tuple(trapezoids(errors, threshold) for threshold in (5, 10, 20)))
        assert all(type(area) is float and 0 <= area <= 1 for area in found)


class TestMeanAverageAccuracy:
    def test_by_hand(self, dtype, device):
        found = maa(torch.tensor([0.99, 1.0, 9.5, 10.0, INF], dtype=dtype, device=device))
        assert found == pytest.approx((1.0 + 0.9 + 0.1) / 5)
        assert type(found) is float

    @given(ERRORS, st.integers(1, 25))
    def test_counting(self, errors, limit):
        expected = np.mean([np.mean([error < degrees for error in errors]) for degrees in range(1, limit + 1)])
        assert maa(torch.tensor(errors, dtype=torch.float64), limit) == pytest.approx(expected)


@pytest.mark.parametrize("summary", [pose_auc, maa])
def test_exceptions(summary):
    for errors, message in [
        (torch.rand(0), r"at least one pair, got shape \[0\]"),
        (torch.rand(3, 1), r"a \(P,\) tensor of at least one pair, got shape \[3, 1\]"),
        (torch.tensor([1.0, NAN, -1.0]), "got 2 NaN or negative ones"),
    ]:
        with pytest.raises(ValueError, match=message):
            summary(errors)
    with pytest.raises(ValueError, match="thresholds must be positive" if summary is pose_auc else "limit must be one"):
        summary(torch.ones(3), (5, -1) if summary is pose_auc else 0)

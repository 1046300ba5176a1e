"""Pose errors by construction, recall curves and accuracies by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from scenes import raises

from kornia_learnnorm.metrics.poses import mean_average_accuracy as maa
from kornia_learnnorm.metrics.poses import pose_auc, pose_error

INF, NAN = float("inf"), float("nan")


def rotations(degrees, seed=0):
    """Random rotations, and others by so many degrees from them."""
    generator = torch.Generator().manual_seed(seed)
    axes, start = torch.randn(2, len(degrees), 3, generator=generator, dtype=torch.float64).unbind(0)
    axes = axes / axes.norm(dim=-1, keepdim=True) * torch.deg2rad(degrees)[:, None]
    R = axis_angle_to_rotation_matrix(start)
    return axis_angle_to_rotation_matrix(axes) @ R, R


class TestPoseError:
    @given(st.floats(0, 180), st.integers(0, 2**31))
    def test_symmetries(self, angle, seed):
        R, R_true = rotations(torch.tensor([angle], dtype=torch.float64), seed)
        t, t_true = R[:, 0], 3 * R_true[:, 0]
        for found in ((R, R_true), (R_true, R), (R.mT @ R_true, torch.eye(3).double()), (R @ R, R_true @ R)):
            assert pose_error(found[0], t, found[1], t).item() == pytest.approx(angle, abs=1e-10)
        torch.testing.assert_close(pose_error(R, t, R, t_true), pose_error(R, t_true, R, t))
        torch.testing.assert_close(pose_error(R, -t, R, t_true), 180 - pose_error(R, t, R, t_true))

    def test_smoke(self, device, dtype):
        R, t = torch.eye(3, device=device, dtype=dtype).repeat(2, 5, 1, 1), torch.rand(2, 5, 3, device=device).to(dtype)
        found = pose_error(R, t, R[0, 0].double(), t.double())
        assert (found.shape, found.dtype, found.device.type) == ((2, 5), dtype, device.type)
        assert (found < 1e-3).all()

    def test_exceptions(self):
        R, t = torch.eye(3), torch.ones(3)
        for values in ((R[:2], t, R[:2], t), (R[:, :2], t, R[:, :2], t), (R, t[:2], R, t[:2]), (R, t[:, None], R, t)):
            with pytest.raises(ShapeError):
                pose_error(*values)

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

    @given(ERRORS)
    def test_counting(self, errors):
        expected = np.mean([np.mean([error < degrees for error in errors]) for degrees in range(1, 11)])
        assert maa(torch.tensor(errors, dtype=torch.float64)) == pytest.approx(expected)


@pytest.mark.parametrize("summary", [pose_auc, maa])
def test_exceptions(summary):
    for errors, message in [
        (torch.rand(0), r"at least one pair, got shape \[0\]"),
        (torch.rand(3, 1), r"a \(P,\) tensor of at least one pair, got shape \[3, 1\]"),
        (torch.tensor([1.0, NAN, -1.0]), "got 2 NaN or negative ones"),
    ]:
        raises(ValueError, message, summary, errors)
    raises(ValueError, "thresholds must be positive", pose_auc, torch.ones(3), (5, -1))

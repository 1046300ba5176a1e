"""Areas under recall curves by hand and by NumPy's trapezoids; mean average accuracy by counting."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_learnnorm.metrics.poses import mean_average_accuracy, pose_auc

INF, NAN = float("inf"), float("nan")
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
        with pytest.raises(ValueError, match="thresholds must be positive, got "):
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

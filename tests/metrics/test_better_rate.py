"""The better rate against counting by hand."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_learnnorm.metrics.statistics import better_rate

INF, NAN = float("inf"), float("nan")
NUMBERS = st.sampled_from([0.0, 0.5, 1.0, 2.0, INF, NAN])


class TestBetterRate:
    @given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=30))
    def test_counts(self, pairs):
        """Ties are not better, one infinite residual is worse than any other, two and NaN are left out."""
        finite = [(a, b) for a, b in pairs if a == a and b == b and not a == b == INF]
        residual, baseline = torch.tensor(pairs).unbind(-1)
        if not finite:
            with pytest.raises(ValueError, match=f"none of {len(pairs)} samples can be compared"):
                better_rate(residual, baseline)
            return
        found = better_rate(residual, baseline)
        assert found.rate == sum(a < b for a, b in finite) / len(finite)
        assert found.ties == sum(a == b for a, b in finite)
        assert found.degenerate == len(pairs) - len(finite)
        assert found.compared == len(finite)
        reverse = better_rate(baseline, residual)
        assert found.rate + reverse.rate + found.ties / found.compared == pytest.approx(1)

    @pytest.mark.parametrize(
        ("residual", "baseline", "message"),
        [
            (torch.rand(3), torch.rand(4), r"two \(S,\) tensors, got \[3\] and \[4\]"),
            (torch.rand(3, 2), torch.rand(3, 2), r"two \(S,\) tensors, got \[3, 2\] and \[3, 2\]"),
            (torch.tensor(1.0), torch.tensor(2.0), r"two \(S,\) tensors, got \[\] and \[\]"),
            (torch.rand(0), torch.rand(0), "none of 0 samples can be compared"),
            (torch.full((3,), NAN), torch.rand(3), "none of 3 samples can be compared"),
        ],
    )
    def test_exceptions(self, residual, baseline, message):
        with pytest.raises(ValueError, match=message):
            better_rate(residual, baseline)

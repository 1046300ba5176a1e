"""The better rate against counting by hand, the bootstrap against another one and against the normal law."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_learnnorm import BetterRate, better_rate
from kornia_learnnorm.metrics.bootstrap import bootstrap_interval

INF, NAN = float("inf"), float("nan")
NUMBERS = st.sampled_from([0.0, 0.5, 1.0, 2.0, INF, NAN])


class TestBetterRate:
    @pytest.mark.parametrize(
        ("residual", "baseline", "expected"),
        [
            ([1.0, 2.0, 3.0, 4.0], [2.0, 1.0, 4.0, 5.0], (0.75, 0, 0, 4)),
            ([1.0, 2.0], [1.0, 2.0], (0.0, 2, 0, 2)),  # ties are not better
            ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], (1 / 3, 1, 0, 3)),
            ([1.0, NAN, 1.0, NAN], [2.0, 1.0, NAN, NAN], (1.0, 0, 3, 1)),
            ([INF, 1.0, INF], [1.0, INF, INF], (0.5, 0, 1, 2)),  # one infinite residual is worse than any other
            ([-INF, NAN, 1.0], [1.0, INF, 2.0], (1.0, 0, 1, 2)),
        ],
    )
    def test_by_hand(self, residual, baseline, expected, dtype, device):
        tensors = (torch.tensor(values, dtype=dtype, device=device) for values in (residual, baseline))
        assert better_rate(*tensors) == BetterRate(*expected)

    @given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=30))
    def test_counts(self, pairs):
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

    def test_is_a_named_tuple_of_numbers(self):
        rate, ties, degenerate, compared = better_rate(torch.tensor([1.0]), torch.tensor([2.0]))
        assert [type(value) for value in (rate, ties, degenerate, compared)] == [float, int, int, int]

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


def uneven_groups(number=40, seed=1):
    """Groups of very different sizes, the larger ones with larger values: means of samples and of groups differ."""
    rng = np.random.default_rng(seed)
    sizes = rng.geometric(0.1, number)
    groups = np.repeat(np.arange(number), sizes)
    return rng.normal(sizes[groups] / 10, 1.0), groups


def interval(values, groups, **options):
    return np.array(bootstrap_interval(torch.tensor(values), torch.tensor(groups), **options))


def width(*args, **options):
    low, high = interval(*args, **options)
    return high - low


class TestBootstrapInterval:
    """Ends scatter by about 0.04 standard errors at 4,000 draws."""

    @pytest.mark.parametrize("level", [0.5, 0.95])
    def test_another_bootstrap(self, level):
        values, groups = uneven_groups()
        parts = [values[groups == group] for group in range(40)]
        rng = np.random.default_rng(0)
        means = [np.concatenate([parts[i] for i in rng.integers(40, size=40)]).mean() for _ in range(4000)]
        expected = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
        np.testing.assert_allclose(
            interval(values, groups, level=level, draws=4000), expected, atol=0.2 * np.std(means)
        )

    @pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
    def test_independent_samples_follow_the_normal_law(self, level):
        values = np.random.default_rng(2).normal(3, 2, 200)
        error = values.std() / np.sqrt(200)
        end = NormalDist().inv_cdf((1 + level) / 2) * error
        found = interval(values, np.arange(200), level=level, draws=4000)
        np.testing.assert_allclose(found, values.mean() + np.array([-end, end]), atol=0.2 * error)

    def test_all_draws_of_two_groups(self):
        """Twice the first, one of each in either order, twice the second: a quarter, a half, a quarter."""
        values, groups = [1.0, 1.0, 1.0, 0.0], [5, 5, 5, 2]
        for level, expected in [(0.4, (0.75, 0.75)), (0.6, (0.0, 1.0))]:
            assert bootstrap_interval(torch.tensor(values), torch.tensor(groups), level) == expected

    def test_four_times_the_pairs_halve_it(self):
        values, groups = uneven_groups()
        many = np.concatenate([groups + 40 * k for k in range(4)])
        assert width(np.tile(values, 4), many, draws=4000) == pytest.approx(
            width(values, groups, draws=4000) / 2, rel=0.1
        )

    def test_agreement_within_pairs_widens_it(self):
        """Eight equal samples are worth one: the interval is wider by the root of eight."""
        values, groups = np.repeat(np.random.default_rng(3).normal(size=100), 8), np.repeat(np.arange(100), 8)
        mixed = np.random.default_rng(4).permutation(values)
        ratio = width(values, groups, draws=4000) / width(mixed, groups, draws=4000)
        assert ratio == pytest.approx(np.sqrt(8), rel=0.2)

    def test_seed_decides(self):
        values, groups = uneven_groups()
        state = torch.get_rng_state()
        assert (interval(values, groups, seed=3) == interval(values, groups, seed=3)).all()
        assert (interval(values, groups, seed=3) != interval(values, groups, seed=4)).all()
        assert torch.equal(torch.get_rng_state(), state)

    @given(st.integers(0, 2**31))
    def test_order_of_the_samples_does_not_matter(self, seed):
        values, groups = uneven_groups()
        order = np.random.default_rng(seed).permutation(len(values))
        found = interval(values[order], groups[order], draws=200)
        np.testing.assert_allclose(found, interval(values, groups, draws=200), rtol=1e-12)

    def test_labels_of_the_groups_do_not_matter(self):
        """In the same order they give the same draws, in another order other draws of the same law."""
        values, groups = uneven_groups()
        expected = interval(values, groups, draws=4000)
        assert (interval(values, 7 * groups - 100, draws=4000) == expected).all()
        np.testing.assert_allclose(interval(values, 39 - groups, draws=4000), expected, atol=0.05 * np.ptp(expected))

    @given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.integers(0, 4)), min_size=2, max_size=20), st.floats(0.01, 0.99))
    def test_lies_among_the_values(self, pairs, level):
        values, groups = torch.tensor([a for a, _ in pairs], dtype=torch.float64), torch.tensor([b for _, b in pairs])
        if len(groups.unique()) == 1:
            groups[0] += 1
        low, high = bootstrap_interval(values, groups, level, draws=50)
        assert values.min() - 1e-9 <= low <= high <= values.max() + 1e-9

    @pytest.mark.parametrize("kind", [torch.bool, torch.int64, torch.float32])
    def test_kinds_of_numbers(self, kind):
        values, groups = torch.tensor([1, 0, 0, 1, 1, 0]), torch.tensor([0, 0, 1, 1, 2, 3])
        found = bootstrap_interval(values.to(kind), groups)
        assert found == bootstrap_interval(values.double(), groups)
        assert [type(end) for end in found] == [float, float]

    def test_equal_values_leave_no_width(self):
        assert bootstrap_interval(torch.full((6,), 0.5), torch.tensor([0, 0, 0, 1, 1, 2])) == (0.5, 0.5)

    @pytest.mark.parametrize(
        ("values", "groups", "level", "message"),
        [
            (torch.rand(3), torch.arange(4), 0.95, r"two \(S,\) tensors, got \[3\] and \[4\]"),
            (torch.rand(2, 2), torch.ones(2, 2).long(), 0.95, r"two \(S,\) tensors, got \[2, 2\] and \[2, 2\]"),
            (torch.tensor(1.0), torch.tensor(1), 0.95, r"two \(S,\) tensors, got \[\] and \[\]"),
            (torch.rand(3), torch.arange(3), 0.0, r"level must be between 0 and 1, got 0\.0"),
            (torch.rand(3), torch.arange(3), 1.0, r"level must be between 0 and 1, got 1\.0"),
            (torch.rand(3), torch.arange(3), 95, "level must be between 0 and 1, got 95"),
            (torch.rand(3), torch.arange(3), NAN, "level must be between 0 and 1, got nan"),
            (torch.rand(3), torch.full((3,), 7), 0.95, "at least two groups are needed, got 1"),
            (torch.rand(0), torch.arange(0), 0.95, "at least two groups are needed, got 0"),
        ],
    )
    def test_exceptions(self, values, groups, level, message):
        with pytest.raises(ValueError, match=message):
            bootstrap_interval(values, groups, level)

"""The bootstrap against another one, the better rate against counting, the median against NumPy."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import raises

from kornia_learnnorm.metrics.statistics import better_rate, bootstrap_interval, median, paired_bootstrap

INF, NAN = float("inf"), float("nan")


def uneven(effect=0.0, number=30, seed=1):
    """Values of two methods on groups of very different sizes, within which their differences agree."""
    rng = np.random.default_rng(seed)
    groups = np.repeat(np.arange(number), rng.geometric(0.1, number))
    baseline = rng.normal(size=len(groups))
    return baseline + effect + rng.normal(size=number)[groups], baseline, groups


def resampled_means(values, groups):
    """Means of 4,000 draws of whole groups with replacement."""
    parts, rng = [values[groups == group] for group in np.unique(groups)], np.random.default_rng(0)
    draws = (rng.integers(len(parts), size=len(parts)) for _ in range(4000))
    return np.array([np.concatenate([parts[i] for i in draw]).mean() for draw in draws])


def interval(values, groups, **options):
    return np.array(bootstrap_interval(torch.tensor(values), torch.tensor(groups), **options))


class TestBootstrapInterval:
    """Ends scatter by about 0.04 standard errors at 4,000 draws."""

    def test_another_bootstrap(self):
        (values, _, groups), state = uneven(), torch.get_rng_state()
        means = resampled_means(values, groups)
        found, again = (interval(values, groups, draws=4000) for _ in range(2))
        np.testing.assert_allclose(found, np.quantile(means, [0.025, 0.975]), atol=0.2 * np.std(means))
        assert (found == again).all()
        assert torch.equal(torch.get_rng_state(), state)

    def test_all_draws_of_two_groups(self):
        """Twice the first, one of each in either order, twice the second: a quarter, a half, a quarter."""
        values, groups = [1.0, 1.0, 1.0, 0.0], [5, 5, 5, 2]
        assert bootstrap_interval(torch.tensor(values), torch.tensor(groups)) == (0.0, 1.0)

    @given(st.integers(0, 2**31))
    def test_order_of_the_samples_does_not_matter(self, seed):
        values, _, groups = uneven()
        order = np.random.default_rng(seed).permutation(len(values))
        found = interval(values[order], groups[order], draws=200)
        np.testing.assert_allclose(found, interval(values, groups, draws=200), rtol=0, atol=1e-12)

    @given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.integers(0, 4)), min_size=2, max_size=20))
    def test_lies_among_the_values(self, pairs):
        values, groups = torch.tensor([a for a, _ in pairs], dtype=torch.float64), torch.tensor([b for _, b in pairs])
        if len(groups.unique()) == 1:
            groups[0] += 1
        low, high = bootstrap_interval(values, groups, draws=50)
        assert values.min() - 1e-9 <= low <= high <= values.max() + 1e-9


class TestPairedBootstrap:
    def test_another_bootstrap(self):
        values, baseline, groups = uneven(0.4)
        means = resampled_means(values - baseline, groups)
        found = paired_bootstrap(*map(torch.tensor, (values, baseline, groups)), draws=4000)
        assert found.mean == pytest.approx((values - baseline).mean())
        assert found.p_value == pytest.approx(2 * min((means <= 0).mean(), (means >= 0).mean()), abs=0.03)

    @given(st.floats(-1.5, 1.5), st.integers(0, 99))
    def test_small_exactly_where_the_interval_leaves_zero_out(self, effect, seed):
        values, baseline, groups = map(torch.tensor, uneven(effect, seed=seed))
        found = paired_bootstrap(values, baseline, groups, draws=999)
        outside = not found.low <= 0 <= found.high
        assert outside == (found.p_value < 0.05) or abs(found.p_value - 0.05) < 0.005  # quantiles interpolate

    def test_swapping_the_methods(self):
        values, baseline, groups = map(torch.tensor, uneven(0.3))
        found, swapped = paired_bootstrap(values, baseline, groups), paired_bootstrap(baseline, values, groups)
        np.testing.assert_allclose(swapped, [-found.mean, -found.high, -found.low, found.p_value], rtol=1e-12)

    def test_extremes(self):
        values, groups = torch.rand(10), torch.arange(10)
        assert paired_bootstrap(values, values, groups) == (0.0, 0.0, 0.0, 1.0)
        assert paired_bootstrap(values + 1, values, groups, draws=99).p_value == 2 / 100
        better = torch.tensor([True, True, False])
        assert paired_bootstrap(better, better, groups[:3]).mean == 0  # shares of booleans


VALUES = torch.tensor([1.0, 2.0, 3.0])


def test_exceptions():
    for function, arguments, message in [
        (bootstrap_interval, (VALUES, torch.arange(4)), r"two \(S,\) tensors, got \[3\] and \[4\]"),
        (bootstrap_interval, (VALUES[None], VALUES[None]), r"got \[1, 3\] and \[1, 3\]"),
        (bootstrap_interval, (VALUES, torch.full((3,), 7)), "at least two groups are needed, got 1"),
        (bootstrap_interval, (VALUES[:0], VALUES[:0]), "at least two groups are needed, got 0"),
        (paired_bootstrap, (VALUES[None], VALUES[None], VALUES), r"two \(S,\) tensors, got \[1, 3\]"),
        (paired_bootstrap, (VALUES, VALUES, torch.arange(4)), r"got \[3\] and \[4\]"),
        (paired_bootstrap, (torch.tensor([1.0, NAN, INF]), VALUES, VALUES), "2 NaN or infinite ones of 3"),
        (better_rate, (torch.rand(3), torch.rand(4)), r"two \(S,\) tensors, got \[3\] and \[4\]"),
        (better_rate, (torch.rand(3, 2), torch.rand(3, 2)), r"two \(S,\) tensors, got \[3, 2\] and \[3, 2\]"),
        (better_rate, (torch.rand(0), torch.rand(0)), "none of 0 samples can be compared"),
    ]:
        raises(ValueError, message, function, *arguments)


@pytest.mark.parametrize("number", [1, 2, 5, 8])
@pytest.mark.parametrize("dim", [0, -1])
def test_agrees_with_numpy(number, dim, device, dtype):
    values = torch.randn(number, 3, number, dtype=dtype)
    values[values < -0.5] = torch.nan
    values[0, 0, 0] = 1.0
    values[:, 1], values[:, 2] = torch.inf, torch.nan
    found = median(values.to(device), dim)
    assert found.dtype == dtype
    with warnings.catch_warnings(action="ignore"):  # NumPy's of slices that are all NaN
        np.testing.assert_array_equal(found.cpu().numpy(), np.nanmedian(values.numpy(), axis=dim))


def test_of_nothing_is_nan():
    assert median(torch.zeros(2, 0)).isnan().all()
    assert median(torch.zeros(0)).isnan()


NUMBERS = st.sampled_from([0.0, 0.5, 1.0, 2.0, INF, NAN])


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=30))
def test_counts(pairs):
    """Ties are not better, one infinite residual is worse than any other, two and NaN are left out."""
    finite = [(a, b) for a, b in pairs if a == a and b == b and not a == b == INF]
    residual, baseline = torch.tensor(pairs).unbind(-1)
    if not finite:
        raises(ValueError, f"none of {len(pairs)} samples can be compared", better_rate, residual, baseline)
        return
    found = better_rate(residual, baseline)
    assert found.rate == sum(a < b for a, b in finite) / len(finite)
    assert found.ties == sum(a == b for a, b in finite)
    assert found.degenerate == len(pairs) - len(finite)
    assert found.compared == len(finite)
    assert found.rate + better_rate(baseline, residual).rate + found.ties / found.compared == pytest.approx(1)

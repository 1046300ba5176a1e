"""Minimal samples against counts and NumPy's draws without replacement."""

from math import comb

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_learnnorm.ransac.samplers import UniformSampler, WeightedSampler

CPU = torch.device("cpu")


class TestUniform:
    @given(total=st.integers(8, 200), count=st.integers(1, 100), seed=st.integers(0, 2**32), size=st.integers(5, 8))
    def test_distinct_and_in_range(self, total, count, seed, size):
        drawn = UniformSampler(total, CPU, size).draw(count, torch.Generator().manual_seed(seed))
        assert drawn.shape == (count, size)
        assert 0 <= drawn.min() <= drawn.max() < total
        assert (drawn.sort(-1).values.diff(dim=-1) > 0).all()

    @pytest.mark.parametrize("total", [10, 60])
    def test_every_pair_is_as_likely(self, total, generator):
        """Whether most rows come from draws one by one or from Floyd's algorithm."""
        drawn = UniformSampler(total, CPU).draw(40_000, generator)
        together = torch.zeros(40_000, total).scatter_(1, drawn, 1.0)
        counts = (together.mT @ together)[*torch.triu_indices(total, total, 1)]
        expected = 40_000 * 28 / comb(total, 2)
        assert (counts - expected).abs().max() < 5 * expected**0.5


class TestWeighted:
    @pytest.mark.parametrize("size", [2, 8])
    def test_inclusion_as_numpy_draws(self, size, generator):
        weights = torch.tensor([1.0, 2, 4, 8, 16, *[1.0] * 35])
        drawn = torch.bincount(WeightedSampler(weights.sqrt(), size).draw(20_000, generator).flatten(), minlength=40)
        rng, p = np.random.default_rng(0), weights.double().numpy() / float(weights.sum())
        reference = sum(np.bincount(rng.choice(40, size, False, p), minlength=40) for _ in range(5000)) / 5000
        assert np.abs(drawn.numpy() / 20_000 - reference).max() < 0.03

    @pytest.mark.parametrize("weight", [1e-50, 1e300])
    def test_weights_beyond_float32(self, weight, generator):
        drawn = WeightedSampler(torch.full((50,), weight, dtype=torch.float64)).draw(500, generator)
        assert len(drawn.sort(-1).values.unique(dim=0)) > 490

    @pytest.mark.parametrize("size", [5, 8])
    def test_zero_is_never_drawn(self, size, generator):
        weights = torch.zeros(100, dtype=torch.float64)
        weights[10:14], weights[14:20] = 1e10, 1e-30
        rows = WeightedSampler(weights, size).draw(2000, generator)
        assert rows.shape == (2000, size)
        assert set(rows.flatten().tolist()) == set(range(10, 20))
        assert (rows.sort(-1).values.diff(dim=-1) > 0).all()


def test_among_some_rows_and_hit_rate(generator):
    rows = torch.arange(40)
    for sampler, share in ((UniformSampler(40, CPU, 1), 0.5), (WeightedSampler(1.0 + (rows < 30), 1), 0.8)):
        drawn = sampler.among(rows >= 20).draw(4000, generator)
        assert (drawn.min() >= 20, (drawn < 30).double().mean().item()) == (True, pytest.approx(share, abs=0.04))
        assert sampler.among(rows == 20) is sampler
    weighted = WeightedSampler(torch.where(rows < 4, 3.0, 1.0))
    for sampler, inliers in ((UniformSampler(40, CPU, 5), rows < 20), (weighted, rows < 4)):
        assert sampler.hit_rate(inliers, rows) == pytest.approx(0.5**sampler.size)

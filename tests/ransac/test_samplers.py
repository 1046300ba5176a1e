"""Minimal samples against counts, a sequential PROSAC and NumPy's draws without replacement."""

from math import ceil, comb

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_learnnorm.ransac.samplers import ProsacSampler, UniformSampler, WeightedSampler

GROWTH = ProsacSampler.MAX_SAMPLES
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


def sequential_prosac(total: int, samples: int) -> list[tuple[int, bool]]:
    """Size of the set of each sample, and whether its last member must be in, as in the paper's algorithm 1."""
    n, average = 8, GROWTH * np.prod([(8 - i) / (total - i) for i in range(8)])
    until, sizes = 1, []
    for t in range(1, samples + 1):
        while t > until and n < total:
            following = average * (n + 1) / (n + 1 - 8)
            until += ceil(following - average)
            average, n = following, n + 1
        sizes.append((n, t <= until))
    return sizes


class TestProsac:
    @pytest.mark.parametrize("total", [8, 9, 30, 2000])
    def test_grows_as_in_the_paper(self, total, generator):
        weights = torch.rand(total, generator=generator)
        draw = ProsacSampler(weights).draw
        rows = torch.cat([draw(100, generator), draw(400, generator)])
        rank = weights.argsort(descending=True).argsort()[rows]
        for ranks, (size, last_in) in zip(rank.tolist(), sequential_prosac(total, 500), strict=True):
            assert len(set(ranks)) == 8
            assert max(ranks) == size - 1 if last_in else max(ranks) < size

    def test_is_uniform_in_the_end(self, generator):
        draw = ProsacSampler(torch.arange(1.0, 21.0)).draw
        draw(GROWTH + 100, generator)
        counts = torch.bincount(draw(20_000, generator).flatten(), minlength=20)
        assert (counts - 8000).abs().max() < 5 * 8000**0.5

    @given(scale=st.floats(1e-3, 100))
    def test_only_the_order_of_the_weights_counts(self, scale):
        weights = torch.rand(50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        rows = [ProsacSampler(w).draw(64, torch.Generator().manual_seed(0)) for w in (weights, (scale * weights).exp())]
        assert torch.equal(*rows)


class TestWeighted:
    def test_inclusion_as_numpy_draws(self, generator):
        weights = torch.tensor([1.0, 2, 4, 8, 16, 1, 1, 1, 1, 1, 1, 1])
        drawn = torch.bincount(WeightedSampler(weights).draw(20_000, generator).flatten(), minlength=12) / 20_000
        rng, p = np.random.default_rng(0), (weights / weights.sum()).double().numpy()
        reference = sum(np.bincount(rng.choice(12, 8, False, p), minlength=12) for _ in range(5000)) / 5000
        assert np.abs(drawn.numpy() - reference).max() < 0.03

    @pytest.mark.parametrize("weight", [1e-50, 1e300])
    def test_weights_beyond_float32(self, weight, generator):
        drawn = WeightedSampler(torch.full((50,), weight, dtype=torch.float64)).draw(500, generator)
        assert len(drawn.sort(-1).values.unique(dim=0)) > 490

    def test_zero_is_less_than_next_to_nothing(self, generator):
        weights = torch.zeros(50, dtype=torch.float64)
        weights[:4], weights[4:12] = 1e10, 1e-30
        assert WeightedSampler(weights).draw(500, generator).max() < 12


@pytest.mark.parametrize("size", [5, 8])
@pytest.mark.parametrize("sampler", [ProsacSampler, WeightedSampler])
def test_zero_is_never_drawn(sampler, size, generator):
    weights = torch.zeros(100)
    weights[10:20] = torch.linspace(0.1, 1, 10)
    rows = sampler(weights, size=size).draw(2000, generator)
    assert rows.shape == (2000, size)
    assert set(rows.flatten().tolist()) <= set(range(10, 20))
    assert (rows.sort(-1).values.diff(dim=-1) > 0).all()


ROWS = torch.arange(100)


def test_hit_rate():
    for sampler, inliers, expected in [
        *((UniformSampler(100, CPU, size), ROWS < 50, 0.5**size) for size in (5, 8)),
        *((ProsacSampler(torch.linspace(1, 0.1, 100)), best > ROWS, 1) for best in (100, 50, 26)),
        (ProsacSampler(torch.linspace(1, 0.1, 100)), ROWS < 10, (10 / 26) ** 8),  # it looks at the best but not at few
        (WeightedSampler(torch.where(ROWS < 10, 9.0, 1.0)), ROWS < 10, 0.5**8),
    ]:
        assert sampler.hit_rate(inliers, ROWS) == pytest.approx(expected)


def test_hit_rate_of_prosac_does_not_see_what_it_never_draws():
    sampler, inliers = ProsacSampler(torch.cat([torch.ones(100), torch.zeros(2000)])), torch.arange(2100) < 100
    assert [sampler.hit_rate(inliers[rows], rows) for rows in (slice(None), slice(100, None))] == [1, 0]

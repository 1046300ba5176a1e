"""The torchmetrics class against the function on everything at once: in batches, on processes, reset."""

from __future__ import annotations

import copy

import pytest
import torch

pytest.importorskip("torchmetrics")

from kornia_learnnorm.metrics.better_rate import better_rate
from kornia_learnnorm.metrics.modules import BetterRateMetric

NAN, INF = float("nan"), float("inf")
STATES = ("better", "compared", "degenerate", "ties")


@pytest.fixture
def residuals():
    values = torch.rand(2, 11, generator=torch.Generator().manual_seed(0))
    values[0, 3], values[1, 5], values[:, 7] = NAN, values[0, 5], INF
    return tuple(values)


@pytest.fixture
def expected(residuals):
    found = better_rate(*residuals)
    return pytest.approx({"better_rate": found.rate, "ties": 1, "degenerate": 2, "compared": found.compared}, rel=1e-6)


def values_of(metric):
    return {name: value.item() for name, value in metric.compute().items()}


def feed(metric, data, sizes):
    for part in zip(*(value.split(sizes) for value in data), strict=True):
        metric.update(*part)
    return metric


class TestBetterRateMetric:
    @pytest.mark.parametrize("sizes", [[11], [1] * 11, [2, 9]])
    def test_batches(self, residuals, expected, sizes):
        assert values_of(feed(BetterRateMetric(), residuals, sizes)) == expected

    @pytest.mark.parametrize("sizes", [[5, 6], [11, 0], [2, 4, 5]])
    def test_processes(self, residuals, expected, sizes):
        """Every process gathers the states of all; one of them may have had an empty batch."""
        ranks = [BetterRateMetric(distributed_available_fn=lambda: True) for _ in sizes]
        for metric, part in zip(ranks, zip(*(v.split(sizes) for v in residuals), strict=True), strict=True):
            metric.update(*part)
        whole = {name: [getattr(metric, name).clone() for metric in ranks] for name in STATES}
        for metric in ranks:
            order = iter(metric._reductions)
            metric.dist_sync_fn = lambda *_, order=order, **__: whole[next(order)]
            assert values_of(metric) == expected

    def test_nothing_measured_and_reset(self, residuals, expected):
        metric = BetterRateMetric()
        metric.update(*(value[:0] for value in residuals))
        empty = values_of(metric)
        assert empty.pop("better_rate") != empty.get("compared")
        assert empty == {"ties": 0, "degenerate": 0, "compared": 0}
        metric.reset()
        assert values_of(feed(metric, residuals, [11])) == expected

    def test_copies_and_moves(self, residuals, expected, device):
        metric = copy.deepcopy(BetterRateMetric()).to(device)
        assert values_of(feed(metric, tuple(value.to(device) for value in residuals), [11])) == expected

    def test_exceptions(self):
        with pytest.raises(ValueError, match=r"two \(S,\) tensors, got \[3\] and \[2\]"):
            BetterRateMetric().update(torch.rand(3), torch.rand(2))

"""The better rate as a ``torchmetrics`` class, which collects over batches and processes; needs the extra ``train``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from kornia_learnnorm.metrics.better_rate import count_better

__all__ = ["BetterRateMetric"]


class BetterRateMetric(Metric):
    """Share of samples with a residual below the baseline's; see :mod:`~kornia_learnnorm.metrics.better_rate`.

    It reports a dictionary of scalars. Samples that cannot be compared are left out and counted; without any other
    sample, the rate is NaN. The keywords are those of ``torchmetrics.Metric``.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    better: Tensor
    ties: Tensor
    degenerate: Tensor
    compared: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        for name in ("better", "ties", "degenerate", "compared"):
            self.add_state(name, torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, residual: Tensor, baseline: Tensor) -> None:
        """Add samples: their residuals and the baseline's, with shape (S,) each."""
        better, ties, compared = count_better(residual, baseline)
        self.better += better
        self.ties += ties
        self.compared += compared
        self.degenerate += len(residual) - compared

    def compute(self) -> dict[str, Tensor]:
        """Return ``better_rate``, ``ties``, ``degenerate`` and ``compared``."""
        counts = {"ties": self.ties, "degenerate": self.degenerate, "compared": self.compared}
        return {"better_rate": self.better / self.compared, **counts}

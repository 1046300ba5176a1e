"""The metrics as ``torchmetrics`` classes, which collect over batches and processes; needs the extra ``train``.

Each keeps what the function of its name returns and reports a dictionary of scalars, so that several go into one
``torchmetrics.MetricCollection`` or a Lightning module's ``log_dict``. Pairs or samples that cannot be measured, NaN,
are left out of the averages and counted; a metric without any others reports NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from kornia_learnnorm.metrics.better_rate import comparable
from kornia_learnnorm.metrics.pairs import epipolar_error, f1_score, inlier_share
from kornia_learnnorm.metrics.pose_accuracy import pose_auc
from kornia_learnnorm.metrics.poses import pose_error

__all__ = ["BetterRateMetric", "EpipolarErrorMetric", "F1Metric", "InlierShareMetric", "PoseAUCMetric"]


class BetterRateMetric(Metric):
    """Share of samples with a residual below the baseline's; see :func:`kornia_learnnorm.better_rate`.

    Args:
        kwargs: options of ``torchmetrics.Metric``.

    Example:
        >>> metric = BetterRateMetric()
        >>> metric.update(torch.tensor([1.0, 2.0]), torch.tensor([2.0, 2.0]))
        >>> metric.update(torch.tensor([3.0, torch.nan]), torch.tensor([1.0, 2.0]))
        >>> {name: round(value.item(), 3) for name, value in metric.compute().items()}
        {'better_rate': 0.333, 'ties': 1, 'degenerate': 1, 'compared': 3}

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
        """Add samples: their residuals and the baseline's, with shape (S,) each.

        Raises:
            ValueError: if the shapes differ.

        """
        if residual.shape != baseline.shape or residual.ndim != 1:
            raise ValueError(f"residuals must be two (S,) tensors, got {[*residual.shape]} and {[*baseline.shape]}")
        valid = comparable(residual, baseline)
        self.better += (residual < baseline)[valid].sum()
        self.ties += (residual == baseline)[valid].sum()
        self.compared += valid.sum()
        self.degenerate += (~valid).sum()

    def compute(self) -> dict[str, Tensor]:
        """Return ``better_rate``, ``ties``, ``degenerate`` and ``compared``."""
        counts = {"ties": self.ties, "degenerate": self.degenerate, "compared": self.compared}
        return {"better_rate": self.better / self.compared, **counts}


class _PairMetric(Metric):
    """One number per image pair, kept in the metric's dtype, float32 unless ``set_dtype`` says otherwise.

    The state is named after what fills it: a ``MetricCollection`` lets metrics share states of one name that are equal
    after the first batch, as the scores of different metrics or thresholds can be.
    """

    is_differentiable = False
    full_state_update = False

    def __init__(self, state: str, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._state = state
        self.add_state(state, [], dist_reduce_fx="cat")

    def _keep(self, values: Tensor) -> None:
        getattr(self, self._state).append(values.reshape(-1).to(self.dtype))

    def _measured(self) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the values that are not NaN, and how many pairs are measured and dropped."""
        kept = getattr(self, self._state)
        values = dim_zero_cat(kept) if len(kept) else torch.zeros(0, device=self.device)
        measured = ~values.isnan()
        return values[measured], {"pairs": measured.sum(), "dropped": (~measured).sum()}


class InlierShareMetric(_PairMetric):
    """Mean share of inliers over image pairs; see :func:`kornia_learnnorm.metrics.pairs.inlier_share`.

    Args:
        threshold: symmetric epipolar distance that an inlier stays below, pixels.
        kwargs: options of ``torchmetrics.Metric``.

    Example:
        >>> metric = InlierShareMetric(threshold=1.0)
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # lines are rows
        >>> metric.update(torch.tensor([[[5.0, 1.0], [5.0, 2.0]]]), torch.tensor([[[9.0, 1.0], [9.0, 4.0]]]), F_mat)
        >>> metric.compute()
        {'inlier_share': tensor(0.5000), 'pairs': tensor(1), 'dropped': tensor(0)}

    """

    higher_is_better = True

    def __init__(self, threshold: float, **kwargs: Any) -> None:
        super().__init__(f"inlier_share_{threshold!r}", **kwargs)
        self.threshold = threshold

    def update(self, points1: Tensor, points2: Tensor, F_mat: Tensor, mask: Tensor | None = None) -> None:
        """Add image pairs; arguments of :func:`~kornia_learnnorm.metrics.pairs.inlier_share`."""
        self._keep(inlier_share(points1, points2, F_mat, self.threshold, mask))

    def compute(self) -> dict[str, Tensor]:
        """Return the mean ``inlier_share``, and the numbers of ``pairs`` and ``dropped`` ones."""
        values, counts = self._measured()
        return {"inlier_share": values.mean(), **counts}


class F1Metric(_PairMetric):
    """Mean F1 score over image pairs; see :func:`kornia_learnnorm.metrics.pairs.f1_score`.

    Args:
        threshold: symmetric epipolar distance that an inlier stays below, pixels.
        kwargs: options of ``torchmetrics.Metric``.

    Example:
        >>> metric = F1Metric(threshold=1.0)
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # lines are rows
        >>> metric.update(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 1.0]]]), F_mat, F_true=-F_mat)
        >>> metric.compute()
        {'f1': tensor(1.), 'pairs': tensor(1), 'dropped': tensor(0)}

    """

    higher_is_better = True

    def __init__(self, threshold: float, **kwargs: Any) -> None:
        super().__init__(f"f1_score_{threshold!r}", **kwargs)
        self.threshold = threshold

    def update(
        self, points1: Tensor, points2: Tensor, F_mat: Tensor, F_true: Tensor, mask: Tensor | None = None
    ) -> None:
        """Add image pairs; arguments of :func:`~kornia_learnnorm.metrics.pairs.f1_score`."""
        self._keep(f1_score(points1, points2, F_mat, F_true, self.threshold, mask))

    def compute(self) -> dict[str, Tensor]:
        """Return the mean ``f1``, and the numbers of ``pairs`` and of ``dropped`` ones without true inliers."""
        values, counts = self._measured()
        return {"f1": values.mean(), **counts}


class EpipolarErrorMetric(_PairMetric):
    """Mean and median epipolar error over image pairs; see :func:`kornia_learnnorm.metrics.pairs.epipolar_error`.

    A failed estimate makes the mean infinite. The median of an even number of pairs is the smaller of the middle two.

    Args:
        threshold: symmetric epipolar distance that an inlier of the ground truth stays below, pixels.
        kwargs: options of ``torchmetrics.Metric``.

    Example:
        >>> metric = EpipolarErrorMetric()
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # lines are rows
        >>> metric.update(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 1.25]]]), F_mat, F_true=F_mat)
        >>> metric.compute()["epipolar_error_median"]
        tensor(0.5000)

    """

    higher_is_better = False

    def __init__(self, threshold: float = 1.0, **kwargs: Any) -> None:
        super().__init__(f"epipolar_error_{threshold!r}", **kwargs)
        self.threshold = threshold

    def update(
        self, points1: Tensor, points2: Tensor, F_mat: Tensor, F_true: Tensor, mask: Tensor | None = None
    ) -> None:
        """Add image pairs; arguments of :func:`~kornia_learnnorm.metrics.pairs.epipolar_error`."""
        self._keep(epipolar_error(points1, points2, F_mat, F_true, self.threshold, mask))

    def compute(self) -> dict[str, Tensor]:
        """Return ``epipolar_error_mean``, ``epipolar_error_median``, ``pairs`` and ``dropped`` ones."""
        values, counts = self._measured()
        return {"epipolar_error_mean": values.mean(), "epipolar_error_median": values.median(), **counts}


class PoseAUCMetric(_PairMetric):
    """Area under the recall curve of pose errors; see :func:`kornia_learnnorm.metrics.pose_accuracy.pose_auc`.

    Args:
        thresholds: largest errors, degrees.
        kwargs: options of ``torchmetrics.Metric``.

    Example:
        >>> metric = PoseAUCMetric(thresholds=(5, 10))
        >>> R, t = torch.eye(3)[None], torch.tensor([[0.0, 0.0, 1.0]])
        >>> metric.update(R, t, R, 3 * t)
        >>> metric.compute()
        {'auc@5': tensor(1.), 'auc@10': tensor(1.), 'pairs': tensor(1), 'dropped': tensor(0)}

    """

    higher_is_better = True

    def __init__(self, thresholds: Sequence[float] = (5, 10, 20), **kwargs: Any) -> None:
        super().__init__("pose_error", **kwargs)
        self.thresholds = tuple(thresholds)

    def update(self, R: Tensor, t: Tensor, R_true: Tensor, t_true: Tensor) -> None:
        """Add poses; arguments of :func:`~kornia_learnnorm.metrics.poses.pose_error`."""
        self._keep(pose_error(R, t, R_true, t_true))

    def compute(self) -> dict[str, Tensor]:
        """Return the area ``auc@5`` of each threshold, and the numbers of ``pairs`` and ``dropped`` ones."""
        errors, counts = self._measured()
        areas = pose_auc(errors, self.thresholds) if len(errors) else [torch.nan] * len(self.thresholds)
        named = zip(self.thresholds, areas, strict=True)
        return {**{f"auc@{threshold:g}": errors.new_tensor(area) for threshold, area in named}, **counts}

"""Tables of a report and the text of their cells: an empty cell stands for an unknown number."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.run import Cell
from kornia_learnnorm.metrics.better_rate import comparable
from kornia_learnnorm.metrics.bootstrap import bootstrap_interval, paired_bootstrap
from kornia_learnnorm.metrics.poses import mean_average_accuracy, pose_auc
from kornia_learnnorm.metrics.summary import median

__all__ = [
    "BASELINE",
    "MIN_P_VALUE",
    "POSE_HEADER",
    "RESAMPLES",
    "Table",
    "mean_text",
    "median_text",
    "number_text",
    "paired_text",
    "pose_texts",
    "rate_text",
]

BASELINE = "Hartley"  # the method that all others are compared with
RESAMPLES = 2000  # bootstrap resamples of a paired test
MIN_P_VALUE = 1e-3  # the smallest p-value that these resamples can resolve
POSE_HEADER = ("AUC@5", "AUC@10", "AUC@20", "mAA(10)")


class Table(NamedTuple):
    """A table of a report.

    Attributes:
        title: heading.
        text: what the table shows and how to read it, Markdown.
        header: names of the columns.
        rows: cells as text.
    """

    title: str
    text: str
    header: list[str]
    rows: list[list[str]]


def number_text(value: float, spec: str = ".3f") -> str:
    """Return a number as text, empty for NaN.

    Example:
        >>> number_text(0.5), number_text(float("nan"))
        ('0.500', '')

    """
    return "" if math.isnan(value) else format(value, spec)


def median_text(values: Tensor, spec: str = ".3f") -> str:
    """Return the median of the values that are not NaN as text, empty where there are none.

    Example:
        >>> median_text(torch.tensor([1.0, 4.0, torch.nan]))
        '2.500'

    """
    return number_text(median(values.flatten()).item(), spec)


def mean_text(values: Tensor, pair: Tensor) -> str:
    """Return the mean of shares with its 95 % bootstrap interval over image pairs, %.

    Args:
        values: shares with shape (S,).
        pair: image pair of each share with shape (S,).

    Returns:
        the text; without the interval if all shares are of one pair, empty if there are no shares.

    """
    if len(values) == 0:
        return ""
    mean = f"{100 * values.mean().item():.1f}"
    if len(torch.unique(pair)) < 2:
        return mean
    low, high = bootstrap_interval(values, pair)
    return f"{mean} [{100 * low:.1f}, {100 * high:.1f}]"


def rate_text(cell: Cell, name: str, baseline: str, quantity: str, rows: Tensor | None = None) -> str:
    """Return a better rate with its interval, %.

    Args:
        cell: predictions of one store and protocol.
        name: the method.
        baseline: the method to compare with.
        quantity: the error to compare: ``own``, ``heldout`` or ``truth``.
        rows: mask of the samples to use with shape (S,); all if not given.

    """
    rows = torch.ones_like(cell.pair, dtype=torch.bool) if rows is None else rows
    value, other = cell.predictions[name][quantity][rows], cell.predictions[baseline][quantity][rows]
    valid = comparable(value, other)
    return mean_text((value < other)[valid].double(), cell.pair[rows][valid])


def paired_text(
    values: Tensor,
    baseline: Tensor,
    pair: Tensor | None = None,
    *,
    show: Callable[[float], str] = "{:+.3f}".format,
    with_p_value: bool = True,
) -> str:
    """Return the mean difference of two methods with its 95 % interval and p-value, from a paired bootstrap.

    Args:
        values: numbers of one method with shape (S,).
        baseline: numbers of the other method with shape (S,).
        pair: image pair of each number with shape (S,); if not given, each number is of its own pair.
        show: formats the mean and the ends of the interval.
        with_p_value: whether the p-value is part of the text.

    Returns:
        the text; empty if fewer than two pairs have a finite difference.

    Example:
        >>> paired_text(torch.tensor([1.5, 2.5]), torch.tensor([1.0, 2.0]))
        '+0.500 [+0.500, +0.500], < 0.001'

    """
    pair = torch.arange(len(values)) if pair is None else pair
    valid = (values - baseline).isfinite()
    if len(torch.unique(pair[valid])) < 2:
        return ""
    found = paired_bootstrap(values[valid], baseline[valid], pair[valid], draws=RESAMPLES)
    text = f"{show(found.mean)} [{show(found.low)}, {show(found.high)}]"
    p_value = f"< {MIN_P_VALUE:g}" if found.p_value < MIN_P_VALUE else f"{found.p_value:.3f}"
    return f"{text}, {p_value}" if with_p_value else text


def pose_texts(rotation_error: Tensor, translation_error: Tensor) -> list[str]:
    """Return AUC at 5, 10 and 20 degrees and mAA(10) of relative poses, %, the columns of :data:`POSE_HEADER`.

    Args:
        rotation_error: degrees, infinite for a failure, NaN where the true pose is not known.
        translation_error: degrees, in the same order.

    Returns:
        four texts, empty if no true pose is known.

    """
    error = torch.maximum(rotation_error, translation_error)
    error = error[~error.isnan()]
    if len(error) == 0:
        return [""] * len(POSE_HEADER)
    return [f"{100 * value:.1f}" for value in (*pose_auc(error), mean_average_accuracy(error))]

"""Text of the cells of a report's tables."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.run import Cell
from kornia_learnnorm.evaluation.tables import Table
from kornia_learnnorm.metrics.better_rate import comparable
from kornia_learnnorm.metrics.bootstrap import bootstrap_interval, paired_bootstrap
from kornia_learnnorm.metrics.poses import mean_average_accuracy, pose_auc
from kornia_learnnorm.metrics.summary import median

__all__ = [
    "BASELINE",
    "MIN_BOOTSTRAP_PAIRS",
    "MIN_P_VALUE",
    "POSE_HEADER",
    "RESAMPLES",
    "known_parts",
    "mean_text",
    "median_text",
    "number_text",
    "paired_text",
    "percent_change",
    "pose_texts",
    "rate_text",
]

BASELINE = "Hartley"  # the method that all others are compared with
RESAMPLES = 2000  # bootstrap resamples of a paired test
MIN_P_VALUE = 1e-3  # the smallest p-value that these resamples can resolve
MIN_BOOTSTRAP_PAIRS = 8  # image pairs; a bootstrap over fewer is too narrow: no interval, no p-value
POSE_HEADER = ("AUC@5", "AUC@10", "AUC@20", "mAA(10)")


def known_parts(table: Table) -> Table | None:
    """Return a table without the columns and rows that have no number; None if there is none in the whole table.

    The first column has names. Cells are empty where a number is unknown, and ``-`` for a method against itself.

    Example:
        >>> known_parts(Table("Errors", "", ["method", "own", "truth"], [["a", "1", ""], ["b", "", "-"]])).rows
        [['a', '1']]

    """
    known = [row for row in table.rows if any(cell not in ("", "-") for cell in row[1:])]
    places = range(1, len(table.header))
    columns = [0, *(place for place in places if any(row[place] not in ("", "-") for row in known))]
    rows = [[row[place] for place in columns] for row in known]
    return table._replace(header=[table.header[place] for place in columns], rows=rows) if rows else None


def percent_change(log_ratio: float) -> str:
    """Return the change of a geometric mean in % from the mean difference of logarithms."""
    return f"{100 * math.expm1(log_ratio):+.1f}"


def number_text(value: float, spec: str = ".3f") -> str:
    """Return a number as text, empty for NaN."""
    return "" if math.isnan(value) else format(value, spec)


def median_text(values: Tensor, spec: str = ".3f") -> str:
    """Return the median of the values that are not NaN as text, empty where there are none."""
    return number_text(median(values.flatten()).item(), spec)


def mean_text(values: Tensor, pair: Tensor) -> str:
    """Return the mean of shares (S,) with its 95 % bootstrap interval over image pairs, %.

    NaN is left out. There is no interval of fewer than :data:`MIN_BOOTSTRAP_PAIRS` pairs, and no text without shares.

    Example:
        >>> mean_text(torch.tensor([1.0, 0.0]), torch.tensor([0, 1]))
        '50.0'
        >>> mean_text(torch.ones(8), torch.arange(8))
        '100.0 [100.0, 100.0]'

    """
    values, pair = values[~values.isnan()], pair[~values.isnan()]
    if len(values) == 0:
        return ""
    mean = f"{100 * values.mean().item():.1f}"
    if len(torch.unique(pair)) < MIN_BOOTSTRAP_PAIRS:
        return mean
    low, high = bootstrap_interval(values, pair)
    return f"{mean} [{100 * low:.1f}, {100 * high:.1f}]"


def rate_text(cell: Cell, name: str, baseline: str, quantity: str, rows: Tensor | None = None) -> str:
    """Return a better rate against a baseline with its interval, %, of all samples or of those in the mask ``rows``."""
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
    """Return the mean difference of two methods with its 95 % interval and p-value, from a paired bootstrap over pairs.

    Without ``pair`` each number is of its own pair. ``show`` formats the mean and the ends of the interval. The text is
    empty if no pair has a finite difference, and the mean alone if fewer than :data:`MIN_BOOTSTRAP_PAIRS` have.
    """
    pair = torch.arange(len(values)) if pair is None else pair
    valid = (values - baseline).isfinite()
    if not valid.any():
        return ""
    if len(torch.unique(pair[valid])) < MIN_BOOTSTRAP_PAIRS:
        return show((values - baseline)[valid].mean().item())
    found = paired_bootstrap(values[valid], baseline[valid], pair[valid], draws=RESAMPLES)
    text = f"{show(found.mean)} [{show(found.low)}, {show(found.high)}]"
    p_value = f"< {MIN_P_VALUE:g}" if found.p_value < MIN_P_VALUE else f"{found.p_value:.3f}"
    return f"{text}, {p_value}" if with_p_value else text


def pose_texts(rotation_error: Tensor, translation_error: Tensor) -> list[str]:
    """Return AUC at 5, 10 and 20 degrees and mAA(10) of relative poses, %; empty texts if no true pose is known.

    Both errors are in degrees, infinite for a failure and NaN where the true pose is not known.
    """
    error = torch.maximum(rotation_error, translation_error)
    error = error[~error.isnan()]
    if len(error) == 0:
        return [""] * len(POSE_HEADER)
    return [f"{100 * value:.1f}" for value in (*pose_auc(error), mean_average_accuracy(error))]

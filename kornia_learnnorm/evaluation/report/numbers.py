"""Numbers of a report's tables, with intervals and p-values; an empty text where a number is unknown."""

import math

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.runs.prediction_run import RunCell
from kornia_learnnorm.evaluation.tables import Cell, Number
from kornia_learnnorm.metrics.poses import mean_average_accuracy, pose_auc
from kornia_learnnorm.metrics.statistics import bootstrap_interval, comparable, median, paired_bootstrap

BASELINE = "Hartley"  # the method that all others are compared with
RESAMPLES = 2000  # bootstrap resamples of a paired test
MIN_BOOTSTRAP_PAIRS = 8  # image pairs; a bootstrap over fewer is too narrow: no interval, no p-value
MIN_DISTANCE = 1e-6  # pixels; smaller distances are clamped before the logarithm
POSE_HEADER = ("AUC@5", "AUC@10", "AUC@20", "mAA(10)")


def percent_change(log_ratio: float) -> float:
    """Return the change of a geometric mean in % from the mean difference of logarithms."""
    return 100 * math.expm1(log_ratio)


def number(value: float, spec: str = ".3f") -> Cell:
    """Return a number, unknown if it is NaN."""
    return "" if math.isnan(value) else Number(value, spec)


def median_number(values: Tensor, spec: str = ".3f") -> Cell:
    """Return the median of the values that are not NaN."""
    return number(median(values.flatten()).item(), spec)


def mean_share(values: Tensor, pair: Tensor) -> Cell:
    """Return the mean of shares (S,) with its 95 % bootstrap interval over enough image pairs, %; NaN is left out."""
    values, pair = values[~values.isnan()], pair[~values.isnan()]
    if len(values) == 0:
        return ""
    found = Number(100 * values.mean().item(), ".1f")
    if len(torch.unique(pair)) < MIN_BOOTSTRAP_PAIRS:
        return found
    low, high = bootstrap_interval(values, pair)
    return found._replace(interval=(100 * low, 100 * high))


def better_share(cell: RunCell, name: str, baseline: str, quantity: str) -> Cell:
    """Return a better rate against a baseline with its interval, %."""
    value, other = cell.predictions[name][quantity], cell.predictions[baseline][quantity]
    valid = comparable(value, other)
    return mean_share((value < other)[valid].double(), cell.pair[valid])


def paired_change(values: Tensor, baseline: Tensor, pair: Tensor | None = None, *, logarithms: bool = False) -> Cell:
    """Return the mean difference of two methods with its 95 % interval and p-value, from a paired bootstrap over pairs.

    Differences of ``logarithms`` become changes of the geometric mean, %; the mean stands alone if pairs are too few.
    """
    pair = torch.arange(len(values)) if pair is None else pair
    valid = (values - baseline).isfinite()
    if not valid.any():
        return ""
    show, spec = (percent_change, "+.1f") if logarithms else (float, "+.3f")
    if len(torch.unique(pair[valid])) < MIN_BOOTSTRAP_PAIRS:
        return Number(show((values - baseline)[valid].mean().item()), spec)
    found = paired_bootstrap(values[valid], baseline[valid], pair[valid], draws=RESAMPLES)
    return Number(show(found.mean), spec, (show(found.low), show(found.high)), found.p_value)


def pose_numbers(rotation_error: Tensor, translation_error: Tensor) -> list[Cell]:
    """Return AUC at 5, 10 and 20 degrees and mAA(10) of errors in degrees, %; unknown if no true pose is known."""
    error = torch.maximum(rotation_error, translation_error)
    error = error[~error.isnan()]
    if len(error) == 0:
        return [""] * len(POSE_HEADER)
    return [Number(100 * value, ".1f") for value in (*pose_auc(error), mean_average_accuracy(error))]

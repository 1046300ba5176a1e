"""Tables of methods from the errors of their samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from kornia_learnnorm.files import short_name
from kornia_learnnorm.metrics.better_rate import better_rate, comparable
from kornia_learnnorm.metrics.summary import median

__all__ = ["DIAGNOSTICS", "HEADER", "diagnostic_rows", "format_table", "method_rows", "names_of"]

HEADER = (
    "method",
    "better than Hartley %",
    "than whitening %",
    "mean px",
    "median px",
    "truth: median px",
    "truth: better than Hartley %",
)
DIAGNOSTICS = ("method", "condition number", "rho", "distance 1", "distance 2", "error due to rank 2 %")

Predictions = Mapping[str, Mapping[str, Tensor]]


def method_rows(predictions: Predictions) -> list[list[str]]:
    """Return a row per method in the order of :data:`HEADER`, from the errors of each sample, pixels, (S,).

    ``own`` is the mean symmetric epipolar distance of a sample's points, ``truth`` the median one of its pair's
    ground-truth inliers, NaN where there are none. The mean leaves out samples whose residual is infinite for any
    method (a point on an epipole). Without Hartley or whitening among the methods, their rates are empty.
    """
    finite = torch.stack([errors["own"] for errors in predictions.values()]).isfinite().all(0)
    rows = []
    for name, errors in predictions.items():
        own, truth = errors["own"], errors["truth"]
        rates = [_rate(predictions, name, baseline, "own") for baseline in ("Hartley", "whitening")]
        numbers = [f"{own[finite].mean().item():.3f}", f"{median(own).item():.3f}"]
        accuracy = "-" if truth.isnan().all() else f"{median(truth).item():.3f}"
        rows.append([name, *rates, *numbers, accuracy, _rate(predictions, name, "Hartley", "truth")])
    return rows


def _rate(predictions: Predictions, name: str, baseline: str, quantity: str) -> str:
    if name == baseline or baseline not in predictions:
        return "-"
    errors, other = predictions[name][quantity], predictions[baseline][quantity]
    return f"{100 * better_rate(errors, other).rate:.1f}" if comparable(errors, other).any() else "-"


def diagnostic_rows(predictions: Predictions) -> list[list[str]]:
    """Return a row per method in the order of :data:`DIAGNOSTICS`: the medians of the diagnostics of a run."""
    rows = []
    for name, found in predictions.items():
        numbers = [median(found[key]).item() for key in ("condition_number", "rho", "distance1", "distance2")]
        rank2 = 100 * median(found["rank2_share"]).item()
        rows.append([name, *(f"{number:.4g}" for number in numbers), f"{rank2:z.0f}"])
    return rows


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with padded columns, the first aligned left and the others right.

    Example:
        >>> print(format_table(["method", "px"], [["Hartley", "1.5"]]))
        | method  |  px |
        |:--------|----:|
        | Hartley | 1.5 |

    """
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = [c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths, strict=True))]
        return "| " + " | ".join(padded) + " |"

    rule = "|" + "|".join(":" + "-" * (w + 1) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([line(header), rule, *map(line, rows)])


def names_of(paths: Sequence[str], shorten: Callable[[str], str] = short_name, what: str = "files") -> dict[str, str]:
    """Return the short names of files, methods or estimators, which tables show; raise ValueError if two are equal."""
    names = [shorten(path) for path in paths]
    if twice := {name for name in names if names.count(name) > 1}:
        text = f"two {what} have the same name, {', '.join(sorted(twice))}"
        raise ValueError(f"{text}: rename a file or leave out one of {', '.join(paths)}")
    return dict(zip(paths, names, strict=True))

"""Tables of methods from their residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.predict import Residuals
from kornia_learnnorm.metrics.better_rate import better_rate

__all__ = ["format_table", "method_rows", "names_of"]

HEADER = (
    "method",
    "better than Hartley %",
    "than whitening %",
    "mean px",
    "median px",
    "truth: median px",
    "truth: better than Hartley %",
)


def method_rows(residuals: Mapping[str, Residuals]) -> list[list[str]]:
    """Make a row per method: better rates, mean and median residual, ground-truth residual and its better rate.

    Args:
        residuals: residuals by method, with ``"Hartley"`` and ``"whitening"`` among them.

    Returns:
        cells as text, in the order of :data:`HEADER`. The mean leaves out samples whose residual is infinite for any
        method (a point on an epipole).

    """
    finite = torch.stack([r.own for r in residuals.values()]).isfinite().all(0)
    rows = []
    for name, (own, truth) in residuals.items():
        rates = [_rate(own, residuals[baseline].own, name == baseline) for baseline in ("Hartley", "whitening")]
        known = ~truth.isnan()
        truth_cells = ["-", "-"]
        if bool(known.any()):
            truth_rate = _rate(truth[known], residuals["Hartley"].ground_truth[known], name == "Hartley")
            truth_cells = [f"{truth[known].quantile(0.5).item():.3f}", truth_rate]
        mean, median = own[finite].mean().item(), own.quantile(0.5).item()
        rows.append([name, *rates, f"{mean:.3f}", f"{median:.3f}", *truth_cells])
    return rows


def _rate(residual: Tensor, baseline: Tensor, same: bool) -> str:
    return "-" if same else f"{100 * better_rate(residual, baseline).rate:.1f}"


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


def names_of(paths: Sequence[str]) -> list[str]:
    """Return short names of files, or of the runs that left them, for tables.

    Raises:
        ValueError: if two have the same name.

    """
    files = [Path(path) for path in paths]
    names = [f.resolve().parent.name if f.name == "weights.safetensors" else f.name for f in files]
    names = [name.removesuffix(".safetensors").replace(".h5", "") for name in names]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"two files have the same name, {', '.join(sorted(twice))}: {', '.join(paths)}")
    return names

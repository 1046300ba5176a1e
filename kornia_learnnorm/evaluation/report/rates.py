"""The better rates of a report: methods and what they were trained on by test store."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.evaluation.runs.run import Cell, Run
from kornia_learnnorm.evaluation.runs.trained import was_trained_on
from kornia_learnnorm.metrics.better_rate import better_rate, bootstrap_interval, comparable

__all__ = ["BASELINE", "RESAMPLES", "Table", "mean_text", "p_text", "rate_tables", "rate_text", "with_baseline"]

BASELINE = "Hartley"
RESAMPLES = 2000  # of a paired test
# Fan et al., Table 1: better than Hartley % by training set, on KITTI 06-10 and on TUM at KITTI's size.
PRINTED = {"KITTI 00-05": ("86.68", "90.04"), "TUM": ("84.22", "89.73"), "KITTI 00-05 and TUM": ("87.05", "91.43")}
TESTS = (("kitti_06", "kitti_07", "kitti_08", "kitti_09", "kitti_10"), ("tum",))  # beginnings of stores' names


class Table(NamedTuple):
    """A table of a report.

    Attributes:
        title: heading.
        text: what it shows and how to read it, Markdown.
        header: names of the columns.
        rows: cells as text.
    """

    title: str
    text: str
    header: list[str]
    rows: list[list[str]]


def with_baseline(run: Run) -> Run:
    """Leave out the stores and protocols in which the method is missing that all are compared with.

    Args:
        run: predictions.

    Raises:
        ValueError: if nothing is left.

    """
    cells = [cell for cell in run.cells if BASELINE in cell.predictions]
    if not cells:
        there = sorted({name for cell in run.cells for name in cell.predictions})
        raise ValueError(
            f"a report compares with {BASELINE}, the run has predictions of {', '.join(there) or 'no method'} so far:"
            f" learnnorm evaluate goes on with it, with {BASELINE} among --methods"
        )
    left = [f"{cell.title}, without {BASELINE}" for cell in run.cells if BASELINE not in cell.predictions]
    return replace(run, cells=cells, missing=[*run.missing, *left])


def rate_tables(run: Run) -> list[Table]:
    """Make the tables of rates against Hartley and, where the run has it, whitening.

    Args:
        run: predictions with ``Hartley`` in every store and protocol.

    """
    tables = []
    for baseline in (BASELINE, "whitening"):
        for protocol in ("filtered", "unfiltered"):
            cells = [cell for cell in run.cells if cell.protocol == protocol and baseline in cell.predictions]
            if cells:
                tables.append(_better_rates(run, cells, baseline))
    return tables


def _better_rates(run: Run, cells: list[Cell], baseline: str) -> Table:
    trained, protocol = run.about["trained_on"], cells[0].protocol
    rows = []
    for name in run.about["methods"]:
        marks = [" *" if was_trained_on(cell.store, trained[name]) else "" for cell in cells]
        rates = [
            "-" if name == baseline else rate_text(cell, name, baseline, "own") if name in cell.predictions else ""
            for cell in cells
        ]
        rows.append([name, ", ".join(trained[name]) or "-", *map("".join, zip(rates, marks, strict=True))])
    found = [
        better_rate(prediction["own"], cell.predictions[baseline]["own"])
        for cell in cells
        for name, prediction in cell.predictions.items()
        if name != baseline
    ]
    ties, degenerate = sum(rate.ties for rate in found), sum(rate.degenerate for rate in found)
    text = (
        f"Share of samples of {run.about['size']} correspondences with a smaller mean symmetric epipolar distance than "
        f"under {baseline}, %, and 95 % bootstrap interval over image pairs. "
        "An asterisk: trained on pairs of this store. "
        f"In the whole table {ties} ties count as not better and {degenerate} degenerate comparisons are left out. "
        "The header counts the samples, of all drawn: left out are those whose mean symmetric epipolar "
        f"distance under the eight-point algorithm without normalisation is not below {run.about['max_residual']:g} px."
    )
    if protocol == "filtered":
        text += (
            f" Filtered: of matches whose nearest descriptor is less than {RATIO:g} times as far as the second nearest."
        )
    if (protocol, baseline) == ("filtered", BASELINE):
        rows += [["Fan et al., as printed", train, *_printed(cells, values)] for train, values in PRINTED.items()]
        text += " Fan et al. test on KITTI 06-10 and on TUM freiburg3_long_office at KITTI's size."
    header = ["method", "trained on", *(f"{cell.store}: {len(cell.pair)} of {cell.drawn}" for cell in cells)]
    title = f"Better than {baseline}, {protocol}{' (Table 1)' if baseline == BASELINE else ''}"
    return Table(title, text, header, rows)


def _printed(cells: list[Cell], values: tuple[str, str]) -> list[str]:
    both = list(zip(TESTS, values, strict=True))
    return [next((value for names, value in both if cell.store.startswith(names)), "") for cell in cells]


def rate_text(cell: Cell, name: str, baseline: str, quantity: str, rows: Tensor | None = None) -> str:
    """Return a better rate with its interval, %.

    Args:
        cell: predictions.
        name: the method.
        baseline: what it is compared with.
        quantity: which error counts.
        rows: which samples, boolean (S,); all when not given.

    """
    rows = torch.ones_like(cell.pair, dtype=torch.bool) if rows is None else rows
    value, other = cell.predictions[name][quantity][rows], cell.predictions[baseline][quantity][rows]
    valid = comparable(value, other)
    return mean_text((value < other)[valid].double(), cell.pair[rows][valid])


def mean_text(values: Tensor, pair: Tensor) -> str:
    """Return the mean of shares with its 95 % bootstrap interval over image pairs, %.

    Args:
        values: shares with shape (S,).
        pair: image pair of each with shape (S,).

    Returns:
        the text, without interval where there is one pair, empty where there are no values.

    """
    if len(values) == 0:
        return ""
    mean = f"{100 * values.mean().item():.1f}"
    if len(torch.unique(pair)) < 2:
        return mean
    low, high = bootstrap_interval(values, pair)
    return f"{mean} [{100 * low:.1f}, {100 * high:.1f}]"


def p_text(p_value: float) -> str:
    """Return a p-value of a paired test; :data:`RESAMPLES` can tell nothing about smaller ones than 0.001.

    Example:
        >>> p_text(2 / 2001), p_text(0.0123)
        ('< 0.001', '0.012')

    """
    return "< 0.001" if p_value < 1e-3 else f"{p_value:.3f}"

"""The better rates of a report: methods and what they were trained on by test store."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.run import Cell, Run
from kornia_learnnorm.evaluation.trained import saw
from kornia_learnnorm.metrics import better_rate, bootstrap_interval, comparable

__all__ = ["BASELINE", "Table", "mean_text", "rate_tables", "rate_text"]

BASELINE = "Hartley"
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


def rate_tables(run: Run) -> list[Table]:
    """Make the tables of rates against Hartley and, where the run has it, whitening.

    Args:
        run: predictions with ``Hartley`` among the methods.

    """
    return [
        _better_rates(run, protocol, baseline)
        for baseline in (BASELINE, "whitening")
        if baseline in run.about["methods"]
        for protocol in ("filtered", "unfiltered")
    ]


def _better_rates(run: Run, protocol: str, baseline: str) -> Table:
    cells = [cell for cell in run.cells if cell.protocol == protocol]
    trained = run.about["trained_on"]
    rows = []
    for name in run.about["methods"]:
        marks = [" *" if saw(trained[name], cell.store) else "" for cell in cells]
        rates = ["-" if name == baseline else rate_text(cell, name, baseline, "own") for cell in cells]
        rows.append([name, ", ".join(trained[name]) or "-", *map("".join, zip(rates, marks, strict=True))])
    found = [
        better_rate(prediction["own"], cell.predictions[baseline]["own"])
        for cell in cells
        for name, prediction in cell.predictions.items()
        if name != baseline
    ]
    ties, degenerate = sum(rate.ties for rate in found), sum(rate.degenerate for rate in found)
    text = (
        "Share of samples of eight correspondences with a smaller mean symmetric epipolar distance than under "
        f"{baseline}, %, and 95 % bootstrap interval over image pairs. An asterisk: trained on pairs of this store. "
        f"In the whole table {ties} ties count as not better and {degenerate} degenerate comparisons are left out. "
        "The header counts the samples below 60 px."
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

"""Tables: their form as Markdown and as JSON, and those of methods from the errors of their samples."""

from __future__ import annotations

import importlib.metadata
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.files import short_name
from kornia_learnnorm.metrics.better_rate import better_rate, comparable
from kornia_learnnorm.metrics.summary import median

__all__ = [
    "DIAGNOSTICS",
    "HEADER",
    "Table",
    "diagnostic_rows",
    "format_table",
    "method_rows",
    "names_of",
    "tables_as_json",
]

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

_NUMBER = r"([+-]?\d+(?:\.\d*)?(?:e[+-]?\d+)?)"
# A number; its interval and p-value, or the standard deviation of a run's mean; * for a
# store that was trained on.
CELL = re.compile(rf"{_NUMBER}(?: \[{_NUMBER}, {_NUMBER}\](?:, (?:< )?{_NUMBER})?)?(?: ± {_NUMBER})?( \*)?")
PARTS = ("value", "low", "high", "p", "std", "trained_on")

Predictions = Mapping[str, Mapping[str, Tensor]]


class Table(NamedTuple):
    """A table; an empty cell is an unknown number, ``-`` one that is not defined, as of a method against itself."""

    title: str
    text: str  # what the table shows and how to read it, Markdown
    header: list[str]
    rows: list[list[str]]  # cells as text


def tables_as_json(command: str, tables: Sequence[Table]) -> str:
    """Return the tables of a command as a JSON object with ``command``, ``version`` and ``tables``.

    Each table has ``title``, ``text`` and ``rows``, objects by the names of the columns. A cell is a number; an object
    with ``value`` and, where the table has them, ``low`` and ``high`` (interval), ``p``, ``std`` and ``trained_on``;
    null where the table is empty or has ``-``; otherwise its text. Numbers are rounded as in the printed table.

    Example:
        >>> print(tables_as_json("learnnorm ...", [Table("A", "", ["method", "px"], [["mine", "1.5 [1.2, 2]"]])]))
        {"command": "learnnorm ...",... "rows": [{"method": "mine", "px": {"value": 1.5, "low": 1.2, "high": 2}}]}]}

    """
    content = {
        "command": command,
        "version": importlib.metadata.version("kornia_learnnorm"),
        "tables": [{"title": t.title, "text": t.text, "rows": [_row(t.header, row) for row in t.rows]} for t in tables],
    }
    return json.dumps(content, allow_nan=False)


def _row(header: Sequence[str], row: Sequence[str]) -> dict[str, Any]:
    name, *cells = row
    return {header[0]: name, **{column: _value(cell) for column, cell in zip(header[1:], cells, strict=True)}}


def _value(cell: str) -> Any:
    """Return what a cell says, for JSON."""
    if cell in ("", "-"):
        return None
    if not (found := CELL.fullmatch(cell)):
        return cell
    *numbers, star = found.groups()
    parts = [*(None if number is None else json.loads(number.lstrip("+")) for number in numbers), bool(star) or None]
    known = {name: part for name, part in zip(PARTS, parts, strict=True) if part is not None}
    return known if len(known) > 1 else known["value"]


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

"""Tables of numbers, with intervals and p-values, which are rounded where they are shown; empty where unknown."""

import importlib.metadata
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from kornia_learnnorm.files import short_name
from kornia_learnnorm.metrics import poses, statistics
from kornia_learnnorm.optional import import_extra

RESAMPLES = 2000  # bootstrap resamples of a paired test
MIN_P_VALUE = 1e-3  # the smallest p-value that the resamples of a report can resolve
MIN_BOOTSTRAP_PAIRS = 8  # image pairs; a bootstrap over fewer is too narrow: no interval, no p-value
POSE_HEADER = ("AUC@5", "AUC@10", "AUC@20", "mAA(10)")


class Number(NamedTuple):
    """A number and what stands beside it."""

    value: float
    spec: str = ".3f"  # format of the value, the interval and the standard deviation
    interval: tuple[float, float] | None = None
    p_value: float | None = None
    std: float | None = None  # of the mean of a run
    trained_on: bool = False  # whether the method was trained on the store

    def __str__(self) -> str:
        text = format(self.value, self.spec)
        if self.interval is not None:
            text += " [{:{spec}}, {:{spec}}]".format(*self.interval, spec=self.spec)
        if self.p_value is not None:
            text += f", < {MIN_P_VALUE:g}" if self.p_value < MIN_P_VALUE else f", {self.p_value:.3f}"
        text += "" if self.std is None else f" ± {self.std:{self.spec}}"
        return f"{text} *" if self.trained_on else text

    def as_json(self) -> Any:
        """Return the rounded number, or an object with the numbers beside it; a number that is not finite as text."""
        if not math.isfinite(self.value):
            return str(self)
        low, high = self.interval or (None, None)
        parts = {"value": self.value, "low": low, "high": high, "std": self.std}
        known = {name: float(format(part, self.spec)) for name, part in parts.items() if part is not None}
        if self.p_value is not None:
            known["p"] = max(MIN_P_VALUE, round(self.p_value, 3))
        found: dict[str, Any] = known | {"trained_on": True} if self.trained_on else known
        return found if len(found) > 1 else found["value"]


Cell = str | int | Number


def percent_change(log_ratio: float) -> float:
    """Return the change of a geometric mean in % from the mean difference of logarithms."""
    return 100 * math.expm1(log_ratio)


def number(value: float, spec: str = ".3f") -> Cell:
    """Return a number, unknown if it is NaN."""
    return "" if math.isnan(value) else Number(value, spec)


def median_number(values: Tensor, spec: str = ".3f") -> Cell:
    """Return the median of the values that are not NaN."""
    return number(statistics.median(values.flatten()).item(), spec)


def mean_share(values: Tensor, pair: Tensor) -> Cell:
    """Return the mean of shares (S,) with its 95 % bootstrap interval over enough image pairs, %; NaN is left out."""
    values, pair = values[~values.isnan()], pair[~values.isnan()]
    if len(values) == 0:
        return ""
    found = Number(100 * values.mean().item(), ".1f")
    if len(torch.unique(pair)) < MIN_BOOTSTRAP_PAIRS:
        return found
    low, high = statistics.bootstrap_interval(values, pair)
    return found._replace(interval=(100 * low, 100 * high))


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
    found = statistics.paired_bootstrap(values[valid], baseline[valid], pair[valid], draws=RESAMPLES)
    return Number(show(found.mean), spec, (show(found.low), show(found.high)), found.p_value)


def pose_numbers(rotation_error: Tensor, translation_error: Tensor) -> list[Cell]:
    """Return AUC at 5, 10 and 20 degrees and mAA(10) of errors in degrees, %; unknown if no true pose is known."""
    error = torch.maximum(rotation_error, translation_error)
    error = error[~error.isnan()]
    if len(error) == 0:
        return [""] * len(POSE_HEADER)
    return [Number(100 * value, ".1f") for value in (*poses.pose_auc(error), poses.mean_average_accuracy(error))]


class Table(NamedTuple):
    """A table; an empty cell is an unknown number, ``-`` one that is not defined, as of a method against itself."""

    title: str
    text: str  # what the table shows and how to read it, Markdown
    header: list[str]
    rows: list[list[Cell]]

    def known_parts(self) -> Self | None:
        """Return the table without rows, and columns after the first, that have no number; None if none is left."""
        known = [row for row in self.rows if any(map(_is_known, row[1:]))]
        places = [0, *(i for i in range(1, len(self.header)) if any(_is_known(row[i]) for row in known))]
        rows = [[row[i] for i in places] for row in known]
        return self._replace(header=[self.header[i] for i in places], rows=rows) if rows else None


def _is_known(cell: Cell) -> bool:
    return cell not in ("", "-")


def tables_as_json(command: str, tables: Sequence[Table]) -> str:
    """Return the tables of a command as a JSON object: rows by the names of columns, null for an unknown cell."""

    def value(cell: Cell) -> Any:
        return cell.as_json() if isinstance(cell, Number) else cell if _is_known(cell) else None

    found = [
        {"title": t.title, "text": t.text, "rows": [dict(zip(t.header, map(value, r), strict=True)) for r in t.rows]}
        for t in tables
    ]
    content = {"command": command, "version": importlib.metadata.version("kornia_learnnorm"), "tables": found}
    return json.dumps(content, allow_nan=False)


def format_table(header: Sequence[str], rows: Sequence[Sequence[Cell]], form: str = "pipe", **options: Any) -> str:
    """Return a table, the first column aligned left and the others right; ``form`` and ``options`` are tabulate's."""
    tabulate = import_extra("tabulate", "images", "printing tables").tabulate
    options |= {"colalign": ("left", *["right"] * (len(header) - 1)), "disable_numparse": True}
    return str(tabulate([[*map(str, row)] for row in rows], [*header], tablefmt=form, **options))


def names_of(paths: Sequence[str], shorten: Callable[[str], str] = short_name, what: str = "files") -> dict[str, str]:
    """Return the short names of files, methods or estimators, which tables show; raise ValueError if two are equal."""
    names = [shorten(path) for path in paths]
    if twice := {name for name in names if names.count(name) > 1}:
        text = f"two {what} have the same name, {', '.join(sorted(twice))}"
        raise ValueError(f"{text}: rename a file or leave out one of {', '.join(paths)}")
    return dict(zip(paths, names, strict=True))

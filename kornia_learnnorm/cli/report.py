"""Tables and figures of a run: ``learnnorm report``. No model is run."""

from __future__ import annotations

import argparse
import html
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.evaluation.report.figures import report_figures
from kornia_learnnorm.evaluation.report.hypotheses import hypothesis_figures, hypothesis_tables
from kornia_learnnorm.evaluation.report.printing import print_tables
from kornia_learnnorm.evaluation.report.rates import Table, with_baseline
from kornia_learnnorm.evaluation.report.robust import about_robust, robust_tables
from kornia_learnnorm.evaluation.report.style import Picture
from kornia_learnnorm.evaluation.report.tables import report_tables
from kornia_learnnorm.evaluation.robust.run import read_robust
from kornia_learnnorm.evaluation.runs.manifest import read_section
from kornia_learnnorm.evaluation.runs.run import Run, read_run
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.files import atomic_write

__all__ = ["Report", "add_arguments", "run", "write_report"]

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2rem auto; padding: 0 1rem;
       color: light-dark(#1d2329, #dfe5ea); background: light-dark(#fff, #14181d); }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 0.25rem 0.6rem; text-align: right; white-space: nowrap;
         border-bottom: 1px solid light-dark(#d8dee4, #333b44); }
th:first-child, td:first-child { text-align: left; }
th { white-space: normal; vertical-align: bottom; }
.wide { overflow-x: auto; }
svg { width: 100%; height: auto; font-family: system-ui, sans-serif; }
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm report`` to a parser."""
    parser.add_argument("folder", metavar="RUN", type=Path, help="what learnnorm evaluate or robust --out wrote")


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm report``: write ``report.md``, ``report.html`` and the figures, and print what fits the terminal.

    Raises:
        FileNotFoundError: if the run is not there or not complete.
        ValueError: if a file of it is damaged.
        ImportError: if Matplotlib or rich is not installed.

    """
    report = write_report(args.folder)
    print_tables(report.tables, args.folder / "report.html")
    if report.missing:
        print(f"not there yet, so left out: {'; '.join(report.missing)}", file=sys.stderr)
    print(f"wrote {args.folder / 'report.md'} and {args.folder / 'report.html'}")
    return 0


class Report(NamedTuple):
    """What a report has.

    Attributes:
        tables: the tables.
        missing: what of the run is not there yet.
    """

    tables: list[Table]
    missing: list[str]


def write_report(folder: str | Path) -> Report:
    """Write ``report.md`` with its figures and a self-contained ``report.html`` into a run.

    Args:
        folder: what ``learnnorm evaluate --out`` or ``learnnorm robust --out`` wrote, or both.

    Returns:
        the tables, and what the run lacks.

    Raises:
        FileNotFoundError: if the run is not there or not complete.
        ValueError: if a file of it is damaged.
        ImportError: if Matplotlib is not installed.

    """
    folder, about = Path(folder), []
    tables: list[Table] = []
    missing: list[str] = []
    pictures: list[Picture] = []
    robust = read_robust(folder)
    if robust is None or read_section(folder, "evaluate") is not None:
        found = with_baseline(read_run(folder))
        missing += found.missing
        about.append(_about(found))
        tables += report_tables(found)
        pictures += report_figures(found)
    if robust is not None:
        missing += robust.missing
        about.append(about_robust(robust))
        tables += [*robust_tables(robust), *hypothesis_tables(robust)]
        pictures += hypothesis_figures(robust)
    for picture in pictures:
        # A file of its own has no page to take its colour from: one that shows on white and on black.
        _write(folder / f"{picture.name}.svg", picture.svg.replace("currentColor", "#808890"))
    _write(folder / "report.md", _markdown(about, tables, pictures))
    _write(folder / "report.html", _html(about, tables, pictures))
    return Report(tables, missing)


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _about(run: Run) -> str:
    stores = "; ".join(f"`{name}`: {text}" for name, text in run.about["stores"].items())
    versions = ", ".join(f"{name} {version}" for name, version in run.about["versions"].items())
    missing = f" Not there yet, so left out: {'; '.join(run.missing)}." if run.missing else ""
    most = run.about["max_samples"]
    samples = "All samples" if most is None else f"At most {most} random samples"
    return (
        f"Stores: {stores}. Methods: {', '.join(run.about['methods'])}. {samples} of each store, with the ratio test "
        f"(the nearest descriptor less than {RATIO:g} times as far as the second nearest) and without, seed "
        f"{run.about['seed']}. {versions}.{missing}"
    )


def _markdown(about: Sequence[str], tables: Sequence[Table], pictures: Sequence[Picture]) -> str:
    parts = ["# Evaluation", *about]
    parts += [f"## {t.title}\n\n{t.text}\n\n{format_table(t.header, t.rows)}" for t in tables]
    parts += [f"## {p.title}\n\n{p.text}\n\n![{p.title}]({p.name}.svg)" for p in pictures]
    return "\n\n".join(parts) + "\n"


def _html(about: Sequence[str], tables: Sequence[Table], pictures: Sequence[Picture]) -> str:
    body = ["<h1>Evaluation</h1>", *(f"<p>{_inline(text)}</p>" for text in about)]
    for table in tables:
        rows = "".join(_row("td", row) for row in table.rows)
        grid = f"<table><thead>{_row('th', table.header)}</thead><tbody>{rows}</tbody></table>"
        body.append(f'<h2>{_inline(table.title)}</h2><p>{_inline(table.text)}</p><div class="wide">{grid}</div>')
    body += [f"<h2>{_inline(p.title)}</h2><p>{_inline(p.text)}</p><figure>{p.svg}</figure>" for p in pictures]
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>Evaluation</title>'
    return (
        f'<!doctype html><html lang="en"><head>{head}<style>{STYLE}</style></head><body>{"".join(body)}</body></html>\n'
    )


def _row(tag: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{_inline(cell)}</{tag}>" for cell in cells) + "</tr>"


def _inline(text: str) -> str:
    """Escape a text and set what stands in backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))

"""Report of a run as Markdown, as a self-contained HTML page and in the terminal; reads results and runs no model."""

import re
import shutil
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from kornia_learnnorm.evaluation.report import figures, method_tables, robust_tables, run_summary
from kornia_learnnorm.evaluation.report.figures import ReportPicture
from kornia_learnnorm.evaluation.robust.robust_run import RobustRun, read_robust
from kornia_learnnorm.evaluation.runs.prediction_run import Run, read_run
from kornia_learnnorm.evaluation.runs.results_store import read_section
from kornia_learnnorm.evaluation.tables import MIN_BOOTSTRAP_PAIRS, MIN_P_VALUE, Table, format_table
from kornia_learnnorm.files import write_text
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import RATIO

GREY = "#808890"  # lines and letters of a picture in its own file: legible on white and on black
NO_TERMINAL = 1000  # columns where the output goes to a file
INTERVALS = (
    f"Filtered matches: the nearest descriptor is less than {RATIO:g} times as far as the second nearest. In brackets "
    f"are 95 % bootstrap intervals over image pairs, of 2,000 resamples; fewer than {MIN_BOOTSTRAP_PAIRS} pairs have "
    f"neither interval nor p-value, and none below {MIN_P_VALUE:g} can be resolved."
)
PAGE_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2rem auto; padding: 0 1rem;
       color: light-dark(#1d2329, #dfe5ea); background: light-dark(#fff, #14181d); }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; display: block;
        overflow-x: auto; }
th, td { padding: 0.25rem 0.6rem; white-space: nowrap; border-bottom: 1px solid light-dark(#d8dee4, #333b44); }
th { white-space: normal; vertical-align: bottom; }
code { overflow-wrap: anywhere; }
a { color: light-dark(#0b63b0, #7cb8f2); }
p:has(svg) { overflow-x: auto; }
svg { width: 100%; min-width: 34rem; height: auto; font-family: system-ui, sans-serif; }
"""


def write_report(folder: Path) -> tuple[list[str], list[Table], list[str]]:
    """Write ``report.md``, ``report.html`` and the pictures into the folder of ``evaluate``, ``robust`` or both.

    Returns which method won, by store and protocol, Markdown; the tables; and what the run does not have yet.
    """
    import_extra("markdown_it", "report", "writing a report")  # before the work begins
    summary, about, tables = list[str](), list[str](), list[Table]()
    pictures, missing = list[ReportPicture](), list[str]()
    robust = read_robust(folder)
    if robust is None or read_section(folder, "evaluate") is not None:
        run = method_tables.with_baseline(read_run(folder))
        summary += run_summary.run_summary(run)
        about += _about_run(run)
        tables += method_tables.report_tables(run)
        pictures += figures.report_figures(run)
        missing += run.missing
    if robust is not None:
        summary += run_summary.robust_summary(robust)
        about += _about_robust(robust)
        tables += robust_tables.robust_tables(robust)
        missing += robust.missing
    for picture in pictures:
        write_text(folder / f"{picture.name}.svg", picture.svg.replace("currentColor", GREY))
    tables = [known for table in tables if (known := table.known_parts())]
    about.append(INTERVALS)
    page = _markdown(summary, about, tables, pictures)
    write_text(folder / "report.md", page)
    write_text(folder / "report.html", _html(page, pictures))
    return summary, tables, missing


def _about_run(run: Run) -> list[str]:
    """Return when and by what commands a run of predictions was made, and what it consists of."""
    about = run.about
    most = about["max_samples"]
    samples = "All samples" if most is None else f"At most {most} random samples"
    text = f"Methods: {', '.join(about['methods'])}. {samples} of each store, filtered and unfiltered, seed "
    text += f"{about['seed']}. {', '.join(map(' '.join, about['versions'].items()))}."
    if any(map(method_tables.papers_data, about["stores"].values())):
        text += " Numbers of tables and figures are those of Fan et al."
    return _described(run, f"Stores: {{}}. {text}")


def _about_robust(run: RobustRun) -> list[str]:
    about = run.about
    identities: dict[str, str | None] = about["estimators"]
    absent = [name for name, identity in identities.items() if identity is None]
    peers = {identity for name, identity in identities.items() if identity and " " in identity and ":" not in name}
    versions = ", ".join(dict.fromkeys([*map(" ".join, about["versions"].items()), *sorted(peers)]))
    pairs = f"at most {about['pairs']} evenly spaced image pairs" if about["pairs"] else "all image pairs"
    text = (
        f"{pairs} of each store, {about['seeds']} runs on each pair from seed {about['seed']} ({about['slow_seeds']} "
        f"of the slow estimators); PyTorch on {about['threads']} threads; {versions}."
    )
    text += f" Left out, since not installed: {', '.join(absent)}." if absent else ""
    return _described(run, f"Robust estimation: {{}}; {text}")


def _described(run: Run | RobustRun, text: str) -> list[str]:
    """Return the commands that made a run with their dates, none from Python, and a text with its stores."""
    stores = "; ".join(f"`{name}`: {about}" for name, about in run.about["stores"].items())
    missing = f" Not there yet, so left out: {'; '.join(run.missing)}." if run.missing else ""
    commands = [f"{date}: `{command}`" for command, date in run.about["commands"].items()]
    return [*commands, text.replace("{}", stores, 1) + missing]


def _markdown(summary: list[str], about: list[str], tables: list[Table], pictures: list[ReportPicture]) -> str:
    titles = ["Data and methods", *(table.title for table in tables), *(picture.title for picture in pictures)]
    parts = ["# Evaluation", "## Summary", "\n".join(f"- {text}" for text in summary), "## Contents"]
    parts += ["\n".join(f"- [{title}](#{_anchor(title)})" for title in titles), "## Data and methods", *about]
    parts += [f"## {t.title}\n\n{t.text}\n\n{format_table(t.header, t.rows)}" for t in tables]
    parts += [f"## {p.title}\n\n{p.text}\n\n![{p.title}]({p.name}.svg)" for p in pictures]
    return "\n\n".join(parts) + "\n"


def _html(markdown: str, pictures: list[ReportPicture]) -> str:
    parser = import_extra("markdown_it", "report", "writing a report").MarkdownIt("commonmark").enable("table")
    tokens = parser.parse(markdown)
    for token, content in pairwise(tokens):
        if token.type == "heading_open":
            token.attrSet("id", _anchor(content.content))
    body = parser.renderer.render(tokens, parser.options, {})
    for p in pictures:
        body = re.sub(rf'<img src="{p.name}.svg"[^>]*>', p.svg.replace("\\", r"\\"), body)
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>Evaluation</title>'
    return f'<!doctype html><html lang="en"><head>{head}<style>{PAGE_STYLE}</style></head><body>{body}</body></html>\n'


def _anchor(title: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def print_tables(tables: Sequence[Table], elsewhere: Path) -> None:
    """Print the tables that fit the terminal, and the titles of those that do not, which are in ``elsewhere``."""
    columns, wide = shutil.get_terminal_size((NO_TERMINAL, 24)).columns, []
    for table in tables:
        grids = (_grid(table, narrow) for narrow in (False, True))
        grid = next((text for text in grids if len(text.partition("\n")[0]) <= columns), None)
        if grid is None:
            wide.append(table.title)
        else:
            print(f"{table.title}\n{grid}\n{textwrap.fill(table.text, columns)}\n")
    if wide:
        titles = "\n".join(f"  {title}" for title in wide)
        print(f"wider than the {columns} columns of this terminal, see {elsewhere}:\n{titles}")


def _grid(table: Table, narrow: bool) -> str:
    """Return a table for the terminal; a narrow one breaks text between words, but no number from its interval."""
    options: dict[str, Any] = {}
    if narrow:
        columns = [[*map(str, cells)] for cells in zip(table.header, *table.rows, strict=True)]
        words = [[word for cell in cells for word in ([cell] if "[" in cell else cell.split())] for cells in columns]
        widths = [max(map(len, column)) for column in words]
        options = {"maxcolwidths": widths, "maxheadercolwidths": widths}
    return format_table(table.header, table.rows, "simple_outline", **options)

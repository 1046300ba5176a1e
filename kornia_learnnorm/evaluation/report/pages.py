"""Report of a run as Markdown, as a self-contained HTML page and in the terminal; reads results and runs no model.

It begins with what won, and has no table, column or row without a number.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kornia_learnnorm.evaluation.report.figures import report_figures
from kornia_learnnorm.evaluation.report.formatting import known_parts
from kornia_learnnorm.evaluation.report.hypotheses import hypothesis_figures, hypothesis_tables
from kornia_learnnorm.evaluation.report.rates import papers_data, with_baseline
from kornia_learnnorm.evaluation.report.robust import robust_tables
from kornia_learnnorm.evaluation.report.style import Picture
from kornia_learnnorm.evaluation.report.summary import robust_summary, run_summary
from kornia_learnnorm.evaluation.report.tables import report_tables
from kornia_learnnorm.evaluation.robust.run import RobustRun, read_robust
from kornia_learnnorm.evaluation.runs.run import Run, read_run
from kornia_learnnorm.evaluation.runs.store import read_section
from kornia_learnnorm.evaluation.tables import Table, format_table
from kornia_learnnorm.files import write_text
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import RATIO

__all__ = ["Report", "print_summary", "print_tables", "write_report"]

GREY = "#808890"  # lines and letters of a picture in its own file: legible on white and on black
PAGE_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2rem auto; padding: 0 1rem;
       color: light-dark(#1d2329, #dfe5ea); background: light-dark(#fff, #14181d); }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 0.25rem 0.6rem; text-align: right; white-space: nowrap;
         border-bottom: 1px solid light-dark(#d8dee4, #333b44); }
th:first-child, td:first-child { text-align: left; }
th { white-space: normal; vertical-align: bottom; }
.wide { overflow-x: auto; }
code { overflow-wrap: anywhere; }
a { color: light-dark(#0b63b0, #7cb8f2); }
figure { margin: 1rem 0; overflow-x: auto; }
svg { width: 100%; min-width: 34rem; height: auto; font-family: system-ui, sans-serif; }
"""


class Report(NamedTuple):
    """A written report."""

    summary: list[str]  # which method won, by store and protocol, Markdown
    tables: list[Table]
    missing: list[str]  # results that the run does not have yet


def write_report(folder: str | Path) -> Report:
    """Write ``report.md``, ``report.html`` and the pictures into the folder of a run.

    Args:
        folder: folder that ``learnnorm evaluate --out``, ``learnnorm robust --out`` or both wrote.

    Returns:
        the tables, and what is missing.

    Raises:
        FileNotFoundError: if the run does not exist or is not complete.
        ValueError: if a file of the run is damaged.
        ImportError: if Matplotlib is not installed.

    """
    folder = Path(folder)
    summary, about, tables = list[str](), list[str](), list[Table]()
    pictures, missing = list[Picture](), list[str]()
    robust = read_robust(folder)
    if robust is None or read_section(folder, "evaluate") is not None:
        run = with_baseline(read_run(folder))
        summary += run_summary(run)
        about += [*_commands(run.about), _about_run(run)]
        tables += report_tables(run)
        pictures += report_figures(run)
        missing += run.missing
    if robust is not None:
        summary += robust_summary(robust)
        about += [*_commands(robust.about), _about_robust(robust)]
        tables += [*robust_tables(robust), *hypothesis_tables(robust)]
        pictures += hypothesis_figures(robust)
        missing += robust.missing
    for picture in pictures:
        write_text(folder / f"{picture.name}.svg", picture.svg.replace("currentColor", GREY))
    page = _Page(summary, about, [known for table in tables if (known := known_parts(table))], pictures)
    write_text(folder / "report.md", page.markdown())
    write_text(folder / "report.html", page.html())
    return Report(summary, page.tables, missing)


def _commands(about: dict[str, Any]) -> list[str]:
    """Return the commands that made a run with their dates; none where it was made from Python."""
    return [f"{date}: `{command}`" for command, date in about["commands"].items()]


def _about_run(run: Run) -> str:
    """Return what a run of predictions consists of."""
    about = run.about
    most = about["max_samples"]
    samples = "All samples" if most is None else f"At most {most} random samples"
    papers = any(map(papers_data, about["stores"].values()))
    numbers = " Numbers of tables and figures are those of Fan et al." if papers else ""
    return (
        f"Stores: {_stores(about)}. Methods: {', '.join(about['methods'])}. {samples} of each store, filtered by the "
        f"ratio test (the nearest descriptor is less than {RATIO:g} times as far as the second nearest) and "
        f"unfiltered, seed {about['seed']}. {', '.join(_versions(about))}.{numbers}{_missing(run.missing)}"
    )


def _about_robust(run: RobustRun) -> str:
    """Return what a run of robust estimators consists of."""
    about = run.about
    identities: dict[str, str | None] = about["estimators"]
    absent = [name for name, identity in identities.items() if identity is None]
    peers = {identity for name, identity in identities.items() if identity and " " in identity and ":" not in name}
    versions = ", ".join(dict.fromkeys([*_versions(about), *sorted(peers)]))
    not_installed = f" Left out, since not installed: {', '.join(absent)}." if absent else ""
    return (
        f"Robust estimation: {_stores(about)}; {_pairs(about['pairs'])} of each store, {about['seeds']} runs on each "
        f"pair from seed {about['seed']} ({about['slow_seeds']} of the slow estimators), hypotheses of "
        f"{_pairs(about['hypotheses'])}; PyTorch on {about['threads']} threads; {versions}.{not_installed}"
        f"{_missing(run.missing)}"
    )


def _stores(about: dict[str, Any]) -> str:
    return "; ".join(f"`{name}`: {text}" for name, text in about["stores"].items())


def _versions(about: dict[str, Any]) -> list[str]:
    return [f"{name} {version}" for name, version in about["versions"].items()]


def _pairs(number: int) -> str:
    return f"at most {number} evenly spaced image pairs" if number else "all image pairs"


def _missing(missing: Sequence[str]) -> str:
    return f" Not there yet, so left out: {'; '.join(missing)}." if missing else ""


class _Page(NamedTuple):
    """What a report consists of, and its two forms."""

    summary: list[str]
    about: list[str]
    tables: list[Table]
    pictures: list[Picture]

    @property
    def titles(self) -> list[str]:
        """Titles of all sections after the contents."""
        return ["Data and methods", *(table.title for table in self.tables), *(p.title for p in self.pictures)]

    def markdown(self) -> str:
        """Return the report as Markdown."""
        contents = "\n".join(f"- [{title}](#{_anchor(title)})" for title in self.titles)
        parts = ["# Evaluation", "## Summary", "\n".join(f"- {text}" for text in self.summary)]
        parts += ["## Contents", contents, "## Data and methods", *self.about]
        parts += [f"## {t.title}\n\n{t.text}\n\n{format_table(t.header, t.rows)}" for t in self.tables]
        parts += [f"## {p.title}\n\n{p.text}\n\n![{p.title}]({p.name}.svg)" for p in self.pictures]
        return "\n\n".join(parts) + "\n"

    def html(self) -> str:
        """Return the report as a self-contained page."""
        contents = [f'<a href="#{_anchor(title)}">{_inline(title)}</a>' for title in self.titles]
        body = ["<h1>Evaluation</h1><h2>Summary</h2>", _list(map(_inline, self.summary))]
        body += ["<h2>Contents</h2>", f"<nav>{_list(contents)}</nav>", _heading("Data and methods")]
        body += [f"<p>{_inline(text)}</p>" for text in self.about]
        for table in self.tables:
            rows = "".join(_row("td", row) for row in table.rows)
            grid = f"<table><thead>{_row('th', table.header)}</thead><tbody>{rows}</tbody></table>"
            body.append(f'{_heading(table.title)}<p>{_inline(table.text)}</p><div class="wide">{grid}</div>')
        for picture in self.pictures:
            body.append(f"{_heading(picture.title)}<p>{_inline(picture.text)}</p><figure>{picture.svg}</figure>")
        head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>Evaluation</title>'
        head += f"<style>{PAGE_STYLE}</style>"
        return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>\n'


def _anchor(title: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def _heading(title: str) -> str:
    return f'<h2 id="{_anchor(title)}">{_inline(title)}</h2>'


def _list(items: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"


def _row(tag: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{_inline(cell)}</{tag}>" for cell in cells) + "</tr>"


def _inline(text: str) -> str:
    """Return a text as HTML, with the parts in backticks as code and those between two asterisks bold."""
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)


def print_summary(summary: Sequence[str]) -> None:
    """Print the summary of a report as plain text."""
    for text in summary:
        print(text.replace("**", "").replace("`", ""), end="\n\n")


def print_tables(tables: Sequence[Table], elsewhere: Path) -> None:
    """Print the tables that fit the terminal, and the titles of those that do not, which are in ``elsewhere``."""
    console, wide = import_extra("rich.console", "report", "printing tables").Console(), []
    unlimited = console.options.update_width(10**6)
    for table in tables:
        grids = (_grid(table, narrow) for narrow in (False, True))
        grid = next((g for g in grids if console.measure(g, options=unlimited).maximum <= console.width), None)
        if grid is None:
            wide.append(table.title)
        else:
            console.print(grid)
    if wide:
        titles = "\n".join(f"  {title}" for title in wide)
        print(f"wider than the {console.width} columns of this terminal, see {elsewhere}:\n{titles}")


def _grid(table: Table, narrow: bool) -> Any:
    """Return a table of rich; a narrow one breaks text between words, but no number from its interval."""
    grid = import_extra("rich.table", "report", "printing tables").Table(
        title=table.title, title_justify="left", caption=table.text, caption_justify="left"
    )
    for place, cells in enumerate(zip(table.header, *table.rows, strict=True)):
        words = [word for cell in cells for word in ([cell] if "[" in cell else cell.split())]
        width = max(map(len, words)) if narrow else None
        grid.add_column(cells[0], justify="right" if place else "left", width=width)
    for row in table.rows:
        grid.add_row(*row)
    return grid

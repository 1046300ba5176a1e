"""Printing the tables of a report that fit a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kornia_learnnorm.evaluation.report.formatting import Table
from kornia_learnnorm.optional import import_extra

__all__ = ["print_tables"]


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

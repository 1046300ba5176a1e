"""The tables of a report in a terminal, those that fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kornia_learnnorm.evaluation.report.rates import Table

__all__ = ["print_tables"]

FRAME = 3  # columns of the terminal that each column of a table takes for its line and margins


def print_tables(tables: Sequence[Table], elsewhere: Path) -> None:
    """Print the tables that the terminal is wide enough for, and name the others.

    Args:
        tables: the tables.
        elsewhere: the file that has them all.

    Raises:
        ImportError: if rich is not installed.

    """
    try:
        from rich.console import Console
        from rich.table import Table as RichTable
    except ImportError as error:
        raise ImportError("printing tables needs rich: pip install 'kornia-learnnorm[report]'") from error
    console, wide = Console(), []
    for table in tables:
        widths = column_widths(table, console.width)
        if widths is None:
            wide.append(table.title)
            continue
        shown = RichTable(title=table.title, title_justify="left", caption=table.text, caption_justify="left")
        for place, (name, width) in enumerate(zip(table.header, widths, strict=True)):
            shown.add_column(name, justify="left" if place == 0 else "right", width=width)
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)
    if wide:
        names = "\n".join(f"  {title}" for title in wide)
        print(f"wider than the {console.width} columns here, in {elsewhere}:\n{names}")


def column_widths(table: Table, width: int) -> list[int] | None:
    """Return how wide the columns of a table are in a terminal; nothing where it does not fit.

    Text may break between words, a figure with its interval may not.

    Args:
        table: the table.
        width: columns of the terminal.

    Example:
        >>> column_widths(Table("", "", ["method", "rate of it"], [["mine", "1.0 [0.5, 1.5]"]]), 30)
        [6, 14]

    """
    columns = [[name, *(row[place] for row in table.rows)] for place, name in enumerate(table.header)]
    least = [max(map(_unbroken, column)) for column in columns]
    spare = width - 1 - sum(least) - FRAME * len(least)
    if spare < 0:
        return None
    for place, column in enumerate(columns):
        more = min(spare, max(map(len, column)) - least[place])
        least[place] += more
        spare -= more
    return least


def _unbroken(cell: str) -> int:
    return len(cell) if "[" in cell else max(map(len, cell.split()), default=0)

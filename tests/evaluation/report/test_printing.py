"""Tables in a terminal."""

from __future__ import annotations

from pathlib import Path

import pytest

from kornia_learnnorm.evaluation.report.formatting import Table
from kornia_learnnorm.evaluation.report.printing import print_tables


@pytest.mark.parametrize(("columns", "header"), [(40, "rate of a long name"), (30, "rate of a long")])
def test_only_tables_that_fit_are_printed(monkeypatch, capsys, columns, header):
    monkeypatch.setenv("COLUMNS", str(columns))
    rows = [["mine", *(3 * ["12.3 [10.0, 14.0]"])]]
    short = Table("Short", "What it shows.", ["method", "rate of a long name"], [row[:2] for row in rows])
    print_tables([short, Table("Wide", "", ["method", "a", "b", "c"], rows)], Path("report.html"))
    text = capsys.readouterr().out
    assert "12.3 [10.0, 14.0]" in text
    assert f" {header} ┃" in text
    assert "…" not in text
    assert text.endswith(f"wider than the {columns} columns of this terminal, see report.html:\n  Wide\n")

"""Tables of the hypotheses of minimal solvers."""

from __future__ import annotations

import re

from kornia_learnnorm.evaluation.report.hypotheses import hypothesis_tables
from kornia_learnnorm.evaluation.robust.run import read_robust


def test_numbers_of_hypotheses(robust_run):
    found = read_robust(robust_run)
    best, chosen, tests = hypothesis_tables(found)[:3]
    error = found.cells[0].hypotheses["whitening"]["error"]
    assert best.rows[1][1] == chosen.rows[1][1] == f"{error.mean():.3f}"
    assert best.rows[1][4] == f"{error.min(-1).values.mean():.3f}"
    assert [row[:2] for row in tests.rows[:2]] == [
        ["whitening", "Best of k hypotheses"],
        ["whitening", "Hypothesis that MSAC picks among k"],
    ]
    change = (error - found.cells[0].hypotheses["Hartley"]["error"]).mean().item()
    assert re.match(re.escape(f"{change:+.3f} ["), tests.rows[0][2])

"""What a report shows, against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from kornia_learnnorm.evaluation.report.motion import by_motion
from kornia_learnnorm.evaluation.report.printing import print_tables
from kornia_learnnorm.evaluation.report.rates import Table, rate_tables
from kornia_learnnorm.evaluation.runs.run import Cell, Run


def test_the_rate_of_known_distributions():
    """Of exponential variables with means 1 and 1 / 2 the second is smaller with probability 2 / 3."""
    rng = np.random.default_rng(0)
    own = {"Hartley": rng.exponential(1.0, 20_000), "crossview": rng.exponential(0.5, 20_000)}
    predictions = {name: {"own": torch.from_numpy(values)} for name, values in own.items()}
    cell = Cell("kitti_06", "filtered", torch.arange(20_000) // 100, 20_000, predictions)
    trained_on = {"Hartley": [], "crossview": ["kitti_06@0:3"]}
    about = {"size": 8, "max_residual": 60.0, "methods": dict.fromkeys(own, ""), "trained_on": trained_on}
    (table,) = rate_tables(Run(about, [cell], {}, {}, {}))
    rate, interval = table.rows[1][2].split(" ", 1)
    low, high = (float(end) for end in interval.strip("[] *").split(", "))
    assert table.rows[1][1] == "kitti_06@0:3"
    assert interval.endswith(" *")
    assert low < 200 / 3 < high
    # The half width of independent samples: 1.96 standard deviations of a proportion.
    assert (high - low) / 2 == pytest.approx(196 * np.sqrt(2 / 9 / 20_000), rel=0.2)
    assert float(rate) == pytest.approx(200 / 3, abs=1)
    assert [row[1:] for row in table.rows[2:]] == [
        ["KITTI 00-05", "86.68"],
        ["TUM", "84.22"],
        ["KITTI 00-05 and TUM", "87.05"],
    ]


def test_only_tables_that_fit_are_printed(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "60")
    rows = [["mine", *(3 * ["12.3 [10.0, 14.0]"])]]
    narrow = Table("Narrow", "What it shows.", ["method", "rate of a long name"], [row[:2] for row in rows])
    print_tables([narrow, Table("Wide", "", ["method", "a", "b", "c"], rows)], Path("report.html"))
    text = capsys.readouterr().out
    assert "12.3 [10.0, 14.0]" in text
    assert "rate of a" in text
    assert "…" not in text
    assert text.endswith("wider than the 60 columns here, in report.html:\n  Wide\n")


def motion_cell(forward, truth):
    """Six pairs of two samples each; the figures other than ``forward`` are not known."""
    error = torch.tensor(truth, dtype=torch.float64).repeat_interleave(2)
    errors = {"own": torch.arange(12) + 1.0, "heldout": torch.arange(12) + 1.0, "truth": error}
    cell = Cell("a", "filtered", torch.arange(6).repeat_interleave(2), 12, {"Hartley": errors, "mine": errors})
    unknown = np.full(6, np.nan)
    pairs = {"rotation": unknown, "forward": np.array(forward), "parallax": unknown, "inliers": unknown}
    return cell, Run({}, [cell], {"a": pairs}, {}, {})


class TestByMotion:
    def test_counts_and_digits(self):
        """A median of 0.999555 that three digits round to 1, among samples of which some have no truth."""
        nan = float("nan")
        table = by_motion(*motion_cell([0.2, 0.4, 0.9995, 0.99961, 0.99962, 0.9997], [1, nan, 1, 1, nan, nan]), "mine")
        assert [row[1:5] for row in table.rows] == [["up to 0.9996", "3", "6", "4"], ["above 0.9996", "3", "6", "2"]]
        assert "Not shown: rotation, degrees, known of 0 of 6 pairs; parallax" in table.text

    def test_what_hardly_differs_has_no_halves(self):
        table = by_motion(*motion_cell([0.9995, 0.9996, 0.9997, 0.9998, 0.9998, 0.9998], 6 * [1]), "mine")
        assert table.rows == []
        assert "forward share of the translation, from 0.9995 to 0.9998 in all pairs" in table.text
        table = by_motion(*motion_cell(6 * [0.5], 6 * [1]), "mine")
        assert "forward share of the translation, 0.5 in all pairs" in table.text

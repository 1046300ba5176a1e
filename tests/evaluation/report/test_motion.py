"""Tables by motion."""

from __future__ import annotations

import numpy as np
import torch

from kornia_learnnorm.evaluation.report.motion import by_motion
from kornia_learnnorm.evaluation.runs.run import Cell, Run


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

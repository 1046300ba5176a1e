"""Tables of better rates."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_learnnorm.evaluation.report.rates import rate_tables
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

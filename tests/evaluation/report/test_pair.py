"""Picture of the example image pair."""

from __future__ import annotations

import numpy as np
import pytest

from kornia_learnnorm.evaluation.report.pair import draw_example
from kornia_learnnorm.evaluation.runs.run import read_run

pytest.importorskip("matplotlib", reason="Matplotlib is not installed")


def test_without_a_sample_of_the_pair_there_is_no_picture_of_it(run):
    found = read_run(run)
    (picture,) = draw_example(found, dict.fromkeys(found.about["methods"], "red"))
    assert picture.name == "figure-10"
    found.example["pair"] = np.array(99)
    assert draw_example(found, {}) == []

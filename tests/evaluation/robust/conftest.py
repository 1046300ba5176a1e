"""Correspondences that the tests of robust estimators share."""

from __future__ import annotations

import pytest

from kornia_learnnorm.data.synthetic.synthetic_store import synthetic_store
from kornia_learnnorm.evaluation.robust.robust_run import shuffled_pair


@pytest.fixture
def matches():
    """Return a function that draws the correspondences of a synthetic image pair."""

    def draw(noise=0.2, outliers=0.2, points=300):
        store = synthetic_store(1, points, seed=3, noise=noise, outliers=outliers, scenes=["hand-held"])
        return shuffled_pair(store, 0, "unfiltered", 0)

    return draw

"""Correspondences for robust estimators and metrics of the estimates."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_learnnorm.data.synthetic.stores import synthetic_store
from kornia_learnnorm.evaluation.robust.matches import draw_matches, measure
from kornia_learnnorm.metrics.pairs import f1_score


def test_protocols():
    store = synthetic_store(2, 1500, seed=1, scenes=["orbit"])
    everything = draw_matches(store, 1, "unfiltered", 0)
    rows = slice(1500, 3000)
    assert {*map(tuple, everything.points1.float().tolist())} == {*map(tuple, store.points1[rows].tolist())}
    filtered = draw_matches(store, 1, "filtered", 0)
    assert len(filtered.points1) == 1000
    ratio = {tuple(p): r for p, r in zip(store.points1[rows].tolist(), store.ratio[rows], strict=True)}
    assert max(ratio[tuple(p)] for p in filtered.points1.float().tolist()) < 0.8


def test_order():
    store = synthetic_store(1, 1500, seed=1, scenes=["orbit"])
    first, second = (draw_matches(store, 0, "filtered", 0, order).points1 for order in (0, 1))
    assert not torch.equal(first, second)
    assert torch.equal(*(torch.unique(points, dim=0) for points in (first, second)))
    assert torch.equal(first, draw_matches(store, 0, "filtered", 0, 0).points1)


def test_measure(matches):
    drawn = matches()
    true = measure(drawn, drawn.F_mat, 0.5)
    assert true["f1"] == 1
    assert max(true["rotation_error"], true["translation_error"]) < 1e-4
    F_mat = drawn.F_mat * (1 + 1e-3 * torch.randn(3, 3, dtype=torch.float64))
    expected = f1_score(drawn.points1, drawn.points2, F_mat, drawn.F_mat, 0.5)
    assert measure(drawn, F_mat, 0.5)["f1"] == pytest.approx(expected.item())


def test_measure_of_a_failure_and_without_truth(matches):
    drawn = matches()
    failed = measure(drawn, torch.full((3, 3), torch.nan, dtype=torch.float64), 1.0)
    assert failed["inliers"] == failed["f1"] == 0
    assert failed["error"] == failed["rotation_error"] == failed["translation_error"] == math.inf
    unknown = drawn._replace(F_mat=drawn.F_mat * torch.nan, R=drawn.R * torch.nan, t=drawn.t * torch.nan)
    found = measure(unknown, drawn.F_mat, 1.0)
    assert found["inliers"] > 0.5
    assert all(math.isnan(found[key]) for key in ("f1", "error", "rotation_error", "translation_error"))

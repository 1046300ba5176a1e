"""Robust estimators by name, and minimal solvers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.evaluation.robust import peers
from kornia_learnnorm.evaluation.robust.budgets import minimal_samples, run_estimator
from kornia_learnnorm.evaluation.robust.estimators import (
    DEFAULT_ESTIMATORS,
    estimator_names,
    find_estimator,
    is_slow,
)
from kornia_learnnorm.evaluation.robust.matches import measure


@pytest.mark.parametrize("name", [*DEFAULT_ESTIMATORS, "count:none", "RANSAC:Hartley+optimal"])
def test_each_finds_the_truth(name, matches):
    try:
        estimator = find_estimator(name)
    except ImportError as error:
        pytest.skip(str(error))
    drawn = matches()
    (found,) = run_estimator(estimator, drawn, 0, [1.0])
    assert found.F_mat.shape == (3, 3)
    assert found.F_mat.dtype == torch.float64
    assert found.seconds > 0 or name == "ground-truth"
    figures = measure(drawn, found.F_mat, 1.0)
    assert figures["error"] < 1.5
    assert figures["f1"] > 0.5
    if name.startswith("count:"):
        assert found.samples == 1000
    if name.startswith("time:"):
        assert found.samples >= 1


def test_equal_samples_by_hand(matches):
    """The matrix of highest MSAC score among those of the samples, for each threshold."""
    drawn = matches(noise=0.5, outliers=0.4)
    found = run_estimator(find_estimator("count:whitening"), drawn, 4, [0.1, 1.0])
    rows = minimal_samples(300, 1000, 4)
    assert (rows.sort(-1).values.diff(dim=-1) > 0).all()
    F_mat = kln.find_fundamental(drawn.points1[rows], drawn.points2[rows], normalizer=kln.Whitening())
    distance = kln.sampson_distance(drawn.points1[None], drawn.points2[None], F_mat)
    for threshold, estimate in zip([0.1, 1.0], found, strict=True):
        scores = (1 - (distance / threshold).square()).clamp(min=0).sum(-1)
        own = kln.sampson_distance(drawn.points1, drawn.points2, estimate.F_mat)
        own_score = (1 - (own / threshold).square()).clamp(min=0).sum()
        assert own_score.item() == pytest.approx(scores.max().item(), rel=1e-3)


def test_the_seed_decides(matches):
    drawn, estimator = matches(), find_estimator("count:Hartley")
    first, again, other = (estimator(drawn, seed, [1.0])[0].F_mat for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_too_few_correspondences_fail(matches):
    drawn = matches()
    drawn = drawn._replace(points1=drawn.points1[:7], points2=drawn.points2[:7])
    found = run_estimator(find_estimator("RANSAC"), drawn, 0, [0.1, 1.0])
    assert [estimate.F_mat.isnan().all().item() for estimate in found] == [True, True]


def test_what_fails_is_a_failure(monkeypatch, matches):
    for wrong in (None, np.zeros((9, 3))):
        package = peers.PeerPackage(lambda *_, wrong=wrong: wrong, "math", "poselib")
        monkeypatch.setitem(peers.PEERS, "poselib", package)
        assert find_estimator("poselib")(matches(), 0, [1.0])[0].F_mat.isnan().all()


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        *((name, ValueError, "no estimator") for name in ("nothing", "count", "time:", "count:", "RANSAC:")),
        ("RANSAC:Hartley+LM", ValueError, "refines by itself"),
        ("count:nothing", FileNotFoundError, "no weights 'nothing'"),
    ],
)
def test_unknown(name, error, message):
    with pytest.raises(error, match=message):
        find_estimator(name)


def test_names(tmp_path):
    path = str(tmp_path / "mine" / "weights.safetensors")
    names = [path, f"count:{path}", f"RANSAC:{path}", "RANSAC", "poselib", "count:kornia_learnnorm:Whitening"]
    short = ["mine", "count:mine", "RANSAC:mine", "RANSAC", "poselib", "count:kornia_learnnorm:Whitening"]
    assert [*estimator_names(names).values()] == short
    with pytest.raises(ValueError, match="same name"):
        estimator_names(["RANSAC", "RANSAC"])


def test_slow_ones():
    names = ("poselib", "RANSAC:crossview", "count:paper", "time:paper", "opencv-lmeds")
    assert [*map(is_slow, names)] == [True, True, False, False, False]

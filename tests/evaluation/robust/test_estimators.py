"""Robust estimators by name, the correspondences that they get, and metrics of the estimates."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from two_view import shaken_estimator

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic.synthetic_store import synthetic_store
from kornia_learnnorm.evaluation.robust import peers
from kornia_learnnorm.evaluation.robust.budgets import minimal_samples, run_estimator
from kornia_learnnorm.evaluation.robust.estimators import (
    DEFAULT_ESTIMATORS,
    estimator_names,
    find_estimator,
    identify_estimator,
    is_slow,
)
from kornia_learnnorm.evaluation.robust.matches import draw_matches, even_pairs, measure
from kornia_learnnorm.metrics.pairs import f1_score

KNOWN_CAMERAS = ["RANSAC-calibrated", "poselib-calibrated", "opencv-usac-magsac-calibrated"]


@pytest.mark.parametrize("name", [*DEFAULT_ESTIMATORS, *KNOWN_CAMERAS, "count:none", "RANSAC:Hartley+optimal"])
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


@pytest.mark.parametrize("name", KNOWN_CAMERAS)
def test_known_cameras(name, matches):
    """The matrix has the essential one's equal singular values; without cameras there is none."""
    if name.startswith("poselib"):
        pytest.importorskip("poselib", reason="PoseLib is not installed")
    drawn, estimator = matches(), find_estimator(name)
    (found,) = estimator(drawn, 0, [1.0])
    values = np.linalg.svd((drawn.K[1].mT @ found.F_mat @ drawn.K[0]).numpy())[1]
    assert values[1] == pytest.approx(values[0], rel=1e-6)
    assert measure(drawn, found.F_mat, 1.0)["rotation_error"] < 1
    assert estimator(drawn._replace(K=drawn.K * torch.nan), 0, [1.0])[0].F_mat.isnan().all()
    assert name not in DEFAULT_ESTIMATORS
    assert identify_estimator(name) == name or identify_estimator(name).startswith(("poselib ", "opencv "))


@pytest.mark.parametrize("name", ["learned:{}", "learned:{}+LM", "guided:{}"])
def test_learned_weights_in_a_file(name, matches, tmp_path):
    layer, file = shaken_estimator(), tmp_path / "mine.safetensors"
    layer.save_pretrained(file)
    drawn = matches(outliers=0.0)
    (found,) = run_estimator(find_estimator(name.format(file)), drawn, 0, [1.0])
    points1, points2 = drawn.points1[None], drawn.points2[None]
    with torch.no_grad():
        expected, weights = (layer.estimate(points1, points2)[i] for i in (0, 4))
    if name.endswith("+LM"):
        expected = kln.refine_fundamental(points1, points2, expected, loss=kln.GemanMcClure(1.0)).F_mat
    if name.startswith("guided"):
        expected = kln.RANSAC(seed=0)(drawn.points1, drawn.points2, weights[0])[0][None]
    assert torch.allclose(found.F_mat, expected[0], rtol=1e-6, atol=1e-12)
    assert file.name in identify_estimator(name.format(file))


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


def test_even_pairs():
    assert even_pairs(51, 3) == [0, 25, 50]
    assert even_pairs(2, 0) == even_pairs(2, 5) == [0, 1]

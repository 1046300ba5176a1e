"""Summaries of runs, from errors that the tests write."""

import math
import re

import pytest
import torch

from kornia_learnnorm.evaluation.report.run_summary import robust_summary, run_summary
from kornia_learnnorm.evaluation.robust.robust_run import RobustCell, RobustRun
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell

PAIRS, SAMPLES = 12, 60
PAIR = torch.arange(SAMPLES) // (SAMPLES // PAIRS)
NOISE = torch.where(torch.arange(SAMPLES) % 2 == 0, 1.1, 1 / 1.1)
FEW = torch.where(torch.arange(SAMPLES) % 5 < 2, 1e-4, 3.0)  # nearly exact, so that the geometric mean is small


def errors(scale, key="truth"):
    """Errors that grow with the pair, times a scale of each sample: 1 to 12 px under Hartley, five samples each."""
    known = (1.0 + PAIR.double()) * scale
    unknown = torch.full_like(known, math.nan)
    inliers = torch.stack([unknown.nan_to_num(0.1), unknown.nan_to_num(0.25)], 1)
    found = {name: known if name in (key, "own") else unknown for name in ("own", "heldout", "truth")}
    return found | {"inliers": inliers}


def summary_of(scales, pair=PAIR, key="truth", **about):
    """The summary of a run of Hartley, with errors of scale 1, and other methods."""
    predictions = {name: errors(scale, key) for name, scale in ({"Hartley": 1.0} | scales).items()}
    (text,) = run_summary(Run(about, [RunCell("a", "filtered", pair, SAMPLES, predictions)], []))
    return text


def test_the_smallest_error_wins_and_what_is_level_is_named():
    for scales, facts in [
        (
            {"best": 0.5, "close": 0.503 * NOISE, "bad": 3.0},
            ["`best` has", "median 3.250 px; Hartley has 6.500 px", "-50.0 % [-50.0, -50.0]", "Level with it: `close`"],
        ),
        ({"bad": 3.0, "mine": 1.5}, ["`Hartley` has", "`mine` with 9.750 px", "+50.0 % [+50.0, +50.0]"]),
        ({"close": 1.005 * NOISE}, ["Level with it: `close`"]),
        # The median decides, and a smaller geometric mean is named.
        ({"Hartley": 4.0, "exact": FEW, "steady": 1.0}, ["`steady` has", "median 6.500 px", "smaller for `exact`"]),
        ({}, ["nothing to test it against"]),
    ]:
        text = summary_of(scales)
        assert "**a, filtered** (60 samples of 12 image pairs)" in text
        assert [fact for fact in facts if fact not in text] == []


def test_weights_of_ones_own_are_named_where_another_method_wins():
    trained_on = {"Hartley": [], "best": [], "own": ["a@0:9"], "crossview": ["kitti_00"]}
    text = summary_of({"best": 0.5, "own": 0.8, "crossview": 0.9}, trained_on=trained_on)
    assert text.endswith("`own` has 5.200 px.")


def test_without_ground_truth_the_error_is_on_heldout_matches_beside_the_share_of_inliers():
    text = summary_of({"mine": 0.5}, key="heldout")
    assert "`mine` has the smallest error on held-out matches" in text
    assert "`mine` 25.0 %, `Hartley` 25.0 %. No ground truth is known." in text


@pytest.mark.parametrize("pairs", [1, 7, 8])
@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_few_pairs_are_not_tested(pairs, scale):
    text = summary_of({"mine": scale}, torch.arange(SAMPLES) % pairs)
    assert ("change of the geometric mean" in text) == (pairs == 8)
    assert bool(re.search(rf"Not tested: there (is|are) {pairs} image pairs?, a test needs 8", text)) == (pairs < 8)


@pytest.mark.parametrize(
    ("truth", "facts"),
    [
        (True, ["`exact` has the smallest error", "mean 0.200 px in 10.0 ms", "next is `greedy` with 0.400 px"]),
        (False, ["`greedy` has the largest share of inliers", "90.0 % in 20.0 ms", "next is `exact` with 50.0 %"]),
    ],
)
def test_robust_estimators(truth, facts):
    found, some = {}, torch.ones(8, 2)
    cases = ("exact", 0.2, 0.5, 0.01), ("greedy", 0.4, 0.9, 0.02), ("ground-truth", 0, 1, 0)
    for name, error, inliers, seconds in cases:
        known = some if truth else some * math.nan
        found[name] = {1.0: {"f1": known, "error": known * error, "inliers": some * inliers, "seconds": some * seconds}}
    (line,) = robust_summary(RobustRun({}, [RobustCell("a", "filtered", found), RobustCell("b", "filtered", {})], []))
    assert [fact for fact in facts if fact not in line] == []
    assert "ground-truth" not in line.replace("ground-truth inliers", "")

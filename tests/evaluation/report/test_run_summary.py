"""Summaries of runs, from errors that the tests write."""

from __future__ import annotations

import math
import re

import pytest
import torch

from kornia_learnnorm.evaluation.report.run_summary import robust_summary, run_summary
from kornia_learnnorm.evaluation.robust.robust_run import RobustCell, RobustRun
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell

PAIRS, SAMPLES = 12, 60
PAIR = torch.arange(SAMPLES) // (SAMPLES // PAIRS)


def errors(scale, key="truth"):
    """Errors that grow with the pair, times a scale of each sample."""
    known = (1.0 + PAIR.double()) * scale
    unknown = torch.full_like(known, math.nan)
    inliers = torch.stack([unknown.nan_to_num(0.1), unknown.nan_to_num(0.25)], 1)
    return {name: known if name in (key, "own") else unknown for name in ("own", "heldout", "truth")} | {
        "inliers": inliers
    }


def summary_of(predictions, pair=PAIR):
    (text,) = run_summary(Run({}, [RunCell("a", "filtered", pair, SAMPLES, predictions)], []))
    return text


def test_the_smallest_error_wins_and_what_is_level_is_named():
    noise = torch.where(torch.arange(SAMPLES) % 2 == 0, 1.1, 1 / 1.1)
    text = summary_of({"Hartley": errors(1.0), "best": errors(0.5), "close": errors(0.503 * noise), "bad": errors(3.0)})
    # Errors are 1 to 12 px under Hartley, five samples each.
    assert "**a, filtered** (60 samples of 12 image pairs)" in text
    assert "`best` has the smallest error on the ground-truth inliers, median 3.250 px; Hartley has 6.500 px" in text
    assert "(change of the geometric mean -50.0 % [-50.0, -50.0])" in text
    assert text.endswith("Level with it: `close`.")


def test_hartley_may_win():
    noise = torch.where(torch.arange(SAMPLES) % 2 == 0, 1.1, 1 / 1.1)
    text = summary_of({"bad": errors(3.0), "Hartley": errors(1.0), "mine": errors(1.5)})
    assert "`Hartley` has the smallest error on the ground-truth inliers, median 6.500 px; next is `mine` with " in text
    assert text.endswith("next is `mine` with 9.750 px (change of the geometric mean +50.0 % [+50.0, +50.0]).")
    text = summary_of({"Hartley": errors(1.0), "close": errors(1.005 * noise)})
    low, high = map(float, re.findall(r"change of the geometric mean \S+ % \[(\S+), (\S+)\]", text)[0])
    assert low < 0 < high
    assert text.endswith("Level with it: `close`.")


def test_weights_of_ones_own_are_named_where_another_method_wins():
    predictions = {"Hartley": errors(1.0), "best": errors(0.5), "own": errors(0.8), "crossview": errors(0.9)}
    about = {"trained_on": {"Hartley": [], "best": [], "own": ["a@0:9"], "crossview": ["kitti_00"]}}
    (text,) = run_summary(Run(about, [RunCell("a", "filtered", PAIR, SAMPLES, predictions)], []))
    assert text.endswith("`own` has 5.200 px.")


def test_the_quoted_median_decides_and_a_smaller_geometric_mean_is_named():
    """Two fifths of a method's samples are nearly exact: its geometric mean is smaller, its median larger."""
    few = torch.where(torch.arange(SAMPLES) % 5 < 2, 1e-4, 3.0)
    text = summary_of({"Hartley": errors(4.0), "exact": errors(few), "steady": errors(1.0)})
    assert "`steady` has the smallest error on the ground-truth inliers, median 6.500 px" in text
    assert text.endswith("The geometric mean of the errors is smaller for `exact`.")


def test_without_ground_truth_the_error_is_on_heldout_matches_beside_the_share_of_inliers():
    text = summary_of({"Hartley": errors(1.0, "heldout"), "mine": errors(0.5, "heldout")})
    assert "`mine` has the smallest error on held-out matches" in text
    assert text.endswith("Share of the matches within 1 px: `mine` 25.0 %, `Hartley` 25.0 %. No ground truth is known.")


@pytest.mark.parametrize(("pairs", "text"), [(1, "is 1 image pair"), (7, "are 7 image pairs"), (8, "")])
def test_few_pairs_are_not_tested(pairs, text):
    found = summary_of({"Hartley": errors(1.0), "mine": errors(0.5)}, torch.arange(SAMPLES) % pairs)
    assert found.endswith(f" Not tested: there {text}, a test needs 8.") == bool(text)
    assert ("change of the geometric mean" in found) == (not text)
    won = summary_of({"Hartley": errors(1.0), "mine": errors(2.0)}, torch.arange(SAMPLES) % pairs)
    assert "; next is `mine` with 13.000 px" in won
    assert ("change of the geometric mean" in won) == (not text)


def test_one_method_has_nothing_to_compare():
    assert summary_of({"Hartley": errors(1.0)}).endswith("There is nothing to test it against.")


def estimates(error, inliers, seconds=0.01, truth=True):
    known = torch.full((8, 2), 1.0 if truth else math.nan)
    some = torch.ones(8, 2)
    return {1.0: {"f1": known, "error": known * error, "inliers": some * inliers, "seconds": some * seconds}}


@pytest.mark.parametrize(
    ("truth", "text"),
    [
        (True, "`exact` has the smallest error on the ground-truth inliers at 1 px, mean 0.200 px in 10.0 ms"),
        (False, "`greedy` has the largest share of inliers at 1 px (there is no ground truth), mean 90.0 % in 20.0 ms"),
    ],
)
def test_robust_estimators(truth, text):
    found = {
        "exact": estimates(0.2, 0.5, truth=truth),
        "greedy": estimates(0.4, 0.9, 0.02, truth),
        "ground-truth": estimates(0.0, 1.0, truth=truth),
    }
    (line,) = robust_summary(RobustRun({}, [RobustCell("a", "filtered", found), RobustCell("b", "filtered", {})], []))
    assert text in line
    assert "ground-truth" not in line.replace("ground-truth inliers", "")
    assert ("next is `greedy` with 0.400 px" if truth else "next is `exact` with 50.0 %") in line

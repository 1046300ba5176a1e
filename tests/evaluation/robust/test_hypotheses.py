"""Errors of the hypotheses of minimal solvers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.evaluation.robust import hypotheses
from kornia_learnnorm.evaluation.robust.budgets import minimal_samples
from kornia_learnnorm.evaluation.robust.estimators import find_solver
from kornia_learnnorm.evaluation.robust.hypotheses import expected_best, hypothesis_quality, picked


def test_expected_best_by_brute_force():
    errors = torch.tensor([4.0, 1.0, 1.0, 9.0, 2.5, 60.0], dtype=torch.float64)
    for number in range(1, 7):
        smallest = [min(group) for group in itertools.combinations(errors.tolist(), number)]
        assert expected_best(errors, number).item() == pytest.approx(np.mean(smallest), rel=1e-12)


@pytest.mark.parametrize("number", [1, 10, 1000, 9999, 10_000])
def test_expected_best_of_many(number):
    """The smallest of k of the numbers 1 ... n has mean (n + 1) / (k + 1)."""
    errors = 1 + torch.randperm(10_000).double()
    assert expected_best(errors, number).item() == pytest.approx(10_001 / (number + 1), rel=1e-9)


def test_picked_by_brute_force():
    errors, scores = torch.rand(2, 2, 11, dtype=torch.float64)
    for number in (1, 2, 3, 5, 11):
        for row in range(2):
            groups = [range(i, i + number) for i in range(0, 11 - number + 1, number)]
            best = [errors[row, max(group, key=lambda i: scores[row, i])].item() for group in groups]
            assert picked(errors, scores, number)[row].item() == pytest.approx(np.mean(best))


@pytest.mark.parametrize("number", [0, 4])
def test_not_so_many(number):
    for function, arguments in ((expected_best, [torch.rand(3)]), (picked, torch.rand(2, 3))):
        with pytest.raises(ValueError, match=f"from 1 to 3, the number of errors, got {number}"):
            function(*arguments, number)


def test_figures_are_those_of_the_functions(matches):
    drawn = matches(noise=0.5, outliers=0.3)
    errors, scores = hypothesis_quality(find_solver("Hartley"), drawn, 40, 2)
    rows = minimal_samples(300, hypotheses.NUMBERS[-1], 2)[:40]
    F_mat = kln.find_fundamental(drawn.points1[rows], drawn.points2[rows])
    near = kln.symmetric_epipolar_distance(drawn.points1, drawn.points2, drawn.F_mat) < 1
    points = drawn.points1[None].expand(40, -1, -1), drawn.points2[None].expand(40, -1, -1)
    expected = kln.symmetric_epipolar_distance(*points, F_mat)[:, near].mean(-1).clamp(max=60)
    torch.testing.assert_close(errors, expected)
    msac = (1 - kln.sampson_distance(*points, F_mat).square()).clamp(min=0).sum(-1)
    torch.testing.assert_close(scores, msac)
    torch.testing.assert_close(hypothesis_quality(find_solver("Hartley"), drawn, 10, 2)[0], errors[:10])


def test_seven_points_take_the_candidate_of_highest_score(matches):
    drawn = matches(noise=0.5, outliers=0.0)
    solver = find_solver("seven-point")
    errors, scores = hypothesis_quality(solver, drawn, 20, 0)
    rows = minimal_samples(300, hypotheses.NUMBERS[-1], 0)[:20, :7]
    candidates = solver.solve(drawn.points1[rows], drawn.points2[rows])
    points = drawn.points1[None, None].expand(20, 3, -1, -1), drawn.points2[None, None].expand(20, 3, -1, -1)
    distance = kln.sampson_distance(*points, candidates).nan_to_num(nan=torch.inf)
    torch.testing.assert_close(scores, (1 - distance.square()).clamp(min=0).sum(-1).max(-1).values)
    assert (errors > 0).all()


def test_without_ground_truth(matches):
    drawn = matches()
    errors, _ = hypothesis_quality(find_solver("Hartley"), drawn._replace(F_mat=drawn.F_mat * torch.nan), 5, 0)
    assert errors.isnan().all()

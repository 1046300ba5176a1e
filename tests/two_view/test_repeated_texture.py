"""Coherent matches, and estimates of repeated texture, where false matches agree with each other."""

from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from references import epipolar_distances
from rendered import render_kind
from scenes import repeated_wall, uniform

import kornia_learnnorm as kln
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view.repeated_texture import resolve_ambiguity
from kornia_learnnorm.two_view.result import NoReliableMatrixError

pytest.importorskip("cv2", reason="OpenCV is not installed")

SIZE = (640, 480)


@pytest.fixture(scope="module")
def first():
    """The estimate of a wall whose false matches outnumber those of the board."""
    points1, points2, _ = repeated_wall(copies=200)
    return kln.estimate_matches(points1, points2, None, SIZE, SIZE)


@pytest.fixture(scope="module")
def again(first):
    """A function that returns the estimate of some matches, which are the same in all tests."""

    @cache
    def estimate(rows):
        return kln.estimate_matches(first.points1[[*rows]], first.points2[[*rows]], None, SIZE, SIZE)

    return lambda kept: estimate(tuple(kept.nonzero()[:, 0].tolist()))


def board_error(estimate) -> float:
    points1, points2, label = repeated_wall(copies=200)
    return float(np.median(epipolar_distances(points1[label == 1], points2[label == 1], estimate.F_mat)))


def one_way(kind: int = 2) -> list[torch.Tensor]:
    """Matches one way only: the copies of windows or the board, of another draw."""
    points1, points2, label = repeated_wall(80, seed=5)
    return [points1[label == kind], points2[label == kind]]


class TestResolveAmbiguity:
    def test_coherent_matches_decide(self, first, again):
        """Also where as many matches one way only fit the first matrix as theirs, which fits the coherent ones too."""
        assert board_error(first) > 3
        draws = zip(one_way(), one_way(kind=1), uniform(2, 400, 2, high=480), strict=True)
        mixed = [torch.cat([copies[:60], board[:60], anywhere]) for copies, board, anywhere in draws]
        for false in (one_way(), mixed):
            found = resolve_ambiguity(first, *false, again)
            assert board_error(found) < 0.3
            assert found.warnings == ()
            assert found.num_matches < first.num_matches

    def test_doubt(self, first, again):
        fail = Mock(side_effect=NoReliableMatrixError("no_consensus", "none"))
        for false, solvable, replaced in [
            (one_way(kind=1), True, False),  # those that fit the matrix of the coherent matches
            ([points[:9] for points in one_way()], True, True),  # too few that fit
            (one_way(), False, False),  # without the false matches, nothing is determined
            (uniform(2, 100, 2, high=480), True, False),  # neither they nor the coherent matches fit
        ]:
            found = resolve_ambiguity(first, *false, again if solvable else fail)
            assert [warning.code for warning in found.warnings] == ["ambiguous"]
            assert (found.F_mat is first.F_mat) != replaced

    def test_no_doubt_where_the_coherent_matches_say_the_same(self, first, again):
        """Although all of the others fit too: the board alone, of which there are two draws."""
        board = resolve_ambiguity(first, *one_way(), again)
        assert resolve_ambiguity(board, *one_way(kind=1), lambda _: board).warnings == ()


def test_rendered_windows():
    """More matches fit a wrong matrix, of another pose, than the true one."""
    pair = render_kind("repeated", 1062)
    found = kln.estimate_pair(pair.image1, pair.image2)
    assert found.warnings == ()
    K = torch.from_numpy(pair.K)[None]
    R, t = kln.relative_pose(found.F_mat[None], K, K, found.points1[None], found.points2[None], found.inliers[None])
    assert float(pose_error(R, t, torch.from_numpy(pair.R)[None], torch.from_numpy(pair.t)[None])) < 5

"""Estimates of repeated texture, where false matches agree with each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from two_view import epipolar_distances, repeated_wall, uniform

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.data.synthetic.kinds import render_kind
from kornia_learnnorm.two_view.pair_estimate import NoReliableMatrixError
from kornia_learnnorm.two_view.reliability import mutual_share
from kornia_learnnorm.two_view.two_view import settle_repeats

pytest.importorskip("cv2", reason="OpenCV is not installed")

SIZE = (640, 480)


def test_share_of_mutual_matches():
    """Of the matches that fit and lie off the plane, every second one is mutual."""
    scene = handheld(1, 100, torch.Generator().manual_seed(0), noise=0.0)
    mutual = torch.arange(100) % 2 == 0
    share = mutual_share(scene.points1[0], scene.points2[0], mutual, scene.F_mat[0], 1.0)
    assert 0.3 < share < 0.7
    assert mutual_share(scene.points1[0], scene.points2[0], mutual, torch.eye(3).double(), 1e-9) == 1.0


@pytest.fixture(scope="module")
def first():
    """The estimate of a wall whose false matches outnumber those of the board."""
    points1, points2, _ = repeated_wall(copies=200)
    return kln.estimate_matches(points1, points2, None, SIZE, SIZE)


@pytest.fixture(scope="module")
def again(first):
    return lambda kept: kln.estimate_matches(first.points1[kept], first.points2[kept], None, SIZE, SIZE)


class TestSettleRepeats:
    @staticmethod
    def board_error(estimate) -> float:
        points1, points2, label = repeated_wall(copies=200)
        return float(
            np.median(epipolar_distances(points1[label == 1].numpy(), points2[label == 1].numpy(), estimate.F_mat))
        )

    @staticmethod
    def one_way(kind: int = 2, seed: int = 5) -> list[torch.Tensor]:
        points1, points2, label = repeated_wall(80, seed)
        return [points1[label == kind], points2[label == kind]]

    def test_false_matches_decide_no_more(self, first, again):
        assert self.board_error(first) > 3
        settled = settle_repeats(first, *self.one_way(), again)
        assert self.board_error(settled) < 0.3
        assert settled.warnings == ()
        assert settled.num_matches < first.num_matches

    def test_doubt(self, first, again):
        """Matches one way only that fit, too few of them, and matches that determine nothing without the false ones."""

        def fail(kept):
            raise NoReliableMatrixError("no_consensus", "none")

        board, few = self.one_way(kind=1), [points[:9] for points in self.one_way()]
        for one_way, estimate in ((board, again), (few, again), (self.one_way(), fail)):
            (warning,) = settle_repeats(first, *one_way, estimate).warnings
            assert warning.code == "ambiguous"

    def test_coherent_matches_decide(self, first, again):
        """As many matches one way only fit the first matrix as that of the coherent matches, which fits these too."""
        one_way = zip(self.one_way(), self.one_way(kind=1), uniform(2, 400, 2, high=480), strict=True)
        false = [torch.cat([copies[:60], board[:60], anywhere]) for copies, board, anywhere in one_way]
        settled = settle_repeats(first, *false, again)
        assert self.board_error(settled) < 0.3
        assert settled.warnings == ()

    def test_coherent_matches_that_do_not_fit(self, first, again):
        """The board moves coherently and does not fit the first matrix, nor do matches one way only."""
        anywhere = uniform(2, 100, 2, high=480)
        found = settle_repeats(first, *anywhere, again)
        (warning,) = found.warnings
        assert warning.code == "ambiguous"
        assert found.F_mat is first.F_mat


@pytest.mark.parametrize("seed", [1019, 1061])
def test_rendered_windows(seed):
    """More matches fit a wrong matrix, of another pose, than the true one."""
    pair = render_kind("repeated", seed)
    found = kln.estimate_pair(pair.image1, pair.image2)
    assert found.warnings == ()
    K = torch.from_numpy(pair.K)[None]
    R, t = kln.relative_pose(found.F_mat[None], K, K, found.points1[None], found.points2[None], found.inliers[None])
    assert float(kln.pose_error(R, t, torch.from_numpy(pair.R)[None], torch.from_numpy(pair.t)[None])) < 5

"""The fundamental matrix of matches, or of some of them, by RANSAC or a learned layer, with plane and parallax."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.transforms import unit_fundamental
from kornia_learnnorm.ransac.local_optimization import FINAL_LOSS_SCALE
from kornia_learnnorm.ransac.models import EssentialModel
from kornia_learnnorm.ransac.ransac import RANSAC, RansacResult
from kornia_learnnorm.ransac.scoring import PairScorer
from kornia_learnnorm.two_view.inputs import Cameras
from kornia_learnnorm.two_view.parallax import fit_plane_and_parallax, parallax, parallax_evidence
from kornia_learnnorm.two_view.reliability import MAX_LOG_CHANCE_PARALLAX, MIN_PLANAR_SHARE, find_homography

__all__ = ["TwoViewSolver"]

MIN_SCORE_GAIN = 1.02  # of another hypothesis over the one found first, which otherwise stays
MIN_SCORE = 1e-3  # a match of weight zero would never be sampled
NEAR = 20.0  # thresholds; among the matches this near a matrix, fewer are false than among all
MIN_NEAR = 16  # matches near a matrix, for a search among them
MAX_NEAR_SEARCHES = 3
MIN_INLIER_SHARE = 0.5  # of the matches; with as many inliers, the first search finds the best matrix
MIN_LOSS_SCALE = 1e-3  # thresholds; of the loss for matches without noise


@dataclass(frozen=True, eq=False)
class TwoViewSolver:
    """The matches of an image pair and how their fundamental matrix is estimated."""

    points1: Tensor  # pixels in image 1, (N, 2), float64
    points2: Tensor  # pixels in image 2, (N, 2), float64
    scores: Tensor  # from 0 to 1, (N,), float64
    threshold: float  # largest distance of an inlier, pixels
    seed: int
    layer: LearnedEightPoint | None = None  # estimates in the place of RANSAC
    cameras: Cameras | None = None

    @property
    def estimator(self) -> str:
        """Name of the class that estimates."""
        return RANSAC.__name__ if self.layer is None else type(self.layer).__name__

    @cached_property
    def _ransac(self) -> RANSAC:
        return RANSAC(inl_th=self.threshold, seed=self.seed)

    def distance(self, F_mat: Tensor) -> Tensor:
        """Return the symmetric epipolar distances of the matches to a matrix (3, 3), (N,), pixels."""
        return symmetric_epipolar_distance(self.points1, self.points2, F_mat)

    def inliers(self, F_mat: Tensor) -> Tensor:
        """Return which matches lie within the threshold of a matrix (3, 3), (N,) bool."""
        return self.distance(F_mat) < self.threshold

    def support(self, F_mat: Tensor) -> Tensor:
        """Return how many matches lie within the threshold of each matrix (P, 3, 3), (P,)."""
        number = len(F_mat)
        distance = symmetric_epipolar_distance(
            self.points1.expand(number, -1, -1), self.points2.expand(number, -1, -1), F_mat
        )
        return (distance < self.threshold).sum(-1)

    def solve(self, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the matrix (3, 3) of all matches or of some rows (M,), and the weights (M,) of these matches."""
        rows = torch.arange(len(self.points1)) if rows is None else rows
        x1, x2, score = self.points1[rows], self.points2[rows], self.scores[rows]
        if self.layer is None:
            found = self._search(x1, x2, score)
            F_mat, weights = self._search_near(x1, x2, score, found.F_mat), found.inliers.double()
        else:
            with torch.no_grad():
                estimate = self.layer.estimate(x1[None], x2[None], scores=score[None])
            F_mat, weights = estimate.F_mat[0], estimate.weights[0]
        if self.cameras is None:
            F_mat = self._try_plane_and_parallax(x1, x2, F_mat)
        elif self.layer is not None:
            F_mat = self._refine(x1, x2, F_mat)
        return F_mat, weights

    def best_of(self, F_mat: Tensor, F_parts: Tensor) -> Tensor:
        """Return the matrix of all matches, or that of a part, refined on all, where it scores higher on all.

        Args:
            F_mat: matrix of all matches, (3, 3).
            F_parts: matrices of parts of the matches, (P, 3, 3).
        """
        scorer = PairScorer(self.points1, self.points2, self.threshold)
        best = scorer.best(scorer.from_pixels(F_parts), 1)
        least = MIN_SCORE_GAIN * _score(scorer, F_mat)
        if float(best.score.sum()) <= least:
            return F_mat
        other = self._refine(self.points1, self.points2, scorer.to_pixels(best.F_mat)[0])
        if self.layer is None:
            other = self._search_near(self.points1, self.points2, self.scores, other)
        return other if _score(scorer, other) > least else F_mat

    def _search(self, points1: Tensor, points2: Tensor, scores: Tensor) -> RansacResult:
        return self._ransac.estimate(points1, points2, scores.clamp(min=MIN_SCORE), *(self.cameras or ()))

    def _search_near(self, points1: Tensor, points2: Tensor, scores: Tensor, F_mat: Tensor) -> Tensor:
        """Return a matrix (3, 3), or a better one that is found among the matches near it, where most are no inliers.

        Among 80 % of outliers and more, the matrix of a search is often one of a few inliers and some outliers. Near it
        lie most of the true matches and few of the outliers, so that a search among them finds the best matrix.
        """
        scorer = PairScorer(points1, points2, self.threshold)
        for _ in range(MAX_NEAR_SEARCHES):
            distance = symmetric_epipolar_distance(points1, points2, F_mat)
            near = distance < NEAR * self.threshold
            share = float((distance < self.threshold).double().mean())
            if share >= MIN_INLIER_SHARE or int(near.sum()) < MIN_NEAR:
                break
            other = self._search(points1[near], points2[near], scores[near]).F_mat
            if _score(scorer, other) <= _score(scorer, F_mat):
                break
            F_mat = other
        return F_mat

    def _refine(self, points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
        """Return the matrix refined on the robust loss with which RANSAC ends, of known cameras if there are."""
        if self.cameras is None:
            loss = GemanMcClure(FINAL_LOSS_SCALE * self.threshold)
            return refine_fundamental(points1[None], points2[None], F_mat[None], loss=loss).F_mat[0]
        scorer = PairScorer(points1, points2, self.threshold)
        start = scorer.best(scorer.from_pixels(F_mat[None]), 1)
        if len(start.F_mat) == 0:
            return F_mat
        fitted = EssentialModel(scorer, *self.cameras).fit(start, refine=True)
        return unit_fundamental(scorer.to_pixels(fitted.matrix()))[0]

    def _try_plane_and_parallax(self, points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
        """Return the matrix of a plane and parallax where one homography explains most inliers and it scores higher."""
        inliers = symmetric_epipolar_distance(points1, points2, F_mat) < self.threshold
        if int(inliers.sum()) < 8:
            return F_mat
        H = find_homography(points1[inliers], points2[inliers], self.threshold)
        if H is None:
            return F_mat
        on_plane = parallax(points1, points2, H)[inliers] < 3 * self.threshold
        if float(on_plane.double().mean()) <= MIN_PLANAR_SHARE:
            return F_mat
        other = fit_plane_and_parallax(points1, points2, H, self.threshold, self.seed)
        scorer = PairScorer(points1, points2, self.threshold)
        if other is not None and _score(scorer, other) > MIN_SCORE_GAIN * _score(scorer, F_mat):
            F_mat = other
        return self._refine_finely(points1, points2, H, F_mat)

    def _refine_finely(self, points1: Tensor, points2: Tensor, H: Tensor, F_mat: Tensor) -> Tensor:
        """Return the matrix, refined at the scale of the noise where no parallax exceeds the threshold.

        Parallax that is smaller than the threshold decides the epipole of a scene that is nearly a plane. So would the
        inliers of largest error, if the scale of the loss were not the median distance of the inliers.
        """
        distance = symmetric_epipolar_distance(points1, points2, F_mat)
        inliers = distance < self.threshold
        evidence = parallax_evidence(parallax(points1, points2, H), inliers, self.threshold)
        if evidence <= MAX_LOG_CHANCE_PARALLAX or not bool(inliers.any()):
            return F_mat
        noise = float(distance[inliers].median())
        scale = min(max(noise, MIN_LOSS_SCALE * self.threshold), FINAL_LOSS_SCALE * self.threshold)
        return refine_fundamental(points1[None], points2[None], F_mat[None], loss=GemanMcClure(scale)).F_mat[0]


def _score(scorer: PairScorer, F_mat: Tensor) -> float:
    """Return the MSAC score of a matrix (3, 3) in pixels; zero for a matrix of zeros."""
    return float(scorer.best(scorer.from_pixels(F_mat[None]), 1).score.sum())

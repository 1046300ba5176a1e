"""Estimate matrices by RANSAC or a learned layer, from a plane and parallax, and from random parts of the matches."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, Self

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.homography import Homography
from kornia_learnnorm.ransac.dominant_plane import fit_parallax
from kornia_learnnorm.ransac.fits import LOSS_SCALE, fit_final
from kornia_learnnorm.ransac.ransac import RANSAC, RansacResult
from kornia_learnnorm.ransac.scoring import PairScorer
from kornia_learnnorm.two_view import parallax
from kornia_learnnorm.two_view.input_checks import Cameras
from kornia_learnnorm.two_view.pair_warnings import MAX_LOG_FALSE_ALARMS, log_false_alarms
from kornia_learnnorm.two_view.random_parts import are_in_vain, draw_parts, drop_failed_parts
from kornia_learnnorm.two_view.result import NoReliableMatrixError

Model = Literal["fundamental", "homography"]
MIN_MATCHES = 9  # any eight matches fit some fundamental matrix
MIN_SCORE_GAIN = 1.02  # of another hypothesis over the first one, to replace it
MIN_SCORE = 1e-3  # smallest weight, since a match of weight zero would never be sampled
NEAR = 20.0  # thresholds; among the matches this near a matrix, fewer are false than among all
MIN_NEAR = 16  # smallest number of matches near a matrix for a search among them
MAX_NEAR_SEARCHES = 3
MIN_INLIER_SHARE = 0.5  # of the matches; with as many inliers, the first search finds the best matrix
MAX_SAMPLES = 50_000  # of RANSAC
PART_SAMPLES = 5_000  # samples of five in a part: with 25 % inliers, one is free of outliers with 99 % probability
FREE_SHARE = 0.8  # of the inliers without cameras; correct cameras have more
MISSED = 1e-4  # probability that no sample is free of outliers
MIN_LOSS_SCALE = 1e-3  # thresholds; of the loss for matches without noise


class Solution(NamedTuple):
    """The fundamental matrix or homography of all matches, and those of random parts, which show its uncertainty."""

    matrix: Tensor  # (3, 3)
    weights: Tensor  # of the matches as the estimator sees them, (N,)
    parts: Tensor  # matrices of random parts, without those of failed searches, (P, 3, 3)
    part_size: int  # matches in a part


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
    max_samples: int = MAX_SAMPLES  # of RANSAC with cameras

    def search(self, first: Solution, size2: Size) -> Solution:
        """Return the best matrix of :meth:`solve` and random parts; raise NoReliableMatrixError for few inliers."""
        F_mat, weights = first.matrix, first.weights
        parts = draw_parts(len(weights), int(self.support(F_mat)), self.seed)
        F_parts = self._solve_parts(F_mat, parts, size2)
        F_mat = self.improve(F_mat, F_parts)
        agree = int(self.support(F_mat))
        if agree < MIN_MATCHES:
            text = f"{agree} of {len(weights)} matches agree on a fundamental matrix within {self.threshold:g} px"
            raise NoReliableMatrixError("no_consensus", f"{text}, at least {MIN_MATCHES} are needed")
        return Solution(F_mat, weights, drop_failed_parts(F_parts, self.support(F_parts), agree), parts.shape[1])

    def homography(self, size2: Size) -> Tensor | None:
        """Return the homography (3, 3) that most matches agree with; None for fewer than nine, or as many by chance."""
        H_mat = self._ransac("homography").F_mat
        agree = int(self.support(H_mat, "homography"))
        log_number = log_false_alarms(len(self.scores), agree, self.threshold, size2, "homography")
        return None if agree < MIN_MATCHES or log_number > MAX_LOG_FALSE_ALARMS else H_mat

    def check_homography(self, H_mat: Tensor) -> Solution:
        """Return a homography (3, 3) of all matches with those of the matches near it in random parts."""
        distance = self.distance(H_mat, "homography")
        inliers, near = distance < self.threshold, distance < NEAR * self.threshold
        agree = int(inliers.sum())
        parts = draw_parts(len(inliers), agree, self.seed)
        solvers = [self.part(rows[near[rows]]) for rows in parts if int(near[rows].sum()) >= Homography.min_points]
        H_parts = torch.stack([solver._ransac("homography").F_mat for solver in solvers])  # noqa: SLF001 (its own class)
        solved = drop_failed_parts(H_parts, self.support(H_parts, "homography"), agree)
        return Solution(H_mat, inliers.double(), solved, parts.shape[1])

    def solve(self) -> Solution:
        """Return the fundamental matrix of all matches, without solving random parts."""
        if self.layer is None:
            found = self._ransac()
            F_mat, weights = found.F_mat, found.inliers.double()
        else:
            with torch.no_grad():
                estimate = self.layer.estimate(self.points1[None], self.points2[None], scores=self.scores[None])
            F_mat, weights = estimate.F_mat[0], estimate.weights[0]
        if self.cameras is None:
            F_mat = self._try_plane_and_parallax(F_mat)
        elif self.layer is not None:
            F_mat = self.refine(F_mat)
        return Solution(F_mat, weights, F_mat.new_zeros(0, 3, 3), 0)

    def rival(self, inliers: Tensor) -> tuple[Tensor, int] | None:
        """Return the matrix (3, 3) of the outliers, and how many of them agree; None where most matches are inliers."""
        others = self.part(~inliers)
        if len(others.scores) < max(MIN_MATCHES, int(inliers.sum())):
            return None
        F_mat = others._ransac().F_mat  # noqa: SLF001 (its own class)
        return F_mat, int(others.support(F_mat))

    def free_support(self) -> int:
        """Return how many matches agree on the matrix that RANSAC finds without their cameras."""
        return int(self.support(replace(self, cameras=None)._ransac().F_mat))  # noqa: SLF001 (its own class)

    def limit_samples(self, free: int) -> Self:
        """Return a solver that draws as many samples with cameras as 0.8 times ``free`` inliers require.

        ``free`` are the inliers without cameras. Correct cameras have more; with wrong ones, samples would be wasted.
        """
        hit_rate = (FREE_SHARE * free / len(self.scores)) ** Essential.sample_size
        samples = MAX_SAMPLES if hit_rate == 0 else math.ceil(math.log(MISSED) / math.log1p(-hit_rate))
        return replace(self, max_samples=min(samples, MAX_SAMPLES))

    def improve(self, F_mat: Tensor, F_parts: Tensor) -> Tensor:
        """Return the matrix (3, 3) of all matches, or that of a part (P, 3, 3), refined, where it scores higher."""
        best = self.scorer.best(self.scorer.from_pixels(F_parts), 1)
        least = MIN_SCORE_GAIN * self._score(F_mat)
        if float(best.score.sum()) <= least:
            return F_mat
        other = self.refine(self.scorer.to_pixels(best.F_mat)[0])
        if self.layer is None:
            other = self._search_near(other)
        return other if self._score(other) > least else F_mat

    def refine(self, F_mat: Tensor) -> Tensor:
        """Return the matrix after RANSAC's final fit, under the constraint of the cameras if they are known."""
        start = self.scorer.best(self.scorer.from_pixels(F_mat[None]), 1)
        if len(start.F_mat) == 0:
            return F_mat
        scorer = self.scorer if self.cameras is None else self.scorer.of_cameras(*self.cameras)
        return unit_matrix(scorer.to_pixels(fit_final(scorer, start).matrix()))[0]

    def distance(self, M: Tensor, model: Model = "fundamental") -> Tensor:
        """Return the distances (*, N) of the matches to matrices (*, 3, 3), pixels: epipolar, or from H x1 to x2."""
        distance = parallax.parallax if model == "homography" else symmetric_epipolar_distance
        return distance(self.points1, self.points2, M)

    def support(self, M: Tensor, model: Model = "fundamental") -> Tensor:
        """Return how many matches lie within the threshold of matrices (*, 3, 3)."""
        return (self.distance(M, model) < self.threshold).sum(-1)

    def part(self, rows: Tensor) -> Self:
        """Return the solver of some matches, from their rows or a mask."""
        return replace(self, points1=self.points1[rows], points2=self.points2[rows], scores=self.scores[rows])

    @cached_property
    def scorer(self) -> PairScorer:
        """Scores of matrices on the matches."""
        return PairScorer(self.points1, self.points2, self.threshold, Fundamental())

    def _score(self, F_mat: Tensor) -> float:
        """Return the MSAC score of a matrix (3, 3); zero for a matrix of zeros."""
        return float(self.scorer.best(self.scorer.from_pixels(F_mat[None]), 1).score.sum())

    def _ransac(self, model: Model = "fundamental") -> RansacResult:
        cameras = self.cameras or () if model == "fundamental" else ()
        samples = self.max_samples if cameras else MAX_SAMPLES
        ransac = RANSAC(inl_th=self.threshold, seed=self.seed, model=model, max_samples=samples)
        return ransac.estimate(self.points1, self.points2, self.scores.clamp(min=MIN_SCORE), *cameras)

    def _solve_parts(self, F_mat: Tensor, parts: Tensor, size2: Size) -> Tensor:
        """Return the matrices of the parts, or of the first few if they find no more than chance."""
        found = F_mat[None]
        solver = replace(self, max_samples=min(self.max_samples, PART_SAMPLES))
        for tried, rows in enumerate(parts, 1):
            found = torch.cat([found, solver.part(rows).solve().matrix[None]])
            if are_in_vain(tried, len(self.scores), int(self.support(found).max()), self.threshold, size2):
                break
        return found[1:]

    def _search_near(self, F_mat: Tensor) -> Tensor:
        """Return a matrix (3, 3), or a better one from the matches near it, which are mostly inliers."""
        for _ in range(MAX_NEAR_SEARCHES):
            distance = self.distance(F_mat)
            near = distance < NEAR * self.threshold
            share = float((distance < self.threshold).double().mean())
            if share >= MIN_INLIER_SHARE or int(near.sum()) < MIN_NEAR:
                break
            other = self.part(near)._ransac().F_mat  # noqa: SLF001 (its own class)
            if self._score(other) <= self._score(F_mat):
                break
            F_mat = other
        return F_mat

    def _try_plane_and_parallax(self, F_mat: Tensor) -> Tensor:
        """Return the matrix of a plane and parallax where one homography explains most inliers and it scores higher."""
        inliers = self.distance(F_mat) < self.threshold
        if int(inliers.sum()) < 8:
            return F_mat
        H = parallax.find_main_plane(self.points1[inliers], self.points2[inliers], self.threshold)
        if H is None:
            return F_mat
        off_plane = self.distance(H, "homography")
        if float((off_plane[inliers] < 3 * self.threshold).double().mean()) <= parallax.MIN_PLANAR_SHARE:
            return F_mat
        generator, scorer = torch.Generator().manual_seed(self.seed), self.scorer
        found = fit_parallax(scorer, scorer.T2 @ H @ torch.linalg.inv(scorer.T1), generator)
        for other in scorer.to_pixels(found.F_mat):
            if self._score(other := self.refine(other)) > MIN_SCORE_GAIN * self._score(F_mat):
                F_mat = other
        distance = self.distance(F_mat)
        inliers = distance < self.threshold
        evidence = parallax.parallax_evidence(self.points1, self.points2, F_mat, off_plane, self.threshold, (1.0,))
        if evidence <= parallax.MAX_LOG_CHANCE_PARALLAX or not bool(inliers.any()):
            return F_mat
        # In a nearly planar scene, parallax smaller than the threshold decides the epipole. With the median distance of
        # the inliers as the scale of the loss, the inliers of largest error do not outweigh it.
        scale = distance[inliers].median().clamp(MIN_LOSS_SCALE * self.threshold, LOSS_SCALE * self.threshold)
        matches = self.points1[None], self.points2[None]
        return refine_fundamental(*matches, F_mat[None], loss=GemanMcClure(float(scale))).F_mat[0]

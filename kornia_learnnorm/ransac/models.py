"""What RANSAC estimates: a fundamental matrix from samples of eight, or with cameras an essential one from five."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from kornia_learnnorm.estimators.essential import calibrated_state
from kornia_learnnorm.estimators.fundamental import find_fundamental
from kornia_learnnorm.estimators.minimal import are_determined, solve_calibrated_samples, solve_samples
from kornia_learnnorm.geometry.manifold import Calibrated, Rank2, decompose, decompose_essential, nearest_essential
from kornia_learnnorm.normalizers.contract import Normalizer
from kornia_learnnorm.ransac.local_optimization import (
    FINAL_POOL_SIZE,
    fit_final,
    fit_final_calibrated,
    optimize_calibrated,
    optimize_locally,
)
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE
from kornia_learnnorm.ransac.scoring import Hypotheses, PairScorer

__all__ = ["EssentialModel", "FundamentalModel"]

MIN_SAMPLE_SHIFT = 0.01  # thresholds; a sample that a shift of a point by less makes degenerate is dropped


class FundamentalModel:
    """Fundamental matrices of one image pair.

    Args:
        scorer: the correspondences.
        normalizer: of minimal samples and refits; None for the optimal correction, which does not depend on any.
        rank2: how the singularity constraint is enforced on minimal samples.

    """

    sample_size = SAMPLE_SIZE

    def __init__(
        self, scorer: PairScorer, normalizer: Normalizer | None, rank2: Literal["projection", "optimal"]
    ) -> None:
        self.scorer, self.normalizer = scorer, normalizer
        self.rank2: Literal["projection", "optimal"] = rank2

    def solve(self, rows: Tensor) -> Tensor:
        """Return the matrices of the non-degenerate minimal samples (K, 8), or of all where every one is degenerate.

        Matches on one line give none.
        """
        x1, x2 = self.scorer.samples(rows)
        shift = MIN_SAMPLE_SHIFT * self.scorer.threshold
        if self.normalizer is None:
            F_mat = solve_samples(x1, x2, shift)
            if len(F_mat):
                return F_mat
            determined = torch.zeros_like(rows[:, 0], dtype=torch.bool)
        else:
            determined = are_determined(x1, x2, shift)
        if bool(determined.any()):
            rows = rows[determined]
        elif any(_on_a_line(points, shift) for points in self.scorer.pixels):
            return x1.new_zeros(0, 3, 3)
        points1, points2 = (points[rows] for points in self.scorer.pixels)
        return self.scorer.from_pixels(find_fundamental(points1, points2, None, self.normalizer, self.rank2))

    def optimize(self, F_mat: Tensor, number: int) -> Hypotheses:
        """Return the best of the matrices fitted to their inliers, the first of them also by the normaliser."""
        if self.normalizer is not None:
            inliers = self.scorer.inliers(F_mat[:1]).to(F_mat)
            points1, points2 = (points[None, self.scorer.rows] for points in self.scorer.pixels)
            refit = find_fundamental(points1, points2, inliers, self.normalizer, self.rank2)
            F_mat = torch.cat([self.scorer.from_pixels(refit), F_mat])
        return optimize_locally(self.scorer, F_mat, number)

    def fit(self, pool: Hypotheses, refine: bool) -> Rank2:
        """Return the final matrix (1, 3, 3), fitted to all inliers if ``refine``."""
        return fit_final(self.scorer, pool) if refine else decompose(pool.F_mat[:1])


class EssentialModel:
    """Essential matrices of one image pair, as fundamental matrices of the scorer's coordinates.

    Args:
        scorer: the correspondences.
        K1: camera of view 1 with shape :math:`(3, 3)`.
        K2: camera of view 2.

    """

    sample_size = 5

    def __init__(self, scorer: PairScorer, K1: Tensor, K2: Tensor) -> None:
        self.scorer = scorer
        eye = torch.eye(3).to(scorer.x1)
        self.C1, self.C2 = calibrated_state(eye[None], scorer.T1, scorer.T2, K1.to(eye), K2.to(eye))[2:]

    def solve(self, rows: Tensor) -> Tensor:
        """Return the matrices of the minimal samples (K, 5), up to ten each."""
        x1, x2 = self.scorer.samples(rows)
        return self.C2.mT @ solve_calibrated_samples(x1 @ self.C1.mT, x2 @ self.C2.mT) @ self.C1

    def optimize(self, F_mat: Tensor, number: int) -> Hypotheses:
        """Return the best of the matrices fitted to their inliers."""
        return optimize_calibrated(self.scorer, self._decompose(F_mat), number)

    def fit(self, pool: Hypotheses, refine: bool) -> Calibrated | Rank2:
        """Return the final matrix (1, 3, 3), fitted to all inliers if ``refine``; not calibrated if they contradict."""
        if not refine:
            return self._decompose(pool.F_mat[:1])
        return fit_final_calibrated(self.scorer, pool, self._decompose(pool.F_mat[:FINAL_POOL_SIZE]))

    def essential(self, F_mat: Tensor) -> Tensor:
        """Return the essential matrices of unit norm that are nearest to fundamental matrices (K, 3, 3)."""
        return nearest_essential(self._calibrate(F_mat))

    def _decompose(self, F_mat: Tensor) -> Calibrated:
        E_mat = self._calibrate(F_mat)
        return decompose_essential(E_mat, self.C1.expand_as(E_mat), self.C2.expand_as(E_mat))

    def _calibrate(self, F_mat: Tensor) -> Tensor:
        inverse1, inverse2 = (torch.linalg.inv_ex(C)[0] for C in (self.C1, self.C2))
        E_mat: Tensor = inverse2.mT @ F_mat @ inverse1
        return E_mat


def _on_a_line(points: Tensor, shift: float) -> bool:
    """Return whether points (N, 2) are less than ``shift`` pixels from one line, in root mean square."""
    distance = torch.linalg.svdvals(points - points.mean(0))[1] / len(points) ** 0.5
    return bool(distance < shift)

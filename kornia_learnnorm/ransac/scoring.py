r"""Scores of many fundamental matrices on the correspondences of one image pair."""

import copy
from functools import cached_property
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kornia_learnnorm.estimators.optimize import RobustCost
from kornia_learnnorm.estimators.robust_losses import Loss
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.two_view_model import TwoViewModel

MAX_MEDIAN_DISTANCES = 1e6  # largest distance from the median point, in median distances or thresholds
BLOCK = 1 << 16  # distances computed at once, which stay in a core's cache
SHORTLIST = 64  # hypotheses that are scored on all correspondences
Rows = Tensor | slice  # of correspondences


class Hypotheses(NamedTuple):
    """Fundamental matrices, highest score first."""

    F_mat: Tensor  # in the scorer's coordinates, (K, 3, 3)
    score: Tensor  # MSAC scores, positive, (K,)

    def join(self, other: Self, number: int) -> Self:
        """Return the best of both, at most ``number``; ``other`` comes first in ties."""
        both = type(self)(*(torch.cat([theirs, ours]) for ours, theirs in zip(self, other, strict=True)))
        order = both.score.argsort(descending=True, stable=True)[:number]
        return type(self)(*(values[order] for values in both))


class PairScorer:
    r"""MSAC scores on one pair's correspondences, :math:`\sum_i \max(0, 1 - d_i^2 / \tau^2)`.

    The distances of all correspondences under all matrices are matrix products of the matrices and the model's terms of
    the correspondences, in float32.

    All matrices are in coordinates of which the first two are pixels from the points' median, and the third is the
    median of their absolute values, or the threshold where that is larger. They are conditioned like Hartley's,
    whatever the outliers, and distances in them are those in pixels: ``x1``, ``x2`` are all correspondences in them,
    (3, N), ``T1``, ``T2`` the transforms from pixels, (3, 3).

    Points are pixels (N, 2), :func:`finite_and_bounded`. ``rows`` are the correspondences that are scored, all by
    default; :meth:`shortlist` scores on the first of them.
    """

    def __init__(
        self, points1: Tensor, points2: Tensor, threshold: float, model: TwoViewModel, rows: Rows = slice(None)
    ) -> None:
        self.threshold, self.model, self.rows = threshold, model, rows
        both = torch.stack([points1.mT, points2.mT])
        origin = both.median(-1, keepdim=True).values
        centred = both - origin
        spread = centred.abs().flatten(1).median(-1).values.clamp_(min=threshold)[:, None, None]
        self.x1, self.x2 = torch.cat([centred, spread.expand_as(centred[:, :1])], 1).unbind(0)
        columns = torch.eye(3, 2, dtype=both.dtype, device=both.device).expand(2, 3, 2)
        self.T1, self.T2 = torch.cat([columns, torch.cat([-origin, spread], 1)], 2)
        self.terms = model.score_terms(self.x1[:, rows], self.x2[:, rows]).float()

    def of_cameras(self, K1: Tensor, K2: Tensor) -> Self:
        """Return a scorer of these correspondences for essential matrices of cameras (3, 3)."""
        other = copy.copy(self)
        K1, K2 = (K.to(self.x1)[None] for K in (K1, K2))
        other.model = Essential.of_cameras(K1, K2, self.T1, self.T2, getattr(self.model, "distance", "sampson"))
        return other

    @cached_property
    def pixels(self) -> tuple[Tensor, Tensor]:
        """Correspondences in pixels, (N, 2) for each view."""
        return (self.x1[:2] - self.T1[:2, 2:]).mT, (self.x2[:2] - self.T2[:2, 2:]).mT

    def from_pixels(self, F_mat: Tensor) -> Tensor:
        """Return matrices (K, 3, 3) of pixels in the scorer's coordinates."""
        return self.model.carry(F_mat, torch.linalg.inv_ex(self.T1)[0], torch.linalg.inv_ex(self.T2)[0])

    def to_pixels(self, F_mat: Tensor) -> Tensor:
        """Return matrices (K, 3, 3) of the scorer's coordinates in pixels."""
        return self.model.carry(F_mat, self.T1, self.T2)

    def best(self, F_mat: Tensor, number: int, rows: Rows = slice(None)) -> Hypotheses:
        r"""Return the at most ``number`` matrices of highest score, on some of the scored rows, that have an inlier."""
        scores = self._scores(F_mat, self.terms[:, rows])
        score, order = scores.topk(min(number, len(scores)))
        positive = int((score > 0).sum())
        return Hypotheses(F_mat[order[:positive]], score[:positive])

    def shortlist(self, F_mat: Tensor) -> Tensor:
        """Return the 64 matrices that score best on the first few correspondences; all if it saves little."""
        first = self.model.prescored
        if self.terms.shape[-1] < 2 * first or len(F_mat) <= SHORTLIST:
            return F_mat
        return F_mat[self._scores(F_mat, self.terms[:, :first]).topk(SHORTLIST).indices]

    def inliers(self, F_mat: Tensor) -> Tensor:
        """Return a mask (K, M) of the inliers of matrices (K, 3, 3) among the correspondences that count."""
        return self._gains(F_mat, self.terms) >= 0

    def distances(self, F_mat: Tensor) -> Tensor:
        """Return the distances (K, N) of all correspondences from matrices (K, 3, 3), pixels; NaN on an epipole."""
        return self.model.squares(self.model.residual(F_mat, self.x1[None], self.x2[None])).sqrt()

    def cost(self, loss: Loss, rows: Rows = slice(None), weights: Tensor | None = None) -> RobustCost:
        """Return the sum of losses over some correspondences; weights (K or 1, M)."""
        x1, x2 = self.x1[None, :, rows], self.x2[None, :, rows]
        return RobustCost(self.model, x1, x2, torch.ones_like(x1[:, 0]) if weights is None else weights, loss)

    def _scores(self, F_mat: Tensor, terms: Tensor) -> Tensor:
        size = max(1, BLOCK // terms.shape[-1])
        blocks = (F_mat[start : start + size] for start in range(0, max(1, len(F_mat)), size))
        return torch.cat([self._gains(block, terms).clamp_(min=0).sum(-1) for block in blocks]).nan_to_num_(nan=0.0)

    def _gains(self, F_mat: Tensor, terms: Tensor) -> Tensor:
        """Return the term of each correspondence in each score before truncation at zero, (K, M)."""
        F = (F_mat / torch.linalg.vector_norm(F_mat, dim=(1, 2), keepdim=True)).float()
        return 1 - self.model.score_squares(F, terms, self.threshold)


def finite_and_bounded(points1: Tensor, points2: Tensor, threshold: float) -> Tensor:
    r"""Return which correspondences are finite and not so far from all others that powers of them would overflow."""
    kept = (points1.isfinite() & points2.isfinite()).all(-1)
    if not bool(kept.any()):
        return kept
    for points in (points1.double(), points2.double()):
        offset = (points - points[kept].median(0).values).abs()
        kept = kept & (offset <= MAX_MEDIAN_DISTANCES * offset[kept].median().clamp(min=threshold)).all(-1)
    return kept

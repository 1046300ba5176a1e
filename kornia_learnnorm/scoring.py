r"""Scores of many fundamental matrices on the correspondences of one image pair."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.linear import design_matrix
from kornia_learnnorm.normalizers import Hartley
from kornia_learnnorm.objectives import Factor, sampson_factor
from kornia_learnnorm.transforms import transform_fundamental

__all__ = ["Hypotheses", "PairScorer", "epipolar_distance"]

BLOCK = 1 << 17  # distances of a block, which stay in a core's cache


class Hypotheses(NamedTuple):
    """Fundamental matrices with support, highest score first.

    Attributes:
        F_mat: matrices in pixels, (K, 3, 3).
        score: MSAC scores, (K,).
        support: numbers of inliers, more than eight, (K,) int64.
    """

    F_mat: Tensor
    score: Tensor
    support: Tensor

    def join(self, other: Hypotheses, number: int) -> Hypotheses:
        """Return the best of both, at most so many; ``other`` comes first in ties."""
        both = Hypotheses(*(torch.cat([theirs, ours]) for ours, theirs in zip(self, other, strict=True)))
        order = both.score.argsort(descending=True, stable=True)[:number]
        return Hypotheses(*(values[order] for values in both))


class PairScorer:
    r"""MSAC scores on one pair's correspondences, :math:`\sum_i \max(0, 1 - d_i^2 / \tau^2)`.

    The algebraic residuals are the design matrix times :math:`\mathrm{vec}(F)`, and the squared norms of the epipolar
    lines' normals are quadratic in the points. So three matrix products give the distances of all correspondences under
    all matrices. They run in float32 in Hartley's coordinates of the whole pair; the distances are in pixels.

    Args:
        points1: pixels in the first image with shape :math:`(N, 2)`, :math:`N \ge 8`.
        points2: pixels in the second image with shape :math:`(N, 2)`.
        threshold: largest distance :math:`\tau` of an inlier, pixels.
        factor: which distance: :func:`~kornia_learnnorm.objectives.sampson_factor` or
            :func:`~kornia_learnnorm.objectives.symmetric_factor`.

    """

    def __init__(self, points1: Tensor, points2: Tensor, threshold: float, factor: Factor = sampson_factor) -> None:
        self.points1, self.points2, self.threshold, self.factor = points1, points2, threshold, factor
        self.T1, self.T2 = Hartley()(points1[None], points2[None])
        self.inverse1, self.inverse2 = torch.linalg.inv_ex(self.T1)[0], torch.linalg.inv_ex(self.T2)[0]
        x1, x2 = self._normalize(points1, points2)
        self.residuals = design_matrix(x1, x2).mT.float()
        # A line of normalised coordinates times the scale of its view has the normal that it has in pixels.
        self.normals1 = (self.T1[0, 0, 0].square() * _monomials(x2)).mT.float()
        self.normals2 = (self.T2[0, 0, 0].square() * _monomials(x1)).mT.float()

    def best(self, F_mat: Tensor, number: int) -> Hypotheses:
        r"""Return the matrices of highest score, at most so many, of those with more than eight inliers.

        Args:
            F_mat: matrices in pixels, any scale, with shape :math:`(K, 3, 3)`; without inliers where zero or not
                finite.
            number: largest number of matrices.

        """
        blocks = torch.split(F_mat, max(1, BLOCK // len(self.points1)))
        scores = torch.cat([self._gains(block).clamp_(min=0).sum(-1) for block in blocks])
        score, order = scores.topk(min(number, len(scores)))
        support = (self._gains(F_mat[order]) >= 0).sum(-1)
        enough = support > 8
        return Hypotheses(F_mat[order[enough]], score[enough], support[enough])

    def _gains(self, F_mat: Tensor) -> Tensor:
        """What each correspondence would add to each score if it were not truncated, (K, N); -1 for NaN."""
        F = transform_fundamental(F_mat, self.inverse1, self.inverse2)
        F = (F / torch.linalg.matrix_norm(F, keepdim=True)).float()
        tiny = torch.finfo(F.dtype).tiny
        normal1 = (_coefficients(F[:, :, :2] @ F[:, :, :2].mT) @ self.normals1).clamp_(min=tiny)
        normal2 = (_coefficients(F[:, :2].mT @ F[:, :2]) @ self.normals2).clamp_(min=tiny)
        distance = (F.flatten(-2) @ self.residuals).mul_(self.factor(normal1, normal2)[0])
        gains: Tensor = 1 - distance.div_(self.threshold).square_()
        return gains.nan_to_num_(nan=-1.0)

    def rank(self, F_mat: Tensor) -> int:
        """Return the rank of a matrix (1, 3, 3) of pixels in Hartley's coordinates, to nine digits."""
        values = torch.linalg.svdvals(transform_fundamental(F_mat, self.inverse1, self.inverse2))[0]
        return int((values > 1e-9 * values[0]).sum())

    def determined(self, points1: Tensor, points2: Tensor) -> Tensor:
        r"""Tell the minimal samples that determine a matrix from those that do not, as on one line or plane.

        The eight constraints must be independent: each row of the design matrix is farther from the span of the rows
        before it than a shift of the point by a hundredth of the threshold could bring it.

        Args:
            points1: minimal samples in pixels with shape :math:`(K, 8, 2)`.
            points2: their counterparts with shape :math:`(K, 8, 2)`.

        Returns:
            booleans with shape :math:`(K,)`.

        """
        x1, x2 = self._normalize(points1, points2)
        distance = torch.linalg.qr(design_matrix(x1, x2).mT, mode="r")[1].diagonal(dim1=-2, dim2=-1).abs().amin(-1)
        scale = torch.minimum(self.T1[0, 0, 0], self.T2[0, 0, 0])
        determined: Tensor = distance > 0.01 * self.threshold * scale
        return determined

    def _normalize(self, points1: Tensor, points2: Tensor) -> tuple[Tensor, Tensor]:
        x1, x2 = convert_points_to_homogeneous(points1), convert_points_to_homogeneous(points2)
        return x1 @ self.T1[0].mT, x2 @ self.T2[0].mT


def epipolar_distance(points1: Tensor, points2: Tensor, F_mat: Tensor, factor: Factor = sampson_factor) -> Tensor:
    r"""Return the distance that a factor stands for, :math:`|x_2^\top F x_1|\, g`.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        F_mat: matrices with shape :math:`(B, 3, 3)`, any scale but zero.
        factor: :math:`g`, see :mod:`kornia_learnnorm.objectives`.

    Returns:
        distances in pixels with shape :math:`(B, N)`; NaN for a point on an epipole.

    """
    x1, x2 = convert_points_to_homogeneous(points1), convert_points_to_homogeneous(points2)
    line1, line2 = x2 @ F_mat, x1 @ F_mat.mT
    normal1, normal2 = (line[..., :2].square().sum(-1) for line in (line1, line2))
    return (x2 * line2).sum(-1).abs() * factor(normal1, normal2)[0]


def _monomials(x: Tensor) -> Tensor:
    a, b, c = x.unbind(-1)
    return torch.stack([a * a, b * b, c * c, 2 * a * b, 2 * a * c, 2 * b * c], -1)


def _coefficients(M: Tensor) -> Tensor:
    """Entries of symmetric matrices that belong to the monomials of ``x^T M x``."""
    return M.flatten(-2)[..., [0, 4, 8, 1, 2, 5]]

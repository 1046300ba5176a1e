r"""Estimators: modules from correspondences to a fundamental matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, NoReturn

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor, nn
from torch.nn.functional import normalize

from kornia_learnnorm.estimators.fundamental import check_rank2, find_fundamental
from kornia_learnnorm.estimators.matches import correspondences_from_matches
from kornia_learnnorm.geometry.checks import (
    check_correspondences,
    check_mask,
    is_true,
    solve_dtype,
)
from kornia_learnnorm.geometry.linear import design_matrix, has_null_vector
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.normalizers.closed_form import Hartley

__all__ = ["EightPoint", "TwoViewEstimate"]


class TwoViewEstimate(NamedTuple):
    r"""What correspondences say of two views.

    Attributes:
        F_mat: fundamental matrices of rank 2 and unit Frobenius norm, :math:`x_2^\top F x_1 = 0`, (B, 3, 3).
        E_mat: :math:`K_2^\top F K_1` with unit Frobenius norm, (B, 3, 3), or None without cameras. Its singular values
            are :math:`(\sigma_1, \sigma_2, 0)`, not projected to equal ones.
        determined: whether the correspondences determine the matrix, (B,) bool. Where they do not (fewer than eight
            of positive weight, coincident, collinear, coplanar), it is the base normaliser's and carries no gradient.
    """

    F_mat: Tensor
    E_mat: Tensor | None
    determined: Tensor


class EightPoint(nn.Module):
    r"""The normalised eight-point algorithm as a layer that other networks can trust.

    For finite input, the output and all its derivatives are finite. A correspondence that is masked, or of weight zero,
    counts as absent. A sample that does not determine its matrix, by
    :func:`~kornia_learnnorm.geometry.linear.has_null_vector` in Hartley's coordinates, is solved with the base
    normaliser (``normalizer.base`` where there is one, else Hartley's) and sends no gradient, neither to the points nor
    to the normaliser.

    Args:
        normalizer: a module or callable ``(points1, points2, weights) -> (T1, T2)``; Hartley's when not given.
        rank2: how the singularity constraint is enforced, see :func:`kornia_learnnorm.find_fundamental`.

    Raises:
        ValueError: if ``rank2`` is neither ``None`` nor ``"optimal"``.
        TypeError: if it is compiled by ``torch.jit``; ``torch.compile`` and ``torch.export`` take it.

    Example:
        >>> layer = EightPoint()
        >>> layer(torch.rand(2, 8, 2), torch.rand(2, 8, 2)).shape
        torch.Size([2, 3, 3])
        >>> points = torch.rand(2, 1, 2).expand(2, 8, 2)
        >>> layer.estimate(points, points).determined
        tensor([False, False])

    """

    def __init__(
        self,
        normalizer: Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]] | None = None,
        rank2: Literal["optimal"] | None = None,
    ) -> None:
        super().__init__()
        check_rank2(rank2)
        self.normalizer = Hartley() if normalizer is None else normalizer
        self.rank2: Literal["optimal"] | None = rank2

    def forward(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        r"""Return fundamental matrices :math:`(B, 3, 3)`; see :meth:`estimate`.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`.
            mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`.

        """
        return self.estimate(points1, points2, weights, mask).F_mat

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> TwoViewEstimate:
        r"""Solve for the fundamental matrices and tell which samples determine theirs.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64;
                calibrated coordinates are as good, and give essential matrices.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`, of any floating-point dtype.
            mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`; the others
                may hold anything, NaN too, and get a gradient of zero.
            K1: optional cameras of the first view with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
            K2: optional cameras of the second view; both or none.

        Returns:
            the matrices, in the dtype of the points.

        Raises:
            TypeError: if the points are not floating-point tensors of one dtype, weights or cameras not floating-point,
                or the mask not boolean.
            ShapeError: if a shape is wrong.
            ValueError: if there are fewer than eight rows, shapes do not pair up, an unmasked value is not finite, a
                weight is negative, or only one camera is given or one is not invertible.

        """
        if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
            self.__prepare_scriptable__()
        if (K1 is None) != (K2 is None):
            raise ValueError("cameras are needed of both views or of none")
        if mask is not None:
            check_mask(mask, points1, points2, weights)
            points1, points2 = (torch.where(mask[..., None], points, 0.0) for points in (points1, points2))
            weights = mask.to(points1) if weights is None else torch.where(mask, weights, 0.0)
        check_correspondences(points1, points2, weights)
        _check_cameras(K1, K2, len(points1))
        weights = None if weights is None else _moderate(weights.to(solve_dtype(points1.device)))
        with torch.no_grad():
            determined = _determined(points1, points2, weights)
        F_mat = self._solve(points1, points2, weights, determined)
        if K1 is None or K2 is None:
            return TwoViewEstimate(F_mat, None, determined)
        E_mat = transform_fundamental(F_mat, K1.to(F_mat), K2.to(F_mat))
        return TwoViewEstimate(F_mat, E_mat / torch.linalg.matrix_norm(E_mat, keepdim=True), determined)

    def from_matches(
        self,
        keypoints1: Tensor,
        keypoints2: Tensor,
        matches: Tensor | Sequence[Tensor],
        scores: Tensor | Sequence[Tensor] | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> TwoViewEstimate:
        r"""Solve for the matches of a matching network; scores are weights, and get gradients.

        Args:
            keypoints1: pixels in the first view with shape :math:`(B, M_1, 2)`.
            keypoints2: pixels in the second view with shape :math:`(B, M_2, 2)`.
            matches: see :func:`~kornia_learnnorm.estimators.matches.correspondences_from_matches`.
            scores: one for each match, non-negative.
            K1: optional cameras of the first view, as for :meth:`estimate`.
            K2: optional cameras of the second view.

        Returns:
            the matrices; pairs with fewer than eight matches are not determined.

        """
        return self.estimate(*correspondences_from_matches(keypoints1, keypoints2, matches, scores), K1, K2)

    def _solve(self, points1: Tensor, points2: Tensor, weights: Tensor | None, determined: Tensor) -> Tensor:
        if is_true(determined.all()):
            return find_fundamental(points1, points2, weights, self.normalizer, self.rank2)
        with torch.no_grad():
            base = getattr(self.normalizer, "base", None) or Hartley()
            fallback = find_fundamental(points1, points2, weights, base, self.rank2)
            values = torch.linalg.svdvals(fallback)
            # Of one point or none, all lines are one: there are rows instead.
            fallback = torch.where((values[:, 1] > 1e-10 * values[:, 0])[:, None, None], fallback, _rows(fallback))
        # No derivative meets an undetermined sample: a generic one stands in for it, and its result is dropped.
        rows = determined[:, None]
        stand_in = _generic_points(points1)
        points1, points2 = (
            torch.where(rows[..., None], points, generic)
            for points, generic in zip((points1, points2), stand_in, strict=True)
        )
        weights = None if weights is None else torch.where(rows, weights, 1.0)
        F_mat = find_fundamental(points1, points2, weights, self.normalizer, self.rank2)
        return torch.where(rows[..., None], F_mat, fallback)

    def __prepare_scriptable__(self) -> NoReturn:
        """Refuse ``torch.jit``.

        Raises:
            TypeError: always.

        """
        raise TypeError("EightPoint cannot be compiled by torch.jit, use torch.compile or torch.export")


def _determined(points1: Tensor, points2: Tensor, weights: Tensor | None) -> Tensor:
    dtype = solve_dtype(points1.device)
    x1, x2, w = points1.to(dtype), points2.to(dtype), None if weights is None else weights.to(dtype)
    T1, T2 = Hartley()(x1, x2, w)
    x1, x2 = convert_points_to_homogeneous(x1) @ T1.mT, convert_points_to_homogeneous(x2) @ T2.mT
    return has_null_vector(design_matrix(x1, x2), w)


def _moderate(weights: Tensor) -> Tensor:
    """Scale weights whose largest would over- or underflow; only their ratios count. All below 1e-30 are zero."""
    top = weights.detach().amax(-1, keepdim=True)
    weights = torch.where(top < 1e-30, 0.0, weights)
    return weights / torch.where((top < 1e-30) | ((top > 1e-15) & (top < 1e15)), 1.0, top)


def _rows(like: Tensor) -> Tensor:
    """The fundamental matrix whose epipolar lines are the rows of the image."""
    return normalize(like.new_tensor([0.0, 0, 0, 0, 0, -1, 0, 1, 0]), dim=-1).view(3, 3)


def _check_cameras(K1: Tensor | None, K2: Tensor | None, batch_size: int) -> None:
    for name, K in (("K1", K1), ("K2", K2)):
        if K is None:
            continue
        if not isinstance(K, Tensor) or not K.is_floating_point():
            got = K.dtype if isinstance(K, Tensor) else type(K)
            raise TypeError(f"{name} must be a floating-point tensor, got {got}")
        if K.shape not in ((3, 3), (batch_size, 3, 3)):
            raise ValueError(f"{name} must have shape [3, 3] or [{batch_size}, 3, 3], got {[*K.shape]}")
        if is_true(~(K.isfinite().all() & (torch.linalg.det(K.detach().to(solve_dtype(K.device))) != 0).all())):
            raise ValueError(f"{name} must be finite and invertible")


def _generic_points(like: Tensor) -> tuple[Tensor, Tensor]:
    """Correspondences of the shape (B, N, 2) that determine a matrix: multiples of irrational numbers, modulo one."""
    index = torch.arange(1, like.shape[1] + 1, dtype=like.dtype, device=like.device)[:, None]
    roots = torch.tensor([2.0, 3.0, 5.0, 7.0], dtype=like.dtype, device=like.device).sqrt()
    points = (index * roots).frac().expand(len(like), -1, -1)
    return points[..., :2], points[..., 2:]

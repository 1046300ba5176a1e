r"""The normalised eight-point algorithm as a layer: masks, weights, cameras, and samples that determine no matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, NoReturn

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from kornia_learnnorm.estimators.fundamental import solve_fundamental
from kornia_learnnorm.estimators.matches import correspondences_from_matches
from kornia_learnnorm.geometry.checks import (
    check_cameras,
    check_correspondences,
    check_mask,
    check_rank2,
    solve_dtype,
)
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import transform_fundamental, unit_fundamental
from kornia_learnnorm.normalizers.contract import Normalizer, check_normalizer
from kornia_learnnorm.normalizers.hartley import Hartley

__all__ = [
    "EightPoint",
    "TwoViewEstimate",
    "essential_matrix",
    "prepare_problem",
    "refuse_jit",
    "solve_undetermined",
    "solve_where_determined",
]

MIN_RANK2_RATIO = 1e-10  # second over first singular value of a matrix of rank 2


class TwoViewEstimate(NamedTuple):
    r"""Fundamental matrices of a batch of image pairs, and how well the correspondences determine them.

    Attributes:
        F_mat: fundamental matrices of rank 2 and unit Frobenius norm, :math:`x_2^\top F x_1 = 0`, (B, 3, 3).
        E_mat: :math:`K_2^\top F K_1` with unit Frobenius norm, (B, 3, 3), or None without cameras. Its singular values
            are :math:`(\sigma_1, \sigma_2, 0)`, not projected to equal ones.
        determined: whether the correspondences determine the matrix, ``gap > 1e-6``, (B,) bool. Where they do not
            (fewer than eight of positive weight, coincident, collinear, coplanar), it is the base normaliser's and
            carries no gradient. It is a rank test: a plane with 0.01 px of noise passes.
        gap: relative gap of the design matrix, from 0 to 1, that ``determined`` is decided on, (B,); see
            :func:`~kornia_learnnorm.geometry.dlt.solve_epipolar`. Errors grow as its inverse.
    """

    F_mat: Tensor
    E_mat: Tensor | None
    determined: Tensor
    gap: Tensor


class EightPoint(nn.Module):
    r"""The normalised eight-point algorithm as an nn.Module, with finite outputs and gradients on degenerate samples.

    They are finite for points within 1e50 of the origin whose mean distance from their centroid is zero or at least
    1e-50. A correspondence that is masked, or of weight zero, counts as absent. A sample that does not determine its
    matrix is solved with the base normaliser (``normalizer.base`` where there is one, else Hartley's) and sends no
    gradient, neither to the points nor to the normaliser.

    Do not use it on matches with outliers: it is least squares. :class:`~kornia_learnnorm.RANSAC` rejects them.

    Args:
        normalizer: a module or callable ``(points1, points2, weights) -> (T1, T2)``; Hartley's when not given.
        rank2: how the singularity constraint is enforced, see :func:`kornia_learnnorm.find_fundamental`.

    Raises:
        ValueError: if ``rank2`` is neither ``"projection"`` nor ``"optimal"``.
        TypeError: if ``normalizer`` is neither a module nor a function, or the layer is compiled by ``torch.jit``;
            ``torch.compile`` and ``torch.export`` take it.

    Example:
        >>> layer = EightPoint()
        >>> layer(torch.rand(2, 8, 2), torch.rand(2, 8, 2)).shape
        torch.Size([2, 3, 3])
        >>> points = torch.rand(2, 1, 2).expand(2, 8, 2)
        >>> layer.estimate(points, points).determined
        tensor([False, False])

    """

    def __init__(
        self, normalizer: Normalizer | None = None, rank2: Literal["projection", "optimal"] = "projection"
    ) -> None:
        super().__init__()
        check_rank2(rank2)
        if normalizer is not None:
            check_normalizer(normalizer)
        self.normalizer = Hartley() if normalizer is None else normalizer
        self.rank2: Literal["projection", "optimal"] = rank2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"rank2={self.rank2!r}"

    def forward(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        r"""Return the fundamental matrices.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`.
            mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`.

        Returns:
            matrices with shape :math:`(B, 3, 3)`, see :meth:`estimate`.

        Raises:
            TypeError: as :meth:`estimate`.
            ShapeError: as :meth:`estimate`.
            ValueError: as :meth:`estimate`.

        """
        return self.estimate(points1, points2, weights=weights, mask=mask).F_mat

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        *,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> TwoViewEstimate:
        r"""Return the fundamental matrices, which samples determine theirs, and essential matrices where asked for.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64;
                calibrated coordinates are as good, and give essential matrices.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`, of any floating-point dtype.
            mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`. Masked rows
                may hold any value, NaN too, and get a gradient of zero; without a mask NaN is an error.
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
        problem = prepare_problem(points1, points2, weights, mask, K1, K2)
        (F_mat,) = solve_where_determined(problem, self._solve, self._solve_undetermined)
        F_mat = F_mat.to(points1.dtype)
        return TwoViewEstimate(F_mat, essential_matrix(F_mat, K1, K2), problem.determined, problem.gap)

    def from_matches(
        self,
        keypoints1: Tensor,
        keypoints2: Tensor,
        matches: Tensor | Sequence[Tensor],
        scores: Tensor | Sequence[Tensor] | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> TwoViewEstimate:
        r"""Return the estimate of the matches of a matching network; scores are weights, and get gradients.

        Args:
            keypoints1: pixels in the first view with shape :math:`(B, M_1, 2)`.
            keypoints2: pixels in the second view with shape :math:`(B, M_2, 2)`.
            matches: see :func:`~kornia_learnnorm.estimators.matches.correspondences_from_matches`.
            scores: one for each match, non-negative.
            K1: optional cameras of the first view, as for :meth:`estimate`.
            K2: optional cameras of the second view.

        Returns:
            the matrices; pairs with fewer than eight matches are not determined.

        Raises:
            TypeError: if keypoints, matches or scores are not tensors of the right kind.
            ShapeError: if the keypoints do not have the shape above.
            ValueError: if the matches do not fit the keypoints, or as :meth:`estimate`.

        """
        points1, points2, weights, mask = correspondences_from_matches(keypoints1, keypoints2, matches, scores)
        return self.estimate(points1, points2, weights=weights, mask=mask, K1=K1, K2=K2)

    def _solve(self, problem: LinearProblem, rows: Tensor | None) -> tuple[Tensor]:
        return (solve_fundamental(problem, self.normalizer, self.rank2),)

    def _solve_undetermined(self, problem: LinearProblem) -> tuple[Tensor]:
        return (solve_undetermined(problem, getattr(self.normalizer, "base", None) or Hartley(), self.rank2),)

    def __prepare_scriptable__(self) -> NoReturn:
        """Raise a TypeError: ``torch.jit`` is not supported."""
        refuse_jit()


def refuse_jit() -> NoReturn:
    """Raise a TypeError that says what to use instead of ``torch.jit``."""
    raise TypeError("this layer cannot be compiled by torch.jit, use torch.compile or torch.export")


def prepare_problem(
    points1: Tensor,
    points2: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    K1: Tensor | None,
    K2: Tensor | None,
) -> LinearProblem:
    """Return the problem of the arguments of :meth:`EightPoint.estimate`, checked; masked rows have weight zero."""
    if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
        refuse_jit()
    if (K1 is None) != (K2 is None):
        raise ValueError(f"K1 and K2 must be given together, got only {'K1' if K2 is None else 'K2'}")
    if mask is not None:
        check_mask(mask, points1, points2, weights)
        points1, points2 = (torch.where(mask[..., None], points, 0.0) for points in (points1, points2))
        weights = mask.to(points1) if weights is None else torch.where(mask, weights, 0.0)
    check_correspondences(points1, points2, weights)
    check_cameras(K1, K2, points1.shape[0])
    return LinearProblem.from_points(
        points1, points2, None if weights is None else _rescale(weights.to(solve_dtype(points1.device)))
    )


def solve_where_determined(
    problem: LinearProblem,
    solve: Callable[[LinearProblem, Tensor | None], tuple[Tensor, ...]],
    solve_undetermined: Callable[[LinearProblem], tuple[Tensor, ...]],
) -> tuple[Tensor, ...]:
    """Return the solutions of sets of correspondences that determine their matrix, and other ones of those that don't.

    Args:
        problem: all sets.
        solve: returns tensors (B', ...) of a problem and the indices of its sets, None for all.
        solve_undetermined: returns the same tensors of a problem that does not determine its matrices.

    """
    determined = problem.determined
    if problem.all_determined:
        return solve(problem, None)
    if problem.all_determined is None:
        return _solve_traced(problem, solve, solve_undetermined)
    found, rest = determined.nonzero()[:, 0], (~determined).nonzero()[:, 0]
    with torch.no_grad():
        others = solve_undetermined(problem.select(rest))
    solutions = solve(problem.select(found), found)
    return tuple(
        value.new_empty(len(determined), *value.shape[1:]).index_copy(0, rest, other).index_copy(0, found, value)
        for value, other in zip(solutions, others, strict=True)
    )


def _solve_traced(
    problem: LinearProblem,
    solve: Callable[[LinearProblem, Tensor | None], tuple[Tensor, ...]],
    solve_undetermined: Callable[[LinearProblem], tuple[Tensor, ...]],
) -> tuple[Tensor, ...]:
    """Return the solutions without data-dependent shapes, as ``torch.compile`` and ``vmap`` need.

    No derivative meets an undetermined set: generic points take its place, and their result is dropped.
    """
    rows, points = problem.determined[:, None], (problem.points1, problem.points2)
    generic = _generic_points(problem.points1)
    points1, points2 = (torch.where(rows[..., None], p, g) for p, g in zip(points, generic, strict=True))
    weights = None if problem.weights is None else torch.where(rows, problem.weights, 1.0)
    solutions = solve(LinearProblem.from_points(points1, points2, weights), None)
    with torch.no_grad():
        others = solve_undetermined(problem)
    return tuple(
        torch.where(rows.view(-1, *[1] * (value.ndim - 1)), value, other)
        for value, other in zip(solutions, others, strict=True)
    )


@torch.no_grad()
def solve_undetermined(
    problem: LinearProblem, normalizer: Normalizer, rank2: Literal["projection", "optimal"] = "projection"
) -> Tensor:
    """Return matrices of rank 2 of sets of correspondences that do not determine them, without gradient."""
    F_mat = solve_fundamental(problem, normalizer, rank2)
    # With at most one point F has rank 1; use the F of a sideways motion.
    values = torch.linalg.svdvals(F_mat)
    return torch.where((values[:, 1] > MIN_RANK2_RATIO * values[:, 0])[:, None, None], F_mat, _sideways(F_mat))


def essential_matrix(F_mat: Tensor, K1: Tensor | None, K2: Tensor | None) -> Tensor | None:
    r"""Return :math:`K_2^\top F K_1` with unit Frobenius norm, None without cameras."""
    if K1 is None or K2 is None:
        return None
    return unit_fundamental(transform_fundamental(F_mat, K1.to(F_mat), K2.to(F_mat)))


def _rescale(weights: Tensor) -> Tensor:
    """Return weights scaled where the largest would over- or underflow; sets with none above 1e-30 get zeros."""
    top = weights.detach().amax(-1, keepdim=True)
    weights = torch.where(top < 1e-30, 0.0, weights)
    return weights / torch.where((top < 1e-30) | ((top > 1e-15) & (top < 1e15)), 1.0, top)


def _sideways(like: Tensor) -> Tensor:
    """Return the fundamental matrix of a sideways motion, whose epipolar lines are the rows of the image."""
    return normalize(like.new_tensor([0.0, 0, 0, 0, 0, 1, 0, -1, 0]), dim=-1).view(3, 3)


def _generic_points(like: Tensor) -> tuple[Tensor, Tensor]:
    """Return correspondences (B, N, 2) that determine a matrix: multiples of irrational numbers, modulo one."""
    index = torch.arange(1, like.shape[1] + 1, dtype=like.dtype, device=like.device)[:, None]
    roots = torch.tensor([2.0, 3.0, 5.0, 7.0], dtype=like.dtype, device=like.device).sqrt()
    points = (index * roots).frac().expand(like.shape[0], -1, -1)
    return points[..., :2], points[..., 2:]

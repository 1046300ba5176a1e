r"""The linear problem of one set of correspondences: normalised and solved once, then handed down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.geometry.checks import needs_gradient, read_condition, solve_dtype
from kornia_learnnorm.geometry.dlt import (
    MIN_GAP,
    design_matrix,
    independence_gap,
    sideways_null_vector,
    solve_epipolar,
)
from kornia_learnnorm.geometry.matrices import inverse
from kornia_learnnorm.geometry.transforms import hartley_coordinates, transform_fundamental

__all__ = ["LinearProblem"]


@dataclass
class LinearProblem:
    r"""Correspondences in Hartley's coordinates and the null matrix of their design matrix.

    Built once per call, from checked input, by :meth:`from_points`. The null matrix is solved when it is first asked
    for. Eight points have an exact null vector, so it is carried to other coordinates,
    :math:`F' = R_2^{-\top} F R_1^{-1}`; with more points it minimises another sum of squares there and is solved again.

    Attributes:
        points1: pixels in the first view, (B, N, 2), float64 where the device has it.
        points2: pixels in the second view.
        weights: weights, (B, N), or None.
        T1: Hartley's transform of the first view, (B, 3, 3).
        T2: Hartley's transform of the second view.
        x1: homogeneous points of the first view in Hartley's coordinates, (B, N, 3).
        x2: homogeneous points of the second view.
        solution: null matrix and relative gap, once solved.
        all_determined: whether all null matrices are unique, once solved; None where values cannot be read.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> problem = LinearProblem.from_points(torch.rand(2, 8, 2) * 600, torch.rand(2, 8, 2) * 600)
        >>> problem.null_matrix.shape, problem.determined
        (torch.Size([2, 3, 3]), tensor([True, True]))

    """

    points1: Tensor
    points2: Tensor
    weights: Tensor | None
    T1: Tensor
    T2: Tensor
    x1: Tensor
    x2: Tensor
    solution: tuple[Tensor, Tensor] | None = None
    all_determined: bool | None = None

    @classmethod
    def from_points(cls, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> LinearProblem:
        r"""Return the problem of correspondences, in float64 where the device has it."""
        dtype = solve_dtype(points1.device)
        points, weights = torch.stack([points1, points2]).to(dtype), None if weights is None else weights.to(dtype)
        (x1, x2), (T1, T2) = hartley_coordinates(points, weights)
        points1, points2 = points
        return cls(points1, points2, weights, T1, T2, x1, x2)

    @property
    def null_matrix(self) -> Tensor:
        """The DLT's solution before the rank-2 constraint in Hartley's coordinates, unit norm, (B, 3, 3)."""
        return self._solve()[0]

    @property
    def gap(self) -> Tensor:
        """Relative gap that tells how well the points determine the null matrix, (B,); see ``solve_epipolar``."""
        return self._solve()[1]

    @property
    def determined(self) -> Tensor:
        """Whether the null matrix is unique, (B,) bool."""
        return self.gap > MIN_GAP

    def _solve(self) -> tuple[Tensor, Tensor]:
        # A solution found under `no_grad` must not cut the derivatives of a later caller.
        wanted = torch.is_grad_enabled() and self.x1.requires_grad
        if self.solution is None or (wanted and not self.solution[0].requires_grad):
            self.solution, self.all_determined = self._solve_between(self.x1, self.x2)
        return self.solution

    def _solve_between(self, x1: Tensor, x2: Tensor) -> tuple[tuple[Tensor, Tensor], bool | None]:
        """Return null matrix and gap in some coordinates, and whether all null matrices are unique."""
        h, gap = solve_epipolar(x1, x2, self.weights)
        all_determined = read_condition((gap > MIN_GAP).all())
        if all_determined is False:
            rows = (gap <= independence_gap(gap.dtype)).nonzero()[:, 0]
            A = design_matrix(x1[rows], x2[rows])
            A = A if self.weights is None else A * self.weights[rows].sqrt()[..., None]
            h = h.index_copy(0, rows, sideways_null_vector(A))
        return (torch.unflatten(h, -1, (3, 3)), gap), all_determined

    def null_matrix_in(self, T1: Tensor, T2: Tensor) -> Tensor:
        r"""Return the null matrix in the coordinates :math:`T_i x_i` of pixels :math:`x_i`, unit norm, (B, 3, 3)."""
        return self.solve_in(T1, T2)[0]

    def solve_in(self, T1: Tensor, T2: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return the null matrix in the coordinates :math:`T_i x_i`, (B, 3, 3), and its relative gap, (B,)."""
        if T1 is self.T1 and T2 is self.T2:
            return self._solve()
        if self.points1.shape[1] == 8:
            R1, R2 = torch.stack([self.T1, self.T2]) @ inverse(torch.stack([T1, T2]))
            F = transform_fundamental(self.null_matrix, R1, R2)
            # A null matrix without gradient must not get one by way of Hartley's transforms either.
            if needs_gradient(F):
                F = torch.where((self.gap > independence_gap(F.dtype))[:, None, None], F, F.detach())
            return F / torch.linalg.matrix_norm(F, keepdim=True), self.gap
        x1, x2 = (T @ convert_points_to_homogeneous(p).mT for T, p in ((T1, self.points1), (T2, self.points2)))
        return self._solve_between(x1.mT, x2.mT)[0]

    def select(self, rows: Tensor) -> LinearProblem:
        """Return the problem of some of the sets, by their indices or a mask (B,); solved if this one is."""
        return self._changed(lambda value: value[rows])

    def detach(self, rows: Tensor) -> LinearProblem:
        """Return the same problem, in which the sets marked in ``rows``, (B,) bool, send no gradient."""
        return self._changed(lambda v: torch.where(rows.view(-1, *[1] * (v.ndim - 1)), v.detach(), v))

    def _changed(self, change: Callable[[Tensor], Tensor]) -> LinearProblem:
        return LinearProblem(
            change(self.points1),
            change(self.points2),
            None if self.weights is None else change(self.weights),
            change(self.T1),
            change(self.T2),
            change(self.x1),
            change(self.x2),
            None if self.solution is None else (change(self.solution[0]), change(self.solution[1])),
        )

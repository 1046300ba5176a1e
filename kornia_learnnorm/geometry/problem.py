r"""The linear problem of sets of correspondences: normalised and solved once, then handed down."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor
from torch.nn.functional import pad

from kornia_learnnorm.geometry import checks
from kornia_learnnorm.geometry.dlt import DEPENDENT_GAP, MIN_GAP, nearest_null_vector
from kornia_learnnorm.geometry.matrices import inverse


@dataclass
class LinearProblem:
    """Correspondences in Hartley's coordinates and the null matrix of their design matrix.

    Built once per call, from checked input, by :meth:`from_points`. The null matrix is solved when it is first asked
    for. As few points as determine it have an exact null vector, so it is carried to other coordinates; with more
    points it minimises another sum of squares there and is solved again.
    """

    model: Any  # a TwoViewModel, on which nothing of this package may depend here
    points1: Tensor  # pixels, (B, N, 2), float64 where the device has it
    points2: Tensor
    weights: Tensor | None  # (B, N)
    T1: Tensor  # Hartley's transform, (B, 3, 3)
    T2: Tensor
    x1: Tensor  # homogeneous points in Hartley's coordinates, (B, N, 3)
    x2: Tensor
    solution: tuple[Tensor, Tensor] | None = None  # null matrix and relative gap, once solved
    all_determined: bool | None = None  # whether all null matrices are unique; None where values cannot be read

    @classmethod
    def from_points(cls, points1: Tensor, points2: Tensor, weights: Tensor | None, model: Any) -> Self:
        r"""Return the problem of correspondences, in float64 where the device has it."""
        dtype = checks.solve_dtype(points1.device)
        points = torch.stack([points1, points2]).to(dtype)
        weights = None if weights is None else weights.to(dtype)
        (x1, x2), (T1, T2) = hartley_coordinates(points, weights)
        points1, points2 = points
        return cls(model, points1, points2, weights, T1, T2, x1, x2)

    @property
    def null_matrix(self) -> Tensor:
        """The DLT's solution before any constraint in Hartley's coordinates, unit norm, (B, 3, 3)."""
        return self.solve()[0]

    @property
    def gap(self) -> Tensor:
        """Relative gap: how well the points determine the null matrix, (B,); see ``dlt.solve_rows``."""
        return self.solve()[1]

    @property
    def determined(self) -> Tensor:
        """Whether the null matrix is unique, (B,) bool."""
        return self.gap > MIN_GAP

    @property
    def present(self) -> Tensor | None:
        """One for correspondences of positive weight, zero for absent ones, (B, N); None where all are present."""
        return None if self.weights is None else (self.weights > 0).to(self.x1)

    def solve(self) -> tuple[Tensor, Tensor]:
        """Return the null matrix in Hartley's coordinates, (B, 3, 3), and its relative gap, (B,)."""
        # A solution found under `no_grad` must not cut the derivatives of a later caller.
        wanted = torch.is_grad_enabled() and self.x1.requires_grad
        if self.solution is None or (wanted and not self.solution[0].requires_grad):
            M, gap, self.all_determined = self._solve_between(self.x1, self.x2)
            self.solution = M, gap
        return self.solution

    def _solve_between(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor, bool | None]:
        """Return null matrix and gap in some coordinates, and whether all null matrices are unique."""
        h, gap = self.model.null_vector(x1, x2, self.weights)
        all_determined = checks.read_condition((gap > MIN_GAP).all())
        if all_determined is False:
            rows = (gap <= DEPENDENT_GAP[gap.dtype]).nonzero()[:, 0]
            A = self.model.rows(x1[rows], x2[rows])
            if self.weights is not None:
                A = A * self.model.row_weights(self.weights[rows]).sqrt()[..., None]
            h = h.index_copy(0, rows, nearest_null_vector(A, A.new_tensor(self.model.preferred)))
        return torch.unflatten(h, -1, (3, 3)), gap, all_determined

    def solve_in(self, T1: Tensor, T2: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return the unit null matrix in the coordinates :math:`T_i x_i`, (B, 3, 3), and its relative gap, (B,)."""
        if T1 is self.T1 and T2 is self.T2:
            return self.solve()
        if self.points1.shape[1] == self.model.min_points:
            R1, R2 = torch.stack([self.T1, self.T2]) @ inverse(torch.stack([T1, T2]))
            M = self.model.carry(self.null_matrix, R1, R2)
            # A null matrix without gradient must not get one by way of Hartley's transforms either.
            if checks.needs_gradient(M):
                M = torch.where((self.gap > DEPENDENT_GAP[M.dtype])[:, None, None], M, M.detach())
            return M / torch.linalg.matrix_norm(M, keepdim=True), self.gap
        rows = convert_points_to_homogeneous(torch.stack([self.points1, self.points2])).mT
        x1, x2 = (torch.stack([T1, T2]) @ rows).mT
        return self._solve_between(x1, x2)[:2]

    def select(self, rows: Tensor | slice) -> Self:
        """Return the problem of some of the sets, by their indices, a mask (B,) or a slice; solved if this one is."""
        return self._map(lambda value: value[rows])

    def detach(self, rows: Tensor) -> Self:
        """Return the same problem, in which the sets marked in ``rows``, (B,) bool, send no gradient."""
        return self._map(lambda v: torch.where(rows.view(-1, *[1] * (v.ndim - 1)), v.detach(), v))

    def with_generic_points(self, determined: Tensor) -> Self:
        """Return the problem with generic points in place of undetermined sets: no derivative meets one of these."""
        rows, like = determined[:, None], self.points1
        numbers = torch.arange(1, like.shape[1] + 1, dtype=like.dtype, device=like.device)[:, None]
        generic = (numbers * like.new_tensor([2.0, 3.0, 5.0, 7.0]).sqrt()).frac()  # multiples of irrational numbers
        points1 = torch.where(rows[..., None], self.points1, generic[:, :2])
        points2 = torch.where(rows[..., None], self.points2, generic[:, 2:])
        weights = None if self.weights is None else torch.where(rows, self.weights, 1.0)
        return self.from_points(points1, points2, weights, self.model)

    def _map(self, function: Callable[[Tensor], Tensor]) -> Self:
        tensors = (self.points1, self.points2, self.weights, self.T1, self.T2, self.x1, self.x2)
        changed: Any = [None if value is None else function(value) for value in tensors]
        problem = type(self)(self.model, *changed)
        if self.solution is not None:
            problem.solution = function(self.solution[0]), function(self.solution[1])
        return problem


def solve_where_determined(
    problem: LinearProblem,
    solve: Callable[[LinearProblem, Tensor | None], tuple[Tensor, ...]],
    solve_undetermined: Callable[[LinearProblem], tuple[Tensor, ...]],
) -> tuple[Tensor, ...]:
    """Return the solutions of sets of correspondences, and placeholders for those that do not determine their matrix.

    ``solve`` returns tensors (B', ...) of a problem and the indices of its sets, None for all; ``solve_undetermined``
    the same tensors of a problem that does not determine its matrices.
    """
    problem.solve()
    if problem.all_determined:
        return solve(problem, None)
    determined = problem.determined
    if problem.all_determined is None:  # without data-dependent shapes, as `torch.compile` and `vmap` need
        solutions = solve(problem.with_generic_points(determined), None)
        with torch.no_grad():
            others = solve_undetermined(problem)
        pairs = zip(solutions, others, strict=True)
        return tuple(torch.where(determined.view(-1, *[1] * (value.ndim - 1)), value, other) for value, other in pairs)
    found, rest = determined.nonzero()[:, 0], (~determined).nonzero()[:, 0]
    with torch.no_grad():
        others = solve_undetermined(problem.select(rest))
    solutions = solve(problem.select(found), found)
    return tuple(
        value.new_empty(len(determined), *value.shape[1:]).index_copy(0, rest, other).index_copy(0, found, value)
        for value, other in zip(solutions, others, strict=True)
    )


def prepare_problem(
    model: Any, points1: Tensor, points2: Tensor, weights: Tensor | None, mask: Tensor | None, least: int | None = None
) -> LinearProblem:
    """Return the problem of a layer's arguments, checked, ``least`` rows too; masked rows have weight zero."""
    if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
        checks.refuse_jit()
    if mask is not None:
        checks.check_pairs(points1, points2, ["B", "N", "2"])
        checks.check_mask(mask, points1, points2, weights)
        points1, points2 = (torch.where(mask[..., None], points, 0.0) for points in (points1, points2))
        weights = mask.to(points1) if weights is None else torch.where(mask, weights, 0.0)
    checks.check_correspondences(points1, points2, weights, model.min_points if least is None else least)
    if weights is not None:
        weights = weights.to(checks.solve_dtype(points1.device))
        # Scaled where the largest would over- or underflow; sets with none above 1e-30 get zeros.
        top = weights.detach().amax(-1, keepdim=True)
        weights = torch.where(top < 1e-30, 0.0, weights)
        weights = weights / torch.where((top < 1e-30) | ((top > 1e-15) & (top < 1e15)), 1.0, top)
    return LinearProblem.from_points(points1, points2, weights, model)


def hartley_coordinates(points: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return homogeneous points :math:`(*, N, 3)` in Hartley's coordinates, and the transforms :math:`(*, 3, 3)`.

    They centre points :math:`(*, N, 2)` with optional weights :math:`(*, N)` and make their mean distance from the
    centroid :math:`\sqrt 2` (R. Hartley, In defense of the eight-point algorithm, TPAMI 1997; Fan et al., Eq. 4).
    Coincident points keep their scale.

    The points come transposed in memory: on a CPU, one coordinate of all points is a longer run than all of one point.
    """
    rows = points.mT.contiguous()
    origin = checks.weighted_mean(rows.mT, weights)
    centred = rows - origin[..., None]
    least = torch.finfo(points.dtype).tiny  # so that the distance of a point at the centroid has a derivative
    distance = (centred.square().sum(-2) + least).sqrt()
    radius = checks.weighted_mean(distance[..., None], weights)[..., 0]
    # A mean is not exact: up to this distance from it, points coincide.
    rounding = 16 * torch.finfo(points.dtype).eps * torch.linalg.vector_norm(origin.detach(), dim=-1)
    scale = math.sqrt(2) / torch.where(radius > rounding + 2 * math.sqrt(least), radius, math.sqrt(2))
    shift_x, shift_y = (origin * -scale[..., None]).unbind(-1)
    zero, one = torch.zeros_like(scale), torch.ones_like(scale)
    entries = torch.stack([scale, zero, shift_x, zero, scale, shift_y, zero, zero, one], -1)
    return pad(centred * scale[..., None, None], (0, 0, 0, 1), value=1.0).mT, torch.unflatten(entries, -1, (3, 3))

r"""The fundamental matrix as a two-view model: eight points, rank 2, seven degrees of freedom.

On its manifold a matrix of unit norm is kept as :math:`F = U_{:,1:2}\, A\, V_{:,1:2}^\top` with rotations :math:`U, V`
and a :math:`2 \times 2` matrix :math:`A` of unit norm. A step has seven parameters: two tilt the last axis of each
rotation, the epipole, and three turn :math:`A` on the unit sphere. Two rotations and the ratio of the singular values
are seven parameters too, but are singular where the singular values are equal, as under pure forward motion.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from kornia_learnnorm.geometry.checks import check_choice
from kornia_learnnorm.geometry.constrained_fit import Fit, Loss, constrained_fit
from kornia_learnnorm.geometry.distances import DISTANCE_SCALES, Distance, line_norms
from kornia_learnnorm.geometry.dlt import design_matrix, null_space, solve_rows
from kornia_learnnorm.geometry.matrices import inverse, nearest_rank2
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.rank2_correction import correct_rank2
from kornia_learnnorm.geometry.seven_point import fundamental_in_span
from kornia_learnnorm.models.two_view_model import TwoViewModel

Rank2Method = Literal["projection", "optimal"]
SIDEWAYS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5**0.5, 0.0, -(0.5**0.5), 0.0)  # F whose epipolar lines are the image's rows
MIN_PIVOT = 1e-6  # of the largest one, of a sample of seven correspondences that is not degenerate
MIN_RANK2_DETERMINANT = 1e-9  # of the 2x2 part of a matrix of rank 2 and unit norm
MIN_RANK2_RATIO = 1e-10  # second over first singular value of a matrix of rank 2
NORMAL_FLOOR = 1e-4  # of the root mean square norm of the lines' normals, added to each in learned layers
FEATURE_FLOOR = 0.3  # of the mean norm of a line's normal, added to each, or points near an epipole outweigh all others


class Fundamental(TwoViewModel):
    r"""Fundamental matrices, :math:`x_2^\top F x_1 = 0`.

    ``rank2`` is ``"projection"`` in Frobenius norm in normalised coordinates, or ``"optimal"`` correction, see
    :func:`~kornia_learnnorm.optimal_rank2`. ``distance`` is the residual of a correspondence: the ``"sampson"`` or
    ``"symmetric"`` distance (Fan et al., Eq. 8). Other names are a ValueError.
    """

    name = "fundamental"
    min_points = 8
    dof = 7
    sample_size = 7
    preferred: tuple[float, ...] = SIDEWAYS

    def __init__(self, rank2: Rank2Method = "projection", distance: Distance = "sampson") -> None:
        check_choice("rank2", rank2, ("projection", "optimal"))
        check_choice("distance", distance, DISTANCE_SCALES)
        self.rank2, self.distance, self.scale = rank2, distance, DISTANCE_SCALES[distance]

    def rows(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Return the design matrix, one row a correspondence."""
        return design_matrix(x1, x2)

    def null_vector(self, x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the null vector and its relative gap."""
        rows1, rows2 = x1.mT, x2.mT

        def product(h: Tensor) -> Tensor:  # with derivatives by the points, without those by the nine columns
            residual = ((torch.unflatten(h, -1, (3, 3)).mT @ rows2) * rows1).sum(-2, keepdim=True)
            return ((rows2 * (residual if weights is None else residual * weights[..., None, :])) @ x1).flatten(-2)

        return solve_rows(design_matrix(x1, x2), weights, product)

    def carry(self, M: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
        r"""Return :math:`T_2^\top F T_1`."""
        return T2.mT @ M @ T1

    def swap(self, M: Tensor) -> Tensor:
        r"""Return :math:`F^\top`."""
        return M.mT

    def constrain(self, M: Tensor) -> Tensor:
        """Return the nearest matrices of rank 2."""
        return nearest_rank2(M)

    def needs_transforms(self, problem: LinearProblem) -> bool:
        """Return false for the optimal correction of eight points."""
        return self.rank2 == "projection" or problem.x1.shape[1] != self.min_points

    def constrain_in(self, problem: LinearProblem, M: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
        """Return matrices of rank 2: projected in the coordinates of T1 and T2, or corrected in the problem's."""
        if self.rank2 == "projection":
            return T2.mT @ nearest_rank2(M) @ T1
        if T1 is not problem.T1:
            M = self.carry(M, *(torch.stack([T1, T2]) @ inverse(torch.stack([problem.T1, problem.T2]))))
        return self.carry(correct_rank2(problem, M), problem.T1, problem.T2)

    def solve_minimal(self, problem: LinearProblem) -> Tensor:
        """Return the optimal correction of the null matrices."""
        return correct_rank2(problem, problem.null_matrix)

    def fallback(self, M: Tensor) -> Tensor:
        """Return F of a sideways motion in place of matrices of rank 1, which at most one point gives."""
        values = torch.linalg.svdvals(M)
        known = (values[:, 1] > MIN_RANK2_RATIO * values[:, 0])[:, None, None]
        return torch.where(known, M, M.new_tensor(SIDEWAYS).view(3, 3))

    def linearise(self, M: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return distances with signs and their derivatives by the column-major entries."""
        line1, line2 = M.mT[:, :2] @ x2, M @ x1
        algebraic, line2 = (x2 * line2).sum(1), line2[:, :2]
        sq_norm1, sq_norm2 = line1.square().sum(1), line2.square().sum(1)
        if weights is None:
            floor = torch.finfo(M.dtype).eps ** 2  # below it the direction of a line is rounding
            sq_norm1, sq_norm2 = sq_norm1.clamp(min=floor), sq_norm2.clamp(min=floor)
        else:
            share = NORMAL_FLOOR**2 / 2 * ((sq_norm1 + sq_norm2) * weights).sum(-1, keepdim=True)
            sq_norm1, sq_norm2 = sq_norm1 + share, sq_norm2 + share
        if self.distance == "sampson":
            scale = (sq_norm1 + sq_norm2).rsqrt()
            slope1 = slope2 = scale.pow(3) / -2
        else:
            scale, slope1, slope2 = self.scale(sq_norm1, sq_norm2)
        twice = 2 * algebraic
        pull1, pull2 = (twice * slope1)[:, None] * line1, (twice * slope2)[:, None] * line2
        # A change dF changes the distance by x2^T dF (scale x1 + pull1) + pull2^T dF x1.
        right, left = pad(pull1, (0, 0, 0, 1)) + scale[:, None] * x1, pad(pull2, (0, 0, 0, 1))
        J = torch.addcmul(right[:, :, None] * x2[:, None], x1[:, :, None], left[:, None])
        return algebraic * scale, J.flatten(1, 2)

    def robust_distance(self, M: Tensor, x1: Tensor, x2: Tensor, present: Tensor | None) -> tuple[Tensor, Tensor]:
        r"""Return squared Sampson distances and gradient factors, with 0.3 of the mean norm added to each line's."""
        norm1, norm2 = line_norms(x1, x2, M, present, floor=FEATURE_FLOOR)
        factor = 1 / (norm1.square() + norm2.square())
        return (x2 * (M @ x1)).sum(1).square() * factor, factor

    def state(self, M: Tensor) -> Any:
        """Return the nearest matrices of rank 2 and unit norm."""
        U, s, Vh = torch.linalg.svd(M)
        return Rank2(torch.stack([U, Vh.mT], 1), torch.diag_embed(normalize(s[:, :2], dim=-1)))

    def solve_samples(self, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
        """Return the matrices of the samples of seven, up to three each; degenerate ones have none."""
        basis, pivots = null_space(design_matrix(x1, x2))
        M, real = fundamental_in_span(torch.unflatten(basis.mT, -1, (3, 3)))
        return M[real & (pivots.amin(-1) > MIN_PIVOT * pivots.amax(-1))[:, None]]

    def score_terms(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Return what algebraic residuals are linear in, and the normals' squared norms in view 2 and 1, (27, N)."""
        x = torch.stack([x1, x2])
        return torch.cat([(x2[:, None] * x1)[None], x[:, :, None] * x[:, None]]).flatten(0, 2)

    def score_squares(self, M: Tensor, terms: Tensor, threshold: float) -> Tensor:
        """Return squared distances over the threshold's square by three matrix products."""
        tiny = torch.finfo(M.dtype).tiny
        algebraic, products1, products2 = torch.unflatten(terms, 0, (3, 9))
        sq_norm1 = ((M[:, :, :2] @ M[:, :, :2].mT).flatten(1) @ products2).clamp_(min=tiny)
        sq_norm2 = ((M[:, :2].mT @ M[:, :2]).flatten(1) @ products1).clamp_(min=tiny)
        scale = self.scale(sq_norm1, sq_norm2, slopes=False)[0]
        squares: Tensor = ((M / threshold).flatten(1) @ algebraic).mul_(scale).square_()
        return squares

    def reweighted_fit(self, x1: Tensor, x2: Tensor, M: Tensor, losses: Sequence[Loss]) -> Fit | None:
        """Return matrices fitted by least squares under the singularity constraint."""
        return constrained_fit(x1, x2, M, losses, self.scale)

    def is_degenerate(self, state: Any) -> Tensor:
        """Return which matrices have rank 1."""
        return torch.lt(torch.linalg.det(state.A).abs(), MIN_RANK2_DETERMINANT)


class Rank2(NamedTuple):
    """Matrices of rank 2 and unit norm."""

    axes: Tensor  # rotations of view 2 and of view 1, (B, 2, 3, 3)
    A: Tensor  # unit matrices between them, (B, 2, 2)

    def matrix(self) -> Tensor:
        """Return the matrices themselves, (B, 3, 3)."""
        U, V = self.axes[..., :2].unbind(1)
        return U @ self.A @ V.mT

    def tangents(self) -> Tensor:
        """Return the derivatives (B, 9, 7) of the matrices' column-major entries by a step."""
        U, V = self.axes.unbind(1)
        inner = torch.unflatten(self.A.flatten(1) @ _TANGENTS.to(U), -1, (3, 21))
        outer = V @ torch.unflatten(U @ inner, -1, (3, 7)).transpose(1, 2).flatten(2)
        return torch.unflatten(outer, -1, (3, 7)).flatten(1, 2)

    def retract(self, step: Tensor) -> Self:
        """Return the state after a step, (B, 7) or (B, 5): tilts of both views and turns of the matrix between them."""
        a, tilt, turn = self.A.flatten(1), torch.unflatten(step[:, :4], -1, (2, 2)), step[:, None, 4:]
        turns = torch.unflatten(a @ _TURNS.to(a), -1, (3, 4))[:, : turn.shape[-1]]
        turned = a + (turn @ turns).squeeze(1)
        # Cayley's map agrees with the exponential to second order and has no sine.
        S = torch.unflatten(tilt @ _SKEW.to(a), -1, (3, 3))
        square = S @ S
        rotation = torch.add(S, square, alpha=0.5) / (1 - square[..., 2:, 2:] / 4)
        unit = turned / torch.linalg.vector_norm(turned, dim=-1, keepdim=True)  # at least one: turns are orthogonal
        return type(self)(self.axes + self.axes @ rotation, torch.unflatten(unit, -1, (2, 2)))


def _linear_maps() -> tuple[Tensor, Tensor]:
    """Return what is linear in the entries of A: turns (4, 3, 4), and derivatives (4, 3, 3, 7) of U^T F V by a step.

    Turns are orthonormal directions orthogonal to unit quaternions: i, j and k times them.
    """
    a, b, c, d = eye = torch.eye(4, dtype=torch.float64)
    turns = torch.stack([-b, a, -d, c, -c, d, a, -b, -d, -c, b, a], -1).view(4, 3, 4)
    A, derivatives = eye.view(4, 2, 2), eye.new_zeros(4, 3, 3, 7)
    derivatives[:, 2, :2, :2], derivatives[:, :2, 2, 2:4] = A.mT, A
    derivatives[:, :2, :2, 4:] = torch.unflatten(turns.mT, -2, (2, 2))
    return turns.flatten(1), derivatives.flatten(1)


_TURNS, _TANGENTS = _linear_maps()
_SKEW = torch.tensor([[0, 0, -1, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, -1, 0, 1, 0]], dtype=torch.float64)

r"""Robust fits of matrices :math:`x_2^\top M x_1 = 0` to the second moments of the correspondences' design rows.

A step needs only the :math:`9 \times 9` matrix of the second moments of the rows, :math:`\sum_i w_i a_i a_i^\top`, and
the moments of the points: it is cheap even for thousands of matches. The code is the same for fundamental and essential
matrices; the state determines the manifold.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.optimize import choose
from kornia_learnnorm.geometry.checks import safe_divisor
from kornia_learnnorm.geometry.dlt import ENTRIES, normal_equations, point_products, row_moments, row_products
from kornia_learnnorm.models.essential import Calibrated

SQUARE_FLOOR = 1e-10  # of the frame's unit squared, added to squared distances before their logarithm
NORMAL_FLOOR = 1e-4  # of the norm of the matrix, added to the norm of each line's normal
SquareScale = Callable[[Tensor], Tensor]  # from squared distances (B, S, N) to the squared scale of a loss


class Evidence(NamedTuple):
    """Correspondences in the common frame, and the terms of their Sampson distances."""

    x1: Tensor  # homogeneous points, (B, 3, N)
    x2: Tensor
    rows: Tensor  # of the design matrix, for column-major entries, (B, 9, N)
    products: Tensor  # different entries of x1 x1^T and x2 x2^T, for the squared normals of lines, (B, 12, N)

    @classmethod
    def from_points(cls, x1: Tensor, x2: Tensor) -> "Evidence":
        """Return the evidence of homogeneous points (B, 3, N)."""
        return cls(x1, x2, (x1[:, :, None] * x2[:, None]).flatten(1, 2), point_products(x1, x2))

    def select(self, index: Tensor) -> "Evidence":
        """Return the correspondences of given indices (B, M)."""
        return Evidence(*[value.gather(2, index[:, None].expand(-1, value.shape[1], -1)) for value in self])

    def single(self) -> "Evidence":
        """Return the evidence in float32, which is enough to compare matrices."""
        return Evidence(*map(Tensor.float, self))

    def squares(self, F_mat: Tensor) -> tuple[Tensor, Tensor]:
        """Return squared Sampson distances under matrices (B, S, 3, 3) and gradient factors, each (B, S, N).

        The factors turn squared algebraic residuals into squared distances.
        """
        e = F_mat.mT.flatten(2)
        forms = (e.unsqueeze(-1) * e.unsqueeze(-2)).flatten(2) @ _FORMS.mT.to(e)
        # In place: for large batches, new memory costs more than the arithmetic.
        factor = (forms @ self.products).add_(torch.finfo(e.dtype).tiny).reciprocal_()
        residual = e @ self.rows
        squares = residual.square() if torch.is_grad_enabled() else residual.mul_(residual)
        return squares.mul_(factor), factor

    def losses(self, F_mat: Tensor, square_scale: Tensor) -> Tensor:
        """Return Geman and McClure's loss (B, S, N) under matrices (B, S, 3, 3), of a squared scale (B, S or 1, 1)."""
        squares = self.squares(F_mat)[0]
        return squares.div_(squares + square_scale.to(F_mat))

    def forms(self, share: Tensor, squares: Tensor, products: Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrices M and M - X of a step (:func:`descend`) over the trace of M, each (B S, 9, 9).

        ``share`` are weights times gradient factors, (B, S, N) as ``squares``; ``products`` are :func:`row_products`.
        """
        M, points = row_moments(share, products).flatten(0, 1), (share * squares) @ self.products.mT
        X = (points @ _FORMS.to(M)).view_as(M)
        size = (M.diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(M.dtype).tiny).view(-1, 1, 1)
        return M / size, (M - X) / size

    def in_front(self, state: Calibrated, weights: Tensor, number: int) -> Tensor:
        """Return which correspondences are in front of both cameras under the best of the four poses, (B, S, N) bool.

        States are ``number`` of each set; the pose with the largest sum of weights (B, S or 1, N) in front is the best.
        """
        R, t, C1, C2 = state.rotations(), state.axes[:, 0, :, 2:], state.C1, state.C2

        def times(forms: Tensor, points: Tensor) -> Tensor:
            """Return the products of K forms of each state, (B S, K, P), with all points, (B, S, K, N)."""
            values = torch.unflatten(forms, 0, (-1, number)).flatten(1, 2) @ points
            return torch.unflatten(values, 1, (number, forms.shape[1]))

        between = times((C2.mT[:, None] @ R @ C1[:, None]).mT.flatten(2), self.rows)  # x2^T R x1 of directions
        along1, along2 = times(((R[:, 0] @ C1).mT @ t).mT, self.x1), times((C2.mT @ t).mT, self.x2)  # of either R
        views = (C1, self.x1), (C2, self.x2)  # the states of a set have the same cameras
        square1, square2 = ((C[::number] @ x).square().sum(1)[:, None, None] for C, x in views)
        depth1, depth2 = along2 * between - along1 * square2, along2 * square1 - along1 * between
        front = torch.cat([(depth1 > 0) & (depth2 > 0), (depth1 < 0) & (depth2 < 0)], 2)
        best = (front.to(weights) @ weights[..., None]).argmax(2, keepdim=True)
        return front.gather(2, best.expand(-1, -1, 1, front.shape[-1]))[:, :, 0]


def descend(
    evidence: Evidence, state: Any, weights: Tensor, square_scale: SquareScale, steps: int, relaxation: float = 1.0
) -> Any:
    r"""Return the states of matrices, S of each set, after steps of reweighted least squares; differentiable.

    Each step computes the weights anew and takes a Gauss-Newton step on :math:`e^\top (M - X) e`. Squared distances are
    :math:`(e^\top a_i)^2 / e^\top B_i e`. With the denominators held fixed, the moments
    :math:`M = \sum_i w_i a_i a_i^\top / e^\top B_i e` alone would have another optimum:
    :math:`X = \sum_i w_i (e^\top a_i)^2 B_i / (e^\top B_i e)^2` is what the denominators add to the gradient.

    States hold (B S) matrices, weights are (B, S, N). ``square_scale`` gives the squared scale of Geman and McClure's
    loss, (B, S or 1, 1), from the squared distances (B, S, N). Steps are ``relaxation`` times the Gauss-Newton step.

    Reference:
        W. Chojnacki, M. Brooks, A. van den Hengel, D. Gawley, On the fitting of surfaces to data with covariances,
        IEEE Transactions on Pattern Analysis and Machine Intelligence, 2000.
    """
    F_mat, products = state.matrix(), row_products(evidence.products)
    for _ in range(steps):
        squares, factor = evidence.squares(torch.unflatten(F_mat, 0, (-1, weights.shape[1])))
        scale = square_scale(squares)
        slope = (scale / (scale + squares)).square()  # of Geman and McClure's loss
        M, difference = evidence.forms(weights * slope * factor, squares, products)
        e = F_mat.mT.reshape(-1, 9, 1)
        pull = difference @ e
        normal, gradient = normal_equations(M, pull, state.tangents())
        moved = state.retract(-relaxation * torch.linalg.solve_ex(normal, gradient)[0][..., 0])
        moved_F = moved.matrix()
        new = moved_F.mT.reshape(-1, 9, 1)
        # A step at the optimum, whose derivative is the optimum's, may raise the cost by rounding.
        lower = new.mT @ difference @ new <= e.mT @ pull + torch.finfo(M.dtype).eps
        state, F_mat = choose(lower, moved, state), torch.where(lower, moved_F, F_mat)
    return state


def geometric_scale(inliers: Tensor, dof: int, floor: Tensor | float, near: float | None = None) -> SquareScale:
    r"""Return the function from squared distances (B, S, N) to their squared scale (B, S, 1).

    It is the geometric mean over correspondences weighted by ``inliers`` (B, N), times :math:`n / (n - p)` of
    :math:`n = (\sum_i w_i)^2 / \sum_i w_i^2` effective correspondences, at least :math:`p + 1`, and ``dof`` parameters
    :math:`p`: a matrix that was fitted to few correspondences leaves distances that are too small. ``floor`` is added
    to the squared distances. With ``near``, the mean is computed twice, the second time with weights that fall off
    beyond ``near`` times the first: distant outliers with large weights would make it several times too large.
    """
    share = (inliers / safe_divisor(inliers.sum(1, keepdim=True)))[:, None]
    number = (1 / safe_divisor(share.square().sum(2, keepdim=True))).clamp(min=dof + 1.0)
    factor = number / (number - dof)

    def square_scale(squares: Tensor) -> Tensor:
        logs = (squares + floor).log_()
        mean = (logs @ share.mT).exp()
        if near is not None:
            close = share / (1 + squares / (near**2 * mean))
            mean = ((logs * close).sum(2, keepdim=True) / safe_divisor(close.sum(2, keepdim=True))).exp()
        return factor * mean

    return square_scale


def least_cost(M: Tensor, real: Tensor, losses: Tensor, weights: Tensor, number: int) -> Tensor:
    """Return the real matrices with the least weighted sums of losses (B, S, N), (B, number, 3, 3)."""
    cost = (losses @ weights.to(losses)[..., None])[..., 0]
    cost = torch.where(real & cost.isfinite(), cost, torch.inf)
    best = cost.topk(min(number, cost.shape[1]), 1, largest=False).indices
    return M.gather(1, best[..., None, None].expand(-1, -1, 3, 3))


def pick(state: Any, index: Tensor, number: int) -> Any:
    """Return one state for each set, at ``index`` (B,) among the ``number`` states of the set."""
    rows = index + number * torch.arange(index.shape[0], device=index.device)
    return type(state)(*[value[rows] for value in state])


def _normal_forms() -> Tensor:
    r"""Return the matrix (12, 81) from ``Evidence.products`` to :math:`B` of :math:`e^\top B e`.

    Of column-major entries :math:`e` of a matrix, the form is the sum of the squared norms of the normals of both lines
    and a small share of the squared norm of the matrix.
    """
    eye, flat = torch.eye(3, dtype=torch.float64), torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
    normals2 = torch.einsum("pa,qb,kl->pqakbl", eye, eye, flat)  # F_{1:2} x1
    normals1 = torch.einsum("ab,pk,ql->pqakbl", flat, eye, eye)  # (F^T)_{1:2} x2
    forms = torch.stack([normals2, normals1]).view(2, 3, 3, 81)
    forms[:, 2, 2] += NORMAL_FLOOR**2 / 2 * torch.eye(9, dtype=torch.float64).flatten()  # the third coordinate is one
    return torch.einsum("vpqx,pqs->vsx", forms, ENTRIES).flatten(0, 1)


_FORMS = _normal_forms()

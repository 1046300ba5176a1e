r"""Many minimal samples of eight correspondences, or of five with known cameras, at once and without derivatives.

:func:`~kornia_learnnorm.find_fundamental` with ``rank2="optimal"`` corrects the same null vectors in other coordinates.
Its matrices agree to second order in the correction, and have the same residuals in the median. It also serves more
points, weights, any normaliser and gradients, and takes several times as long.
"""

from __future__ import annotations

import torch
from kornia.geometry.epipolar import find_essential
from torch import Tensor

from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.matrices import cofactors

__all__ = ["are_independent", "solve_calibrated_samples", "solve_samples"]


def are_independent(A: Tensor, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
    r"""Return a mask of the non-degenerate minimal samples (K, S, 3), by their design matrices (K, M, 9).

    The constraints must be independent: each row of the design matrix is farther from the span of the rows before
    it than the least that a shift of the point moves it.
    """
    return _independent(torch.linalg.qr(A.mT, mode="r")[1], x1, x2, shift)


def solve_samples(x1: Tensor, x2: Tensor, shift: float) -> Tensor:
    r"""Return the matrices of minimal samples, solved exactly and corrected to rank 2 with their covariances.

    A QR factorisation of the transposed design matrix, :math:`A^\top = Q R`, tells which samples determine a matrix
    and gives both the null vector, which is the last column of :math:`Q`, and a factor of its covariance,
    :math:`V_0 = L L^\top` with :math:`L = Q_{:,1:8} R^{-\top} \mathrm{diag}(\sqrt{(u, V_i u)})`, see
    :func:`~kornia_learnnorm.geometry.rank2`, whose steps these are but that :math:`V_0` stays as it is.

    Args:
        x1: homogeneous points of view 1 with shape :math:`(K, 8, 3)`, pixels and a third coordinate as large.
        x2: their counterparts with shape :math:`(K, 8, 3)`.
        shift: of a point that must not make a sample undetermined, see :func:`are_independent`, pixels.

    Returns:
        matrices of unit norm of the samples that determine one, :math:`(M, 3, 3)`, :math:`M \le K`; of rank 2 up to
        the convergence of three steps.

    Reference:
        K. Kanatani, Y. Sugaya, Fundamental matrix computation: theory and practice, Memoirs of the Faculty of
        Engineering, Okayama University 42, 2008, on a posteriori correction.

    """
    Q, R = torch.linalg.qr(design_matrix(x1, x2).mT, mode="complete")
    determined = _independent(R, x1, x2, shift)
    if not bool(determined.all()):
        Q, R, x1, x2 = Q[determined], R[determined], x1[determined], x2[determined]
    L = Q[..., :8] @ torch.linalg.solve_triangular(
        R[..., :8, :].mT, torch.diag_embed(_deviation(Q[..., 8], x1, x2)), upper=False
    )
    # The samples come last: sums over nine entries are then sums of whole rows, which is what a processor likes.
    u, L = Q[..., 8].mT.contiguous(), L.movedim(0, -1).contiguous()
    for _ in range(3):
        gradient = cofactors(torch.unflatten(u, 0, (3, 3)).movedim(-1, 0)).flatten(1).mT
        change = (L * (L * gradient[:, None]).sum(0)).sum(1)
        u = u - (u * gradient).sum(0) / (3 * (change * gradient).sum(0)) * change
    F_mat: Tensor = torch.unflatten((u / torch.linalg.vector_norm(u, dim=0)).mT, 1, (3, 3))
    return F_mat


def solve_calibrated_samples(rays1: Tensor, rays2: Tensor) -> Tensor:
    r"""Return the essential matrices of minimal samples of five correspondences, by Kornia's five-point solver.

    Five points on one plane determine them too.

    Args:
        rays1: directions :math:`K_1^{-1} x_1` in the first camera with shape :math:`(K, 5, 3)`, any length.
        rays2: directions in the second camera with shape :math:`(K, 5, 3)`.

    Returns:
        all real solutions of all samples, of unit norm, :math:`(M, 3, 3)`, :math:`M \le 10 K`. Degenerate samples,
        such as those with a repeated correspondence, have none.

    Reference:
        D. Nister, An efficient solution to the five-point relative pose problem, TPAMI 2004.

    """
    E_mat: Tensor = find_essential(*(rays[..., :2] / rays[..., 2:] for rays in (rays1, rays2))).flatten(0, 1)
    return E_mat[E_mat.isfinite().flatten(1).all(1)]


def _deviation(u: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    r"""Return the deviations :math:`\sqrt{(u, V_i u)}` of the algebraic residuals of samples, (K, 8)."""
    F, (x1, x2) = torch.unflatten(u.mT, 0, (3, 3))[..., None], (x.movedim(-1, 0) for x in (x1, x2))
    line1, line2 = (F[:, :2] * x2[:, None]).sum(0), (F[:2] * x1).sum(1)
    return (line1.square_().sum(0) + line2.square_().sum(0)).sqrt_()


def _independent(R: Tensor, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
    distance = R.diagonal(dim1=-2, dim2=-1).abs().amin(-1)
    determined: Tensor = distance > shift * torch.minimum(x1[..., 2], x2[..., 2]).amin(-1)
    return determined

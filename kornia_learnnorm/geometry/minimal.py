"""Many minimal samples of eight correspondences at once, without derivatives.

:func:`~kornia_learnnorm.find_fundamental` with ``rank2="optimal"`` agrees to second order in the correction. It also
serves more points, weights, any normaliser and gradients, and takes several times as long.
"""

import torch
from torch import Tensor

from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.matrices import cofactors


def are_independent(R: Tensor, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
    """Return a mask of the non-degenerate minimal samples (K, S, 3), by the R of their transposed design matrices.

    The constraints must be independent: each row of the design matrix is farther from the span of the rows before
    it than the least that a shift of the point, in pixels, moves it.
    """
    distance = R.diagonal(dim1=-2, dim2=-1).abs().amin(-1)
    independent: Tensor = distance > shift * torch.minimum(x1[..., 2], x2[..., 2]).amin(-1)
    return independent


def solve_samples(x1: Tensor, x2: Tensor, shift: float) -> Tensor:
    r"""Return the matrices of minimal samples, solved exactly and corrected to rank 2 with their covariances.

    A QR factorisation of the transposed design matrix, :math:`A^\top = Q R`, tells which samples determine a matrix
    and gives both the null vector, which is the last column of :math:`Q`, and a factor of its covariance,
    :math:`V_0 = L L^\top` with :math:`L = Q_{:,1:8} R^{-\top} \mathrm{diag}(\sqrt{(u, V_i u)})`, see
    :func:`~kornia_learnnorm.optimal_rank2`, whose steps these are but that :math:`V_0` stays as it is.

    Samples are homogeneous points (K, 8, 3), pixels and a third coordinate as large; ``shift`` as for
    :func:`are_independent`. Matrices (M, 3, 3), M <= K, have unit norm and rank 2 up to the convergence of three steps.
    """
    Q, R = torch.linalg.qr(design_matrix(x1, x2).mT, mode="complete")
    determined = are_independent(R, x1, x2, shift)
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


def _deviation(u: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    r"""Return the deviations :math:`\sqrt{(u, V_i u)}` of the algebraic residuals of samples, (K, 8)."""
    F, (x1, x2) = torch.unflatten(u.mT, 0, (3, 3))[..., None], (x.movedim(-1, 0) for x in (x1, x2))
    line1, line2 = (F[:, :2] * x2[:, None]).sum(0), (F[:2] * x1).sum(1)
    return (line1.square_().sum(0) + line2.square_().sum(0)).sqrt_()

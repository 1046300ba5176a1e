"""The fundamental matrix of a known motion between known cameras."""

from __future__ import annotations

from kornia.geometry.epipolar import cross_product_matrix, fundamental_from_essential
from torch import Tensor

__all__ = ["fundamental_from_motion"]


def fundamental_from_motion(K1: Tensor, K2: Tensor, R: Tensor, t: Tensor) -> Tensor:
    r"""Return the fundamental matrix of a motion :math:`X_2 = R X_1 + t`.

    .. math:: F = K_2^{-\top} [t]_\times R K_1^{-1}, \quad \lVert F \rVert = 1, \quad x_2^\top F x_1 = 0

    Args:
        K1: camera matrices of the first view with shape :math:`(*, 3, 3)`, pixels.
        K2: camera matrices of the second view with shape :math:`(*, 3, 3)`, pixels.
        R: rotations with shape :math:`(*, 3, 3)`.
        t: translations with shape :math:`(*, 3)`, any unit.

    Returns:
        fundamental matrices with shape :math:`(*, 3, 3)`; NaN where :math:`t = 0`, a camera matrix is singular or an
        argument is NaN.

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision, 2nd edition, equations 9.2 and 9.12.

    Example:
        >>> import torch
        >>> fundamental_from_motion(torch.eye(3), torch.eye(3), torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        tensor([[ 0.0000,  0.0000,  0.0000],
                [ 0.0000,  0.0000,  0.7071],
                [ 0.0000, -0.7071,  0.0000]])

    """
    F_mat: Tensor = fundamental_from_essential(cross_product_matrix(t) @ R, K1, K2)
    scale: Tensor = F_mat.norm(dim=(-2, -1), keepdim=True)
    return F_mat / scale

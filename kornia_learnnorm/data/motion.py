"""The fundamental matrix of a known motion between known cameras."""

from __future__ import annotations

from kornia.geometry.epipolar import cross_product_matrix, fundamental_from_essential
from torch import Tensor


def fundamental_from_motion(K1: Tensor, K2: Tensor, R: Tensor, t: Tensor) -> Tensor:
    r"""Return :math:`F = K_2^{-\top} [t]_\times R K_1^{-1}` of unit norm, (*, 3, 3); NaN where t is zero or NaN."""
    F_mat: Tensor = fundamental_from_essential(cross_product_matrix(t) @ R, K1, K2)
    scale: Tensor = F_mat.norm(dim=(-2, -1), keepdim=True)
    return F_mat / scale

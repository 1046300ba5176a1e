r"""The relative pose of two cameras from a fundamental matrix.

A pose is :math:`X_2 = R X_1 + t` for points in space; the length of :math:`t` is unknown.
"""

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import essential_from_fundamental, motion_from_essential
from torch import Tensor

from kornia_learnnorm.geometry import checks


def relative_pose(
    F_mat: Tensor, K1: Tensor, K2: Tensor, points1: Tensor, points2: Tensor, mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    r"""Return the relative pose, :math:`X_2 = R X_1 + t`, of a fundamental matrix and known cameras.

    :math:`E = K_2^\top F K_1` has four poses; the one with most correspondences in front of both cameras is returned.

    Args:
        F_mat: fundamental matrices with shape :math:`(B, 3, 3)`, any scale.
        K1: cameras of the first images with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
        K2: cameras of the second images with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
        points1: pixels in the first images with shape :math:`(B, N, 2)`.
        points2: pixels in the second images with shape :math:`(B, N, 2)`.
        mask: true for the correspondences that vote, such as inliers, boolean with shape :math:`(B, N)`; default: all.

    Returns:
        rotations with shape :math:`(B, 3, 3)` and unit translations with shape :math:`(B, 3)`, solved in float64 where
        the device has it, in the dtype of ``F_mat``. Both are NaN where ``F_mat`` is not finite or of rank below two,
        or where two poses tie for the most votes.

        Do not backpropagate through it: gradients are NaN where E has two equal singular values, as an exact E has. Use
        :class:`~kornia_learnnorm.LearnedRelativePose` for a loss of the pose.

    Raises:
        TypeError: if the points are not float32 or float64 of one dtype, a matrix or camera is not floating-point, or
            the mask is not boolean.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up, the batches differ, the mask does not fit the points, or a camera is
            not finite and invertible with a last row of (0, 0, w > 0).

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision, 2004, section 9.6.

    Example:
        >>> from kornia_learnnorm.data.synthetic import handheld
        >>> scene = handheld(2, 20, torch.Generator().manual_seed(0))
        >>> R, t = relative_pose(scene.F_mat, scene.K1, scene.K2, scene.points1, scene.points2)
        >>> bool((R - scene.R).abs().max() < 1e-6)
        True
    """
    checks.check_pairs(points1, points2, ["B", "N", "2"])
    checks.check_number_of_matrices("F_mat", F_mat, len(points1))
    checks.check_cameras(K1, K2, len(F_mat))
    K1, K2 = (K.expand(len(F_mat), 3, 3) for K in (K1, K2))
    if mask is not None:
        checks.check_mask(mask, points1, points2)
    dtype, work = F_mat.dtype, checks.solve_dtype(F_mat.device)
    F_mat, K1, K2, points1, points2 = (value.to(work) for value in (F_mat, K1, K2, points1, points2))
    E_mat = essential_from_fundamental(F_mat, K1, K2)
    E_mat = torch.where(E_mat.isfinite().all(-1, keepdim=True).all(-2, keepdim=True), E_mat, 0.0)
    R, t = motion_from_essential(E_mat)
    t = t[..., 0]
    front = in_front(R, t, K1, K2, points1, points2)
    votes = (front if mask is None else front & mask[:, None]).sum(-1)
    first, second = votes.topk(2).values.unbind(-1)
    known = (first > second) & (torch.linalg.matrix_rank(E_mat, rtol=8 * torch.finfo(dtype).eps) >= 2)
    row, best = torch.arange(len(R), device=R.device), votes.argmax(-1)
    R = torch.where(known[:, None, None], R[row, best], torch.nan)
    return R.to(dtype), torch.where(known[:, None], t[row, best], torch.nan).to(dtype)


def choose_pose(
    R: Tensor, t: Tensor, points1: Tensor, points2: Tensor, K1: Tensor, K2: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the poses (B, 3, 3) and (B, 3), of several (B, S, 3, 3) and (B, S, 3), with most weight in front."""
    with torch.no_grad():
        best = (in_front(R, t, K1, K2, points1, points2) * weights[:, None]).sum(-1).argmax(1)[:, None, None]
    return R.gather(1, best[..., None].expand(-1, 1, 3, 3))[:, 0], t.gather(1, best.expand(-1, 1, 3))[:, 0]


def in_front(R: Tensor, t: Tensor, K1: Tensor, K2: Tensor, points1: Tensor, points2: Tensor) -> Tensor:
    """Return which correspondences poses put in front of both cameras, (B, S, N) bool; false where a pose is NaN.

    Poses :math:`X_2 = R X_1 + t` are (B, S, 3, 3) and (B, S, 3) of any length, points pixels (B, N, 2). The depths are
    those of z2 x2 = z1 R x1 + t: the cross product with one ray leaves the other's depth.
    """
    views = (K1, points1), (K2, points2)
    rays1, rays2 = (torch.linalg.solve(K, convert_points_to_homogeneous(points).mT).mT[:, None] for K, points in views)
    turned, t = rays1 @ R.mT, t[..., None, :]
    normal = torch.linalg.cross(rays2, turned)
    depth1 = (torch.linalg.cross(t, rays2) * normal).sum(-1)  # times the squared length of the normal
    depth2 = (torch.linalg.cross(t, turned) * normal).sum(-1)
    return torch.logical_and(depth1 > 0, depth2 > 0)

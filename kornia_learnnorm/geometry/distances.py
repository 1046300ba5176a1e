r"""Epipolar distances of correspondences under a fundamental matrix, and the norms of their lines' normals.

Distances take pixels ``points1, points2`` :math:`(*, N, 2)` and ``F_mat`` :math:`(*, 3, 3)` with
:math:`x_2^\top F x_1 = 0`. A distance scale is the factor from the algebraic residual :math:`x_2^\top F x_1` to a
distance in pixels, a function of the squared norms :math:`n_1 = \|(F^\top x_2)_{1:2}\|^2` and
:math:`n_2 = \|(F x_1)_{1:2}\|^2` of the epipolar lines' normals. It returns its value and its derivatives by both.
"""

from collections.abc import Callable
from typing import Literal

import torch
from kornia.geometry import epipolar
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.homography import symmetric_transfer_error
from torch import Tensor

from kornia_learnnorm.geometry.checks import check_tensor, safe_divisor, weighted_mean, without_autocast

EPIPOLE_TOLERANCE = 1e-12  # length of an epipolar line's normal over that of its summands; less is rounding


def _check(points1: Tensor, points2: Tensor, M: Tensor, name: str = "F_mat") -> None:
    check_tensor("points1", points1, ["*", "N", "2"], precise=True)
    check_tensor("points2", points2, ["*", "N", "2"], precise=True)
    check_tensor(name, M, ["*", "3", "3"], precise=True)
    if not points1.dtype == points2.dtype == M.dtype:
        raise TypeError(f"one dtype is needed, got {points1.dtype}, {points2.dtype} and {M.dtype}")
    if points1.shape[-2] != points2.shape[-2]:
        raise ValueError(f"points1 and points2 must pair up, got shapes {[*points1.shape]} and {[*points2.shape]}")
    try:
        torch.broadcast_shapes(points1.shape[:-2], points2.shape[:-2], M.shape[:-2])  # type: ignore[no-untyped-call]
    except RuntimeError:
        shapes = " and ".join(str([*value.shape]) for value in (points1, points2, M))
        raise ValueError(f"points and {name} must be of one batch, got shapes {shapes}") from None


def symmetric_epipolar_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    r"""Return the sum of the distances of both points to their epipolar lines (Fan et al., Eq. 8).

    :math:`|x_2^\top F x_1| \left( 1 / \|(F^\top x_2)_{1:2}\| + 1 / \|(F x_1)_{1:2}\| \right)`. It is not
    ``kornia.geometry.epipolar.symmetrical_epipolar_distance``, which adds the squares.

    Args:
        points1: pixels in the first image with shape :math:`(*, N, 2)`.
        points2: pixels in the second image with shape :math:`(*, N, 2)`.
        F_mat: fundamental matrices with shape :math:`(*, 3, 3)`, any scale.

    Returns:
        distances in pixels with shape :math:`(*, N)`; infinite for a point on an epipole (up to rounding in float64),
        where the residual and the normal of the epipolar line both vanish.

    Raises:
        TypeError: if an argument is not a float32 or float64 tensor, or their dtypes differ.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # lines are rows
        >>> symmetric_epipolar_distance(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 3.0]]]), F_mat)
        tensor([[4.]])
    """
    _check(points1, points2, F_mat)
    with without_autocast(points1):
        right = epipolar.left_to_right_epipolar_distance(points1, points2, F_mat)
        distance = right + epipolar.right_to_left_epipolar_distance(points1, points2, F_mat)
        return torch.where(_on_epipole(points1, F_mat) | _on_epipole(points2, F_mat.mT), torch.inf, distance)


@torch.no_grad()
def _on_epipole(points: Tensor, F_mat: Tensor) -> Tensor:
    """Return which points :math:`(*, N, 2)` have no epipolar line :math:`F x` but for rounding."""
    x = convert_points_to_homogeneous(points)
    normal, summands = (x @ F_mat.mT)[..., :2], (x.abs() @ F_mat.abs().mT)[..., :2]
    return torch.le(normal.norm(dim=-1), EPIPOLE_TOLERANCE * summands.norm(dim=-1))


def sampson_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    r"""Return the Sampson distance in pixels, the first-order distance to the nearest exact correspondence.

    :math:`|x_2^\top F x_1| / \sqrt{\|(F x_1)_{1:2}\|^2 + \|(F^\top x_2)_{1:2}\|^2}` (Hartley and Zisserman, section
    11.4.3; not squared). Arguments, shapes and errors are those of :func:`symmetric_epipolar_distance`.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> sampson_distance(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 3.0]]]), F_mat)
        tensor([[1.4142]])
    """
    _check(points1, points2, F_mat)
    with without_autocast(points1):
        return epipolar.sampson_epipolar_distance(points1, points2, F_mat, squared=False)


def algebraic_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    r"""Return :math:`|x_2^\top F x_1|` with :math:`F` scaled to unit Frobenius norm.

    Arguments and errors are those of :func:`symmetric_epipolar_distance`; a zero matrix gives NaN.

    Returns:
        algebraic residuals with shape :math:`(*, N)`; their unit depends on the coordinates of the points.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> algebraic_distance(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 3.0]]]), F_mat)
        tensor([[1.4142]])
    """
    _check(points1, points2, F_mat)
    F_mat = F_mat / F_mat.norm(dim=(-2, -1), keepdim=True)
    x1, x2 = convert_points_to_homogeneous(points1), convert_points_to_homogeneous(points2)
    with without_autocast(points1):
        return torch.einsum("...ni,...ij,...nj->...n", x2, F_mat, x1).abs()


def transfer_distance(points1: Tensor, points2: Tensor, H_mat: Tensor) -> Tensor:
    r"""Return the root of the sum of both squared transfer errors, of :math:`H x_1` and of :math:`H^{-1} x_2`.

    Errors are those of :func:`symmetric_epipolar_distance`.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)` or :math:`(N, 2)`.
        points2: pixels in the second image with the same shape.
        H_mat: homographies with shape :math:`(B, 3, 3)` or :math:`(3, 3)`, any scale.

    Returns:
        distances in pixels with shape :math:`(B, N)` or :math:`(N,)`; the largest number of the dtype under a singular
        matrix, NaN where a point or the matrix has one.

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, Eq. 4.7.

    Example:
        >>> H_mat = torch.diag(torch.tensor([2.0, 2.0, 1.0]))[None]
        >>> transfer_distance(torch.tensor([[[1.0, 0.0]]]), torch.tensor([[[4.0, 0.0]]]), H_mat)
        tensor([[2.2361]])
    """
    _check(points1, points2, H_mat, "H_mat")
    single = points1.ndim == H_mat.ndim == 2
    if H_mat.ndim == 2:
        points1, points2 = (points.reshape(-1, *points.shape[-2:]) for points in (points1, points2))
        H_mat = H_mat.expand(len(points1), 3, 3)
    with without_autocast(points1):
        distance: Tensor = symmetric_transfer_error(points1, points2, H_mat, squared=False)
    unknown = (points1.isnan() | points2.isnan()).any(-1) | H_mat.isnan().flatten(-2).any(-1, keepdim=True)
    distance = distance.masked_fill(unknown, torch.nan)  # Kornia replaces NaN by the distance under a singular matrix
    return distance[0] if single else distance


def line_norms(
    x1: Tensor, x2: Tensor, F_mat: Tensor, weights: Tensor | None = None, floor: float = 1e-3
) -> tuple[Tensor, Tensor]:
    r"""Return the norms of both epipolar lines' normals, :math:`\|(F^\top x_2)_{1:2}\|` and :math:`\|(F x_1)_{1:2}\|`.

    Points are homogeneous, :math:`(*, 3, N)`, optional weights and norms :math:`(*, N)`. ``floor`` times the set's mean
    norm is added to each, against points on an epipole.
    """
    norm1, norm2 = (F_mat.mT[..., :2, :] @ x2).norm(dim=-2), (F_mat[..., :2, :] @ x1).norm(dim=-2)
    floor1 = floor * safe_divisor(weighted_mean(norm1[..., None], weights))
    return norm1 + floor1, norm2 + floor * safe_divisor(weighted_mean(norm2[..., None], weights))


def sampson_scale(sq_norm1: Tensor, sq_norm2: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
    """Return the scale of the Sampson distance, :math:`(n_1 + n_2)^{-1/2}`, and with ``slopes`` its derivatives."""
    total = sq_norm1 + sq_norm2
    scale = total.rsqrt()
    if not slopes:
        return (scale,)
    slope = scale / (-2 * total)
    return scale, slope, slope


def symmetric_scale(sq_norm1: Tensor, sq_norm2: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
    """Return the scale of the symmetric distance, :math:`n_1^{-1/2} + n_2^{-1/2}`; with ``slopes`` its derivatives."""
    first, second = sq_norm1.rsqrt(), sq_norm2.rsqrt()
    if not slopes:
        return (first + second,)
    return first + second, -first / (2 * sq_norm1), -second / (2 * sq_norm2)


Distance = Literal["sampson", "symmetric"]
DistanceScale = Callable[[Tensor, Tensor], tuple[Tensor, ...]]
DISTANCE_SCALES = {"sampson": sampson_scale, "symmetric": symmetric_scale}

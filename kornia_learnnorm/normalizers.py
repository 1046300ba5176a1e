r"""Normalisers: modules that choose the coordinates in which the fundamental matrix is solved and projected.

The one contract of this package is ``(points1, points2, weights=None) -> (T1, T2)``: pixels :math:`(B, N, 2)` of both
views and optional weights :math:`(B, N)` go in, two affine transforms :math:`(B, 3, 3)` come out. Anything that keeps
it can be given to :func:`kornia_learnnorm.find_fundamental`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor, nn

__all__ = [
    "Hartley",
    "Identity",
    "PerView",
    "Whitening",
    "affine_transform",
    "check_correspondences",
    "paper_transform",
    "solve_dtype",
    "spd_transform",
    "transform_fundamental",
    "weighted_mean",
]


def solve_dtype(device: torch.device) -> torch.dtype:
    """Return the dtype of the small linear algebra: float64, except on MPS, which has none."""
    return torch.float32 if device.type == "mps" else torch.float64


def check_correspondences(points1: Tensor, points2: Tensor, weights: Tensor | None = None, at_least: int = 8) -> None:
    """Raise a clear error for anything but finite correspondences ``(B, N, 2)`` x 2 and weights ``(B, N)``.

    Raises:
        TypeError: if the points are not floating-point tensors of one dtype, or the weights not floating-point.
        ShapeError: if a shape is wrong.
        ValueError: if shapes of the views differ, there are too few correspondences, a value is not finite, or a
            weight is negative.

    """
    for name, points in (("points1", points1), ("points2", points2)):
        if not isinstance(points, Tensor) or points.dtype not in (torch.float32, torch.float64):
            got = points.dtype if isinstance(points, Tensor) else type(points)
            raise TypeError(f"{name} must be a float32 or float64 tensor, got {got}")
        KORNIA_CHECK_SHAPE(points, ["B", "N", "2"])
    if points1.dtype != points2.dtype:
        raise TypeError(f"points1 and points2 must have one dtype, got {points1.dtype} and {points2.dtype}")
    if points1.shape != points2.shape:
        raise ValueError(f"points1 and points2 must pair up, got shapes {[*points1.shape]} and {[*points2.shape]}")
    if points1.shape[1] < at_least:
        raise ValueError(f"at least {at_least} correspondences are needed, got {points1.shape[1]}")
    finite = [points1, points2]
    if weights is not None:
        if not isinstance(weights, Tensor) or not weights.is_floating_point():
            raise TypeError(f"weights must be a floating-point tensor, got {getattr(weights, 'dtype', type(weights))}")
        if weights.shape != points1.shape[:2]:
            raise ValueError(f"weights must have shape {[*points1.shape[:2]]}, got {[*weights.shape]}")
        finite.append(weights)
    if torch.compiler.is_compiling():
        return
    for name, values in zip(("points1", "points2", "weights"), finite, strict=False):
        bad = int((~torch.isfinite(values)).sum())
        if bad:
            raise ValueError(f"{name} must be finite, got {bad} NaN or infinite values")
    if weights is not None and bool((weights < 0).any()):
        raise ValueError(f"weights must not be negative, got a minimum of {weights.min().item():g}")


def affine_transform(linear: Tensor, origin: Tensor) -> Tensor:
    r"""Build the transform that moves ``origin`` to zero and then applies ``linear``.

    Args:
        linear: matrices with shape :math:`(*, 2, 2)`.
        origin: points with shape :math:`(*, 2)`.

    Returns:
        homogeneous transforms with shape :math:`(*, 3, 3)`.

    Example:
        >>> affine_transform(2 * torch.eye(2), torch.tensor([3.0, 4.0]))
        tensor([[ 2.,  0., -6.],
                [ 0.,  2., -8.],
                [ 0.,  0.,  1.]])

    """
    KORNIA_CHECK_SHAPE(linear, ["*", "2", "2"])
    KORNIA_CHECK_SHAPE(origin, ["*", "2"])
    top = torch.cat([linear, -linear @ origin[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 2] = 1
    return torch.cat([top, bottom], -2)


def transform_fundamental(F_mat: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
    r"""Return :math:`T_2^\top F T_1`: a fundamental matrix of transformed points, brought back to the points.

    Args:
        F_mat: fundamental matrices of the transformed points with shape :math:`(*, 3, 3)`.
        T1: transforms of the first view with shape :math:`(*, 3, 3)`.
        T2: transforms of the second view with shape :math:`(*, 3, 3)`.

    Returns:
        fundamental matrices with shape :math:`(*, 3, 3)`.

    """
    return T2.mT @ F_mat @ T1


def paper_transform(params: Tensor, origin: Tensor) -> Tensor:
    r"""Build the paper's transform :math:`T_L = \mathrm{diag}(\alpha_1, \alpha_2, 1)\, R(\theta)\, C(o)`.

    Args:
        params: :math:`(\log\alpha_1, \log\alpha_2, \theta)` with shape :math:`(*, 3)`; zero gives :math:`C(o)`.
        origin: the points :math:`o` moved to zero, with shape :math:`(*, 2)`.

    Returns:
        transforms with shape :math:`(*, 3, 3)`.

    Reference:
        Fan et al., section 4, the equation of :math:`T_L`.

    Example:
        >>> paper_transform(torch.tensor([math.log(2.0), 0.0, 0.0]), torch.zeros(2))
        tensor([[2., -0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])

    """
    KORNIA_CHECK_SHAPE(params, ["*", "3"])
    alpha, (c, s) = params[..., :2].exp(), (params[..., 2].cos(), params[..., 2].sin())
    rotation = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    return affine_transform(alpha[..., None] * rotation, origin)


def spd_transform(params: Tensor) -> Tensor:
    r"""Build a transform with a symmetric positive definite linear part from its matrix logarithm.

    With five parameters the transform reaches every metric :math:`T^\top T` of the homogeneous plane up to scale; with
    three it keeps the origin. Unlike :math:`T_L` it has no rotation, which would leave :math:`F` unchanged.

    Args:
        params: :math:`(a, b, c)` or :math:`(a, b, c, o_1, o_2)` with shape :math:`(*, 3)` or :math:`(*, 5)`; the linear
            part is :math:`\exp [[a, b], [b, c]]` and :math:`o` the point moved to zero. Zero gives the identity.

    Returns:
        transforms with shape :math:`(*, 3, 3)`.

    Raises:
        ValueError: if there are not three or five parameters.

    Example:
        >>> spd_transform(torch.zeros(5))
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])

    """
    if params.shape[-1] not in (3, 5):
        raise ValueError(f"an SPD transform has 3 or 5 parameters a view, got shape {[*params.shape]}")
    a, b, c = params[..., :3].unbind(-1)
    mean, half = (a + c) / 2, (a - c) / 2
    square = half.square() + b.square()
    # exp of a traceless symmetric 2x2 matrix S with S^2 = d^2 I is cosh(d) I + sinh(d) / d S. Both are smooth in d^2,
    # sqrt is not at zero: there the series takes over.
    small = square < 1e-4
    d = torch.where(small, 1.0, square).sqrt()
    cosh = torch.where(small, 1 + square / 2 + square.square() / 24, d.cosh())
    sinhc = torch.where(small, 1 + square / 6 + square.square() / 120, d.sinh() / d)
    scale = mean.exp()
    row1 = torch.stack([scale * (cosh + sinhc * half), scale * sinhc * b], -1)
    row2 = torch.stack([scale * sinhc * b, scale * (cosh - sinhc * half)], -1)
    origin = params[..., 3:] if params.shape[-1] == 5 else torch.zeros_like(params[..., :2])
    return affine_transform(torch.stack([row1, row2], -2), origin)


def weighted_mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """Average over the points ``(B, N, C) -> (B, C)``; weights that sum to zero count as equal."""
    if weights is None:
        return values.mean(-2)
    total = weights.sum(-1, keepdim=True)
    empty = total <= 0
    weights = torch.where(empty, 1.0, weights)
    return (weights[..., None] * values).sum(-2) / torch.where(empty, weights.shape[-1], total)


def _rounding(origin: Tensor) -> Tensor:
    """Spread ``(B,)`` about ``origin`` up to which points coincide: a mean is not exact."""
    size: Tensor = torch.linalg.vector_norm(origin.detach(), dim=-1)
    return 16 * torch.finfo(origin.dtype).eps * size


class Identity(nn.Module):
    """No normalisation: both transforms are the identity (the original eight-point algorithm, in pixels).

    Example:
        >>> T1, T2 = Identity()(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1[0]
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])

    """

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return identities with shape :math:`(B, 3, 3)`."""
        eye = torch.eye(3, dtype=points1.dtype, device=points1.device).expand(points1.shape[0], 3, 3)
        return eye, eye


class PerView(nn.Module):
    """Adapt a per-view callable, such as ``kornia.geometry.epipolar.normalize_points``, to the contract.

    Args:
        normalize: maps points :math:`(B, N, 2)` (and ``weights=``, where weights are given) to a pair whose second
            element is the transform :math:`(B, 3, 3)`.

    Example:
        >>> from kornia.geometry.epipolar import normalize_points
        >>> T1, T2 = PerView(normalize_points)(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1.shape
        torch.Size([2, 3, 3])

    """

    def __init__(self, normalize: Callable[..., tuple[Tensor, Tensor]]) -> None:
        super().__init__()
        self.normalize = normalize

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the callable's transforms of both views."""
        kwargs = {} if weights is None else {"weights": weights}
        return self.normalize(points1, **kwargs)[1], self.normalize(points2, **kwargs)[1]


class Hartley(nn.Module):
    r"""Hartley's normalisation: centroid to the origin, mean distance from it :math:`\sqrt 2` (Fan et al., Eq. 4).

    Coincident points keep their scale.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]])
        >>> Hartley()(points, points)[0]
        tensor([[[ 0.5000,  0.0000, -1.0000],
                 [ 0.0000,  0.5000, -1.0000],
                 [ 0.0000,  0.0000,  1.0000]]])

    """

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return self._transform(points1, weights), self._transform(points2, weights)

    @staticmethod
    def _transform(points: Tensor, weights: Tensor | None) -> Tensor:
        origin = weighted_mean(points, weights)
        radius = weighted_mean((points - origin[:, None]).norm(dim=-1, keepdim=True), weights)[..., 0]
        scale = math.sqrt(2) / torch.where(radius > _rounding(origin), radius, math.sqrt(2))
        return affine_transform(scale[:, None, None] * torch.eye(2).to(points), origin)


class Whitening(nn.Module):
    r"""Symmetric (ZCA) whitening: centroid to the origin, covariance of each view to the identity.

    :math:`T = [\Sigma^{-1/2}, -\Sigma^{-1/2} o; 0, 1]`, in closed form. Where the points are nearly collinear, the
    smaller eigenvalue of :math:`\Sigma` is floored.

    Args:
        floor: smallest ratio of the eigenvalues of :math:`\Sigma`.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 2.0], [4.0, 2.0]]])
        >>> Whitening()(points, points)[0][0].diagonal()
        tensor([0.5000, 1.0000, 1.0000])

    """

    def __init__(self, floor: float = 1e-6) -> None:
        super().__init__()
        self.floor = floor

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return self._transform(points1, weights), self._transform(points2, weights)

    def _transform(self, points: Tensor, weights: Tensor | None) -> Tensor:
        dtype = solve_dtype(points.device)
        x, w = points.to(dtype), None if weights is None else weights.to(dtype)
        origin = weighted_mean(x, w)
        centred = x - origin[:, None]
        covariance = torch.unflatten(
            weighted_mean((centred[..., :, None] * centred[..., None, :]).flatten(-2), w), -1, (2, 2)
        )
        spread = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        covariance = torch.where((spread > _rounding(origin))[:, None, None], covariance, 0.0)
        return affine_transform(inverse_sqrt(covariance, self.floor), origin).to(points.dtype)


def inverse_sqrt(covariance: Tensor, floor: float = 1e-6) -> Tensor:
    r"""Return :math:`\Sigma^{-1/2}` of symmetric matrices :math:`(*, 2, 2)`, the identity where :math:`\Sigma = 0`.

    :math:`(\mathrm{adj}\,\Sigma + s I) / (s \sqrt{\mathrm{tr}\,\Sigma + 2 s})` with :math:`s^2 = \det\Sigma`: no
    eigenvectors, so smooth where the eigenvalues meet.
    """
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    trace = a + c
    empty = trace <= 0
    # Both eigenvalues are raised together by what the smaller one lacks; it changes the larger by less than `floor`.
    spread = ((a - c) / 2).square() + b.square()
    flat = spread <= 0
    largest = trace / 2 + torch.where(flat, 0.0, torch.where(flat, 1.0, spread).sqrt())
    largest = torch.where(empty, 1.0, largest)
    lift = torch.relu(floor * largest - (a * c - b.square()) / largest)
    a, c = torch.where(empty, 1.0, a + lift), torch.where(empty, 1.0, c + lift)
    b = torch.where(empty, 0.0, b)
    s = (a * c - b.square()).sqrt()
    adjugate_plus = torch.stack([torch.stack([c + s, -b], -1), torch.stack([-b, a + s], -1)], -2)
    return adjugate_plus / (s * (a + c + 2 * s).sqrt())[..., None, None]

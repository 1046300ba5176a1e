r"""Normalising transforms of the plane, their builders, and how points and fundamental matrices follow them."""

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor

__all__ = ["affine_transform", "inverse_sqrt", "paper_transform", "spd_transform", "transform_fundamental"]
__all__ += ["transform_points", "whitening_from_moments"]


def affine_transform(linear: Tensor, origin: Tensor) -> Tensor:
    r"""Build the transform that moves ``origin`` to zero and then applies ``linear``."""
    KORNIA_CHECK_SHAPE(linear, ["*", "2", "2"])
    KORNIA_CHECK_SHAPE(origin, ["*", "2"])
    top = torch.cat([linear, -linear @ origin[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 2] = 1
    return torch.cat([top, bottom], -2)


def transform_fundamental(F_mat: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
    r"""Return :math:`T_2^\top F T_1`: a fundamental matrix of transformed points, brought back to the points."""
    return T2.mT @ F_mat @ T1


def transform_points(points: Tensor, T: Tensor) -> Tensor:
    """Return points :math:`(*, N, 2)` after affine transforms :math:`(*, 3, 3)`."""
    return points @ T[..., :2, :2].mT + T[..., None, :2, 2]


def whitening_from_moments(mean: Tensor, covariance: Tensor, floor: float = 1e-6) -> Tensor:
    r"""Return whitening transforms :math:`(*, 3, 3)`, from means :math:`(*, 2)` and covariances :math:`(*, 2, 2)`.

    The ratio of the covariance's eigenvalues is at least ``floor``; coincident points keep their scale.
    """
    spread = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    # What rounding leaves of coincident points.
    rounding = 16 * torch.finfo(mean.dtype).eps * torch.linalg.vector_norm(mean.detach(), dim=-1)
    covariance = torch.where((spread > rounding)[..., None, None], covariance, 0.0)
    return affine_transform(inverse_sqrt(covariance, floor), mean)


def paper_transform(params: Tensor) -> Tensor:
    r"""Build the paper's transform, of centred points: :math:`\mathrm{diag}(\alpha_1, \alpha_2, 1)\, R(\theta)`.

    Args:
        params: :math:`(\log\alpha_1, \log\alpha_2, \theta)` with shape :math:`(*, 3)`; zero gives the identity.

    Returns:
        transforms with shape :math:`(*, 3, 3)`.

    Reference:
        Fan et al., section 4, the equation of :math:`T_L`.

    Example:
        >>> paper_transform(torch.tensor([0.6931472, 0.0, 0.0]))
        tensor([[2., -0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])
    """
    KORNIA_CHECK_SHAPE(params, ["*", "3"])
    alpha, (c, s) = params[..., :2].exp(), (params[..., 2].cos(), params[..., 2].sin())
    rotation = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    return affine_transform(alpha[..., None] * rotation, torch.zeros_like(params[..., :2]))


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
    xx, xy, yy = scale * (cosh + sinhc * half), scale * sinhc * b, scale * (cosh - sinhc * half)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    ox, oy = params[..., 3:].unbind(-1) if params.shape[-1] == 5 else (zero, zero)
    shift_x, shift_y = zero - xx * ox - xy * oy, zero - xy * ox - yy * oy
    return torch.unflatten(torch.stack([xx, xy, shift_x, xy, yy, shift_y, zero, zero, one], -1), -1, (3, 3))


def inverse_sqrt(covariance: Tensor, floor: float = 1e-6) -> Tensor:
    r"""Return :math:`\Sigma^{-1/2}` of symmetric matrices :math:`(*, 2, 2)`, the identity where :math:`\Sigma = 0`.

    :math:`(\mathrm{adj}\,\Sigma + s I) / (s \sqrt{\mathrm{tr}\,\Sigma + 2 s})` with :math:`s^2 = \det\Sigma`: no
    eigenvectors, so smooth where the eigenvalues meet.
    """
    a, b, _, c = covariance.flatten(-2).unbind(-1)
    empty = a + c == 0
    a, c = a + empty, c + empty
    # Both eigenvalues are raised together by what the smaller one lacks; it changes the larger by less than `floor`.
    spread = ((a - c) / 2).square() + b.square()
    round_ = spread == 0
    largest = (a + c) / 2 + (spread + round_).sqrt() * ~round_  # the root of zero has no derivative
    lift = torch.relu(floor * largest - (a * c - b.square()) / largest)
    a, c = a + lift, c + lift
    s = (a * c - b.square()).sqrt()
    scale = s * (a + c + 2 * s).sqrt()
    return torch.unflatten(torch.stack([c + s, -b, -b, a + s], -1) / scale[..., None], -1, (2, 2))

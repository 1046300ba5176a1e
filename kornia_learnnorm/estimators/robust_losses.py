r"""What a refinement minimises: the distance that is squared, and the robust loss of its squares.

A distance of a correspondence to its epipolar lines is the algebraic residual :math:`x_2^\top F x_1` times a factor of
the squared norms :math:`n_1 = \|(F^\top x_2)_{1:2}\|^2` and :math:`n_2 = \|(F x_1)_{1:2}\|^2` of the lines' normals. A
factor returns its value and its derivatives by both; a loss returns its value and its derivative by the squared
distance, which is the weight of iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

import torch
from torch import Tensor

__all__ = [
    "Cauchy",
    "GemanMcClure",
    "Huber",
    "Truncated",
    "factor_alone",
    "sampson_factor",
    "squared_loss",
    "symmetric_factor",
]

Factor = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
Loss = Callable[[Tensor], tuple[Tensor, Tensor]]


def sampson_factor(normal1: Tensor, normal2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return the factor of the Sampson distance, :math:`(n_1 + n_2)^{-1/2}`.

    Args:
        normal1: squared norms of the normals of view 1's epipolar lines with shape :math:`(*, N)`, positive.
        normal2: the same in view 2.

    Returns:
        the factor and its derivatives by ``normal1`` and by ``normal2``, each with shape :math:`(*, N)`.

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, section 11.4.3.

    Example:
        >>> sampson_factor(torch.tensor(2.0), torch.tensor(2.0))
        (tensor(0.5000), tensor(-0.0625), tensor(-0.0625))

    """
    total = normal1 + normal2
    factor = total.rsqrt()
    slope = factor / (-2 * total)
    return factor, slope, slope


def symmetric_factor(normal1: Tensor, normal2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return the factor of the symmetric epipolar distance (Fan et al., Eq. 7), :math:`n_1^{-1/2} + n_2^{-1/2}`.

    Args:
        normal1: squared norms of the normals of view 1's epipolar lines with shape :math:`(*, N)`, positive.
        normal2: the same in view 2.

    Returns:
        the factor and its derivatives by ``normal1`` and by ``normal2``, each with shape :math:`(*, N)`.

    Example:
        >>> symmetric_factor(torch.tensor(4.0), torch.tensor(4.0))
        (tensor(1.), tensor(-0.0625), tensor(-0.0625))

    """
    first, second = normal1.rsqrt(), normal2.rsqrt()
    return first + second, -first / (2 * normal1), -second / (2 * normal2)


def squared_loss(squares: Tensor) -> tuple[Tensor, Tensor]:
    """Return the squared distances themselves, each with weight 1: least squares.

    Example:
        >>> squared_loss(torch.tensor([4.0]))
        (tensor([4.]), tensor([1.]))

    """
    return squares, torch.ones_like(squares)


def factor_alone(factor: Factor, normal1: Tensor, normal2: Tensor) -> Tensor:
    """Return the factor without its derivatives, which cost more than the factor itself.

    Args:
        factor: from algebraic residuals to distances.
        normal1: squared norms of the normals of view 1's epipolar lines with shape :math:`(*, N)`, positive.
        normal2: the same in view 2.

    Example:
        >>> factor_alone(sampson_factor, torch.tensor(2.0), torch.tensor(2.0))
        tensor(0.5000)

    """
    return (normal1 + normal2).rsqrt() if factor is sampson_factor else factor(normal1, normal2)[0]


@dataclass(frozen=True)
class _RobustLoss:
    scale: float = 1.0

    def __post_init__(self) -> None:
        scale: object = self.scale
        if not isinstance(scale, Real):
            raise TypeError(f"scale must be a number of pixels, got {scale!r}")
        if not self.scale > 0:
            raise ValueError(f"scale must be positive, got {self.scale}")


class Huber(_RobustLoss):
    r"""Huber's loss of squared distances :math:`s`: :math:`s` up to :math:`c^2`, :math:`2 c \sqrt s - c^2` beyond.

    Args:
        scale: :math:`c` in pixels.

    Raises:
        ValueError: if the scale is not positive.

    Example:
        >>> Huber(1.0)(torch.tensor([0.25, 4.0]))
        (tensor([0.2500, 3.0000]), tensor([1.0000, 0.5000]))

    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives by the squared distances."""
        far = squares > self.scale**2
        distance = torch.where(far, squares, self.scale**2).sqrt()
        return torch.where(far, 2 * self.scale * distance - self.scale**2, squares), self.scale / distance


class Cauchy(_RobustLoss):
    r"""Cauchy's loss of squared distances :math:`s`: :math:`c^2 \log(1 + s / c^2)`.

    Args:
        scale: :math:`c` in pixels.

    Raises:
        ValueError: if the scale is not positive.

    Example:
        >>> Cauchy(2.0)(torch.tensor([0.0, 4.0]))
        (tensor([0.0000, 2.7726]), tensor([1.0000, 0.5000]))

    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives by the squared distances."""
        ratio = squares / self.scale**2
        return self.scale**2 * ratio.log1p(), 1 / (1 + ratio)


class GemanMcClure(_RobustLoss):
    r"""Geman and McClure's loss of squared distances :math:`s`: :math:`s / (1 + s / c^2)`, bounded by :math:`c^2`.

    Args:
        scale: :math:`c` in pixels.

    Raises:
        ValueError: if the scale is not positive.

    Example:
        >>> GemanMcClure(2.0)(torch.tensor([0.0, 4.0]))
        (tensor([0., 2.]), tensor([1.0000, 0.2500]))

    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives by the squared distances."""
        weight = (1 + squares / self.scale**2).reciprocal()
        return squares * weight, weight.square()


class Truncated(_RobustLoss):
    r"""The truncated squares of MSAC: squared distances :math:`s` up to :math:`c^2`, and :math:`c^2` beyond.

    Args:
        scale: :math:`c` in pixels.

    Raises:
        ValueError: if the scale is not positive.

    Reference:
        P. Torr, A. Zisserman, MLESAC: a new robust estimator with application to estimating image geometry, CVIU 2000.

    Example:
        >>> Truncated(2.0)(torch.tensor([1.0, 9.0]))
        (tensor([1., 4.]), tensor([1., 0.]))

    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives by the squared distances."""
        return squares.clamp(max=self.scale**2), (squares <= self.scale**2).to(squares)

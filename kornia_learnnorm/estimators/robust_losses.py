r"""Robust losses of squared distances.

A loss returns its value and its derivative with respect to the squared distance: the weight in iteratively reweighted
least squares.
"""

import math
from dataclasses import dataclass
from numbers import Real

import torch
from torch import Tensor

from kornia_learnnorm.geometry.constrained_fit import Loss

__all__ = ["Cauchy", "GemanMcClure", "Huber", "Loss", "Truncated", "check_loss", "squared_loss"]


def squared_loss(squares: Tensor) -> tuple[Tensor, Tensor]:
    """Return the squared distances themselves, each with weight 1: least squares.

    Example:
        >>> squared_loss(torch.tensor([4.0]))
        (tensor([4.]), tensor([1.]))
    """
    return squares, torch.ones_like(squares)


@dataclass(frozen=True)
class _RobustLoss:
    scale: float = 1.0

    def __post_init__(self) -> None:
        scale: object = self.scale
        if not isinstance(scale, Real):
            raise TypeError(f"scale must be a number of pixels, got {scale!r}")
        if not 0 < self.scale < math.inf:
            raise ValueError(f"scale must be positive and finite, got {self.scale}")


class Huber(_RobustLoss):
    r"""Huber's loss of squared distances :math:`s`: :math:`s` up to :math:`c^2`, :math:`2 c \sqrt s - c^2` beyond.

    Args:
        scale: :math:`c` in pixels; ValueError unless positive.

    Example:
        >>> Huber(1.0)(torch.tensor([0.25, 4.0]))
        (tensor([0.2500, 3.0000]), tensor([1.0000, 0.5000]))
    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives with respect to the squared distances."""
        far = squares > self.scale**2
        distance = torch.where(far, squares, self.scale**2).sqrt()
        return torch.where(far, 2 * self.scale * distance - self.scale**2, squares), self.scale / distance


class Cauchy(_RobustLoss):
    r"""Cauchy's loss of squared distances :math:`s`: :math:`c^2 \log(1 + s / c^2)`.

    Args:
        scale: :math:`c` in pixels; ValueError unless positive.

    Example:
        >>> Cauchy(2.0)(torch.tensor([0.0, 4.0]))
        (tensor([0.0000, 2.7726]), tensor([1.0000, 0.5000]))
    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives with respect to the squared distances."""
        ratio = squares / self.scale**2
        return self.scale**2 * ratio.log1p(), 1 / (1 + ratio)


class GemanMcClure(_RobustLoss):
    r"""Geman and McClure's loss of squared distances :math:`s`: :math:`s / (1 + s / c^2)`, bounded by :math:`c^2`.

    Args:
        scale: :math:`c` in pixels; ValueError unless positive.

    Example:
        >>> GemanMcClure(2.0)(torch.tensor([0.0, 4.0]))
        (tensor([0., 2.]), tensor([1.0000, 0.2500]))
    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives with respect to the squared distances."""
        weight = (1 + squares / self.scale**2).reciprocal()
        return squares * weight, weight.square()


class Truncated(_RobustLoss):
    r"""The truncated squares of MSAC: squared distances :math:`s` up to :math:`c^2`, and :math:`c^2` beyond.

    Args:
        scale: :math:`c` in pixels; ValueError unless positive.

    Reference:
        P. Torr, A. Zisserman, MLESAC: a new robust estimator with application to estimating image geometry, CVIU 2000.

    Example:
        >>> Truncated(2.0)(torch.tensor([1.0, 9.0]))
        (tensor([1., 4.]), tensor([1., 0.]))
    """

    def __call__(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses and their derivatives with respect to the squared distances."""
        return squares.clamp(max=self.scale**2), (squares <= self.scale**2).to(squares)


def check_loss(loss: object) -> None:
    """Raise a TypeError for anything but a callable, or for a class in place of its instance."""
    if isinstance(loss, type):
        raise TypeError(f"loss must be a function or an instance such as {loss.__name__}(1.0), got the class")
    if not callable(loss):
        raise TypeError(f"loss must be a function or an instance such as Huber(1.0), got {loss!r}")

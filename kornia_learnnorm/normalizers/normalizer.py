r"""The signature of a normaliser, and how the solver calls one.

A normaliser is any callable ``(points1, points2, weights=None) -> (T1, T2)``. It takes pixels :math:`(B, N, 2)` of both
views and optional weights :math:`(B, N)`, and returns two transforms :math:`(B, 3, 3)`. It may also have a method
``transforms(problem)``, which takes a solved :class:`~kornia_learnnorm.geometry.problem.LinearProblem`, so that nothing
is checked or solved twice. :class:`ProblemNormalizer` implements the signature by this method.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from kornia_learnnorm.geometry.checks import check_correspondences, read_condition
from kornia_learnnorm.geometry.matrices import determinant
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.fundamental import Fundamental

Normalizer = Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]]


class ProblemNormalizer(nn.Module):
    """Base of the normalisers that compute their transforms from a linear problem."""

    min_points = 1  # smallest number of correspondences

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        r"""Return the transforms of both views.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, float32 or float64.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`; zero means absent.

        Returns:
            two affine transforms with shape :math:`(B, 3, 3)` in the dtype of the points.

        Raises:
            TypeError: if the points are not float32 or float64 tensors of one dtype.
            ShapeError: if a shape is wrong.
            ValueError: if there are too few correspondences, a value is not finite, or a weight is negative.
        """
        check_correspondences(points1, points2, weights, self.min_points)
        T1, T2 = self.transforms(LinearProblem.from_points(points1, points2, weights, Fundamental()))
        return T1.to(points1.dtype), T2.to(points1.dtype)

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views, of checked correspondences."""
        raise NotImplementedError


class PerView(nn.Module):
    """Make a normaliser of a per-view callable, such as ``kornia.geometry.epipolar.normalize_points``.

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
        """Return the callable's transforms of both views; points are not checked."""
        kwargs = {} if weights is None else {"weights": weights}
        return self.normalize(points1, **kwargs)[1], self.normalize(points2, **kwargs)[1]


def check_normalizer(normalizer: object) -> None:
    """Raise a TypeError for anything but a module or function; a class is neither."""
    if isinstance(normalizer, type) or not callable(normalizer):
        hint = f"; a model is model={normalizer!r}" if normalizer in ("fundamental", "homography") else ""
        raise TypeError(f"normalizer must be a module or function, got {normalizer!r}{hint}")


def transforms_of(normalizer: Normalizer, problem: LinearProblem) -> tuple[Tensor, Tensor]:
    """Return the transforms of a problem: by a normaliser's method ``transforms``, or by a call if it has none."""
    check_normalizer(normalizer)
    if hasattr(normalizer, "transforms"):
        found: tuple[Tensor, Tensor] = normalizer.transforms(problem)
        return found
    return normalizer(problem.points1, problem.points2, problem.weights)


def normalizing_transforms(normalizer: Normalizer, problem: LinearProblem) -> tuple[Tensor, Tensor]:
    """Return the transforms of a normaliser, which may be the user's own, in the dtype of the problem.

    It is a ValueError if it does not return two finite and invertible transforms :math:`(B, 3, 3)`, and a TypeError if
    it cannot be called.
    """
    result = transforms_of(normalizer, problem)
    expected = (problem.points1.shape[0], 3, 3)
    pair = isinstance(result, (tuple, list))  # torch.compile of PyTorch 2.5 cannot trace a union of types
    shapes = [tuple(getattr(T, "shape", ())) for T in result] if pair else [type(result)]
    if shapes != [expected, expected]:
        raise ValueError(f"a normalizer must return two transforms of shape {expected}, got {shapes}")
    if result[0] is problem.T1 and result[1] is problem.T2:
        return result
    T1, T2 = (T.to(problem.x1) for T in result)
    both = torch.stack([T1, T2]).detach()
    if read_condition(~(both.sum().isfinite() & (determinant(both) != 0).all())):
        raise ValueError(f"the transforms of {type(normalizer).__name__} are not finite and invertible")
    return T1, T2

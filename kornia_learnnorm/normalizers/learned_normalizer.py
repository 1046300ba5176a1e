r"""The learned normaliser: a base normaliser, a network, and a builder that turns its output into transforms."""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from kornia_learnnorm import pretrained
from kornia_learnnorm.geometry import transforms
from kornia_learnnorm.geometry.checks import check_whole_number, read_condition
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import spd_transform, transform_points
from kornia_learnnorm.normalizers import closed_form, reweighted
from kornia_learnnorm.normalizers.networks import crossview, paper
from kornia_learnnorm.normalizers.networks.crossview import CrossViewNetwork
from kornia_learnnorm.normalizers.normalizer import Normalizer, ProblemNormalizer, check_normalizer, transforms_of
from kornia_learnnorm.normalizers.reweighted import ReweightedWhitening

BASES = (closed_form, reweighted)  # modules of the bases that a file may name
FORMAT = "kornia_learnnorm.normalizer.v1"


class LearnedNormalizer(ProblemNormalizer):
    r"""Predict the transforms of the normalised eight-point algorithm from the correspondences.

    :math:`T_i = B(p_i)\, T_i^{base}`: the network reads the correspondences in the coordinates of the base normaliser
    and predicts parameters :math:`p_i`, from which the builder :math:`B` makes a transform. Zero parameters give
    exactly the transforms of the base.

    Args:
        base: normaliser ``(points1, points2, weights) -> (T1, T2)``; default
            :class:`~kornia_learnnorm.ReweightedWhitening`, as in the shipped weights ``crossview``.
        network: ``(points1, points2, weights) -> (params1, params2)`` in base coordinates, also given the DLT's
            ``null_matrix`` there if its attribute ``needs_null_matrix`` is true; default: an untrained
            :class:`~kornia_learnnorm.CrossViewNetwork` of the size of ``crossview``.
        transform: builder from parameters :math:`(B, P)` to transforms :math:`(B, 3, 3)`.
        max_points: sets of more correspondences get Hartley's transforms; None for no limit. It is 12 in ``crossview``.

    Attributes:
        trained_on: names of the stores that the weights were trained on, ``STORE@FIRST:STOP`` for some pairs of one, or
            ``synthetic scenes``; empty if unknown. It is saved with the weights.

    Reference:
        Fan et al., section 4.

    Example:
        >>> normalizer = LearnedNormalizer.from_pretrained()
        >>> T1, T2 = normalizer(torch.rand(2, 8, 2) * 600, torch.rand(2, 8, 2) * 600)
        >>> T1.shape
        torch.Size([2, 3, 3])
    """

    min_points = 8

    def __init__(
        self,
        base: nn.Module | None = None,
        network: nn.Module | None = None,
        transform: Callable[[Tensor], Tensor] = spd_transform,
        max_points: int | None = None,
    ) -> None:
        super().__init__()
        if max_points is not None:
            check_whole_number("max_points", max_points, 8)
        if base is not None:
            check_normalizer(base)
        self.base: Normalizer = ReweightedWhitening() if base is None else base
        self.network = CrossViewNetwork() if network is None else network
        self.transform = transform
        self.max_points = max_points
        self.trained_on: tuple[str, ...] = ()

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views, in the dtype of the problem."""
        if self.max_points is None or problem.x1.shape[1] <= self.max_points:
            return self._predict(problem)
        if problem.weights is None:
            return problem.T1, problem.T2
        few = ((problem.weights > 0).sum(-1) <= self.max_points)[:, None, None]
        if not few.is_cuda and read_condition(few.any()) is False:  # on a GPU, to ask takes longer
            return problem.T1, problem.T2
        T1, T2 = self._predict(problem)
        return torch.where(few, T1, problem.T1), torch.where(few, T2, problem.T2)

    def _predict(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        T1, T2 = (T.to(problem.x1) for T in transforms_of(self.base, problem))
        x1, x2 = transform_points(problem.points1, T1), transform_points(problem.points2, T2)
        if getattr(self.network, "needs_null_matrix", False):
            params = self.network(x1, x2, problem.weights, null_matrix=problem.solve_in(T1, T2)[0])
        else:
            params = self.network(x1, x2, problem.weights)
        if not isinstance(params, (tuple, list)) or len(params) != 2:
            got = f"{len(params)} values" if isinstance(params, (tuple, list)) else type(params)
            raise ValueError(f"a network must return (params1, params2), got {got}")
        if any(part.ndim != 2 for part in params):
            raise ValueError(f"params1 and params2 must have shape (B, P), got {[[*part.shape] for part in params]}")
        return self.transform(params[0].to(T1)) @ T1, self.transform(params[1].to(T2)) @ T2

    def extra_repr(self) -> str:
        """Return the parameters."""
        transform = getattr(self.transform, "__name__", self.transform)
        return f"transform={transform}, max_points={self.max_points}, trained_on={self.trained_on}"

    def save_pretrained(self, path: str | Path) -> None:
        """Write weights and architecture to one ``.safetensors`` file, whole or not at all.

        Raises:
            TypeError: if the base, the network or the builder cannot be imported by name, or its constructor arguments
                are not all numbers or strings that it keeps as attributes: the file could not describe it.
            ValueError: if ``path`` does not end in ``.safetensors``.
            OSError: if it cannot be written.
        """
        architecture = {
            "base": pretrained.describe_part(self.base, *BASES),
            "network": pretrained.describe_part(self.network, crossview, paper),
            "transform": pretrained.name_part(self.transform, transforms),
            "max_points": self.max_points,
        }
        pretrained.save_module(path, self, FORMAT, architecture)

    @classmethod
    def from_pretrained(cls, name: str | Path = "crossview", own_modules: Collection[str] = ()) -> Self:
        """Load a trained normaliser, in evaluation mode: one that ships, by name, or a safetensors file.

        Args:
            name: ``"crossview"`` or ``"crossview-synthetic"``, for up to twelve correspondences; ``"crossview-sets"``,
                for more; ``"paper"``; or the path of a ``.safetensors`` file.
            own_modules: names of your own modules that the file may name; they are imported from the Python path or the
                working folder. By default only this package's code runs.

        Raises:
            FileNotFoundError: if there are no such weights; the message lists those that ship.
            ValueError: if the file is not a normaliser of this package, names a part of another module, or its tensors
                do not fit.
        """

        def build(parts: dict[str, Any]) -> Self:  # type: ignore[type-var]
            base, network = dict(parts["base"]), dict(parts["network"])
            pretrained.check_architecture(base, network)
            max_points = parts.get("max_points")  # files of older versions have none
            if not isinstance(max_points, int | None):
                raise ValueError(f"max_points must be a whole number or null, got {max_points!r}")
            return cls(
                base=pretrained.find_part(base.pop("name"), own_modules, *BASES)(**base),
                network=pretrained.find_part(network.pop("name"), own_modules, crossview, paper)(**network),
                transform=pretrained.find_part(parts["transform"], own_modules, transforms),
                max_points=max_points,
            )

        return pretrained.load_module(name, FORMAT, "normaliser", build)

"""The cross-view network: the parameters of both views' transforms from the correspondences of both."""

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor, nn
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import weighted_mean
from kornia_learnnorm.geometry.dlt import design_matrix, solve_rows
from kornia_learnnorm.geometry.matrices import smallest_right_singular_vector

__all__ = ["CrossViewNetwork", "SetNetwork"]


def set_maximum(features: Tensor, absent: Tensor | None, dim: int, keepdim: bool = False) -> Tensor:
    """Return the maximum along ``dim`` over the points that are not ``absent``, zero where all are."""
    if absent is not None:
        features = torch.where(absent, -torch.inf, features)
    # Not `amax` with a gradient: torch.compile makes NaN of it under autocast to bfloat16, since it compares the
    # maximum, which is rounded, with features computed again, which are not. Without one, `amax` is faster for eights.
    maximum = features.max(dim, keepdim).values if features.requires_grad else features.amax(dim, keepdim)
    return maximum if absent is None else torch.where(absent.all(dim, keepdim), 0.0, maximum)


MAX_POINTS = 16384  # of all sets that a network evaluates at once, where no gradient is wanted

_FEATURES = {"own": (2, 1), "both": (4, 1), "epipolar": (13, 10)}  # their numbers, of a correspondence and of the set


class CrossViewNetwork(nn.Module):
    r"""Predict each view's parameters from the correspondences of both and from the null vector of the DLT.

    The network runs for view 1 on the problem as it is, and for view 2 on its mirror image (views swapped, :math:`F`
    transposed), so that swapping the views swaps the outputs exactly. Its inputs for each correspondence are both
    points, the directions and norms of both epipolar lines, the distances from the lines of the rank-2 correction and
    the epipolar distance after it; for the set, :math:`F` and the size of the correction. An untrained network predicts
    zero: the transforms of the base.

    Args:
        width: channels.
        depth: residual layers.
        num_parameters: parameters per view, as the transform builder wants them.
        bound: largest magnitude of a parameter.
        features: inputs of a view's pass, for ablations: ``"epipolar"`` all of the above, ``"both"`` only the points of
            both views, ``"own"`` only its own points; ValueError for others.

    Example:
        >>> network = CrossViewNetwork(width=16, depth=2)
        >>> network(torch.rand(2, 8, 2), torch.rand(2, 8, 2))[0]
        tensor([[0., 0., 0., 0., 0.],
                [0., 0., 0., 0., 0.]], grad_fn=...)
    """

    def __init__(
        self, width: int = 16, depth: int = 3, num_parameters: int = 5, bound: float = 3.0, features: str = "epipolar"
    ) -> None:
        super().__init__()
        if features not in _FEATURES:
            raise ValueError(f"features must be one of {', '.join(_FEATURES)}, got {features!r}")
        self.width, self.depth, self.num_parameters, self.bound = width, depth, num_parameters, bound
        self.features, self.needs_null_matrix = features, features == "epipolar"
        self.set_network = SetNetwork(*_FEATURES[features], width, depth, num_parameters)

    def forward(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None = None, null_matrix: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the parameters :math:`(B, P)` of both views, in the dtype of the points.

        Args:
            points1: points of the first view in base coordinates with shape :math:`(B, N, 2)`, :math:`N >= 8`.
            points2: points of the second view.
            weights: optional non-negative weights with shape :math:`(B, N)`; zero means absent.
            null_matrix: the DLT's unit null vectors in base coordinates, :math:`(B, 3, 3)`; computed when not given.
        """
        dtype = self.set_network.point_stem.weight.dtype
        points, sets = (part.to(dtype) for part in self._views(points1, points2, weights, null_matrix))
        doubled = None if weights is None else torch.cat([weights, weights]).to(dtype)
        params = self.set_network(points, sets, doubled).to(points1.dtype)
        # Not `chunk`, which torch.export cannot trace with a dynamic batch.
        params1, params2 = torch.unflatten(self.bound * torch.tanh(params / self.bound), 0, (2, -1)).unbind(0)
        return params1, params2

    def _views(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None, null_matrix: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the features of points and sets as view 1 sees them and then as view 2 does, (2 B, N, C), (2 B, D)."""
        if not self.needs_null_matrix:
            own, other = torch.cat([points1, points2]), torch.cat([points2, points1])
            points = own if self.features == "own" else torch.cat([own, other], -1)
            return points, torch.ones_like(points[:, 0, :1])
        x1, x2 = convert_points_to_homogeneous(points1), convert_points_to_homogeneous(points2)
        if null_matrix is None:
            null_matrix = torch.unflatten(solve_rows(design_matrix(x1, x2), weights)[0], -1, (3, 3))
        # The sign that makes the largest entry positive is equal for a matrix and its transpose.
        entries = null_matrix.detach().flatten(-2)
        F = null_matrix * entries.gather(-1, entries.abs().argmax(-1, keepdim=True)).sign()[..., None]
        v, C = smallest_right_singular_vector(F)
        u = normalize((C @ v[..., None])[..., 0], dim=-1)  # left singular vector of the smallest singular value
        own, other, doubled = torch.stack([x1, x2]), torch.stack([x2, x1]), torch.stack([F, F.mT])
        points, sets = _epipolar_features(own, other, doubled, torch.stack([v, u]), torch.stack([u, v]), weights)
        return points.flatten(0, 1), sets.flatten(0, 1)


def _epipolar_features(
    own: Tensor, other: Tensor, F: Tensor, v: Tensor, u: Tensor, weights: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return features of the problem as one view sees it, where ``other^T F own = 0``.

    ``v`` and ``u`` are the right and left singular vectors of the smallest singular value of ``F``: projected to rank
    2, ``F`` loses ``(u^T F v) u v^T``. The features of the points are ``(B, N, 13)``, those of the set ``(B, 10)``.
    """
    line, other_line = (other @ F)[..., :2], (own @ F.mT)[..., :2]
    norm, other_norm = line.norm(dim=-1, keepdim=True), other_line.norm(dim=-1, keepdim=True)
    distance, other_distance = own @ v[..., None], other @ u[..., None]
    correction = (u[..., None, :] @ F @ v[..., None]).squeeze(-1)
    residual = correction[..., None] * distance * other_distance * (1 / (norm + 1e-4) + 1 / (other_norm + 1e-4))
    scale = weighted_mean(residual.abs(), weights)[..., None, :]
    points = [own[..., :2], other[..., :2], normalize(line, dim=-1), normalize(other_line, dim=-1)]
    points += [(norm + 1e-4).log(), (other_norm + 1e-4).log(), residual / (scale + 1e-12)]
    points += [(distance.abs() + 1e-3).log(), (other_distance.abs() + 1e-3).log()]
    return torch.cat(points, -1), torch.cat([3 * F.flatten(-2), (correction.abs() + 1e-6).log()], -1)


class SetNetwork(nn.Module):
    """Residual layers over the points of a set, with the set's maximum as context; permutation invariant.

    It reads ``point_features`` numbers of each point and ``set_features`` of the set, and predicts ``outputs``.
    """

    def __init__(self, point_features: int, set_features: int, width: int, depth: int, outputs: int) -> None:
        super().__init__()
        self.point_stem = nn.Linear(point_features, width)
        self.set_stem = nn.Linear(set_features, width)
        self.layers = nn.ModuleList(ContextLayer(width) for _ in range(depth))
        last = nn.Linear(width, outputs)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), last)

    def forward(self, points: Tensor, set_features: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the outputs :math:`(B, P)` of features of points :math:`(B, N, C)` and sets :math:`(B, D)`.

        Optional weights :math:`(B, N)` are not negative; zero means absent.
        """
        # Without gradients, evaluate in parts that stay in the processor's cache.
        part = max(1, MAX_POINTS // points.shape[1])
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or points.shape[0] <= part:
            return self._evaluate(points, set_features, weights)
        rows = [slice(first, first + part) for first in range(0, points.shape[0], part)]
        found = [self._evaluate(points[r], set_features[r], None if weights is None else weights[r]) for r in rows]
        return torch.cat(found)

    def _evaluate(self, points: Tensor, set_features: Tensor, weights: Tensor | None) -> Tensor:
        h = self.point_stem(points).add_(self.set_stem(set_features)[:, None])
        absent = None if weights is None else (weights <= 0)[..., None]
        for layer in self.layers:
            h = layer(h, absent)
        outputs: Tensor = self.head(torch.cat([set_maximum(h, absent, 1), weighted_mean(h, weights)], -1))
        return outputs


class ContextLayer(nn.Module):
    """A residual two-layer perceptron over each point, whose hidden layer also sees the maximum over the set."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.point = nn.Linear(width, width)
        self.context = nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, width)

    def forward(self, h: Tensor, absent: Tensor | None) -> Tensor:
        """Return the features after the layer, ``(B, N, C)``."""
        z = self.norm(h)
        # In place: for large batches, new memory costs more than the sums. Not the last one: under autocast, `out` has
        # half the precision of `h`.
        hidden = self.point(z).add_(self.context(set_maximum(z, absent, 1))[:, None]).relu_()
        return torch.add(h, self.out(hidden))

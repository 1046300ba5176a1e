r"""The learned eight-point algorithm: a network weighs the correspondences and chooses the transforms, in stages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor, nn

from kornia_learnnorm.estimators.eight_point import (
    essential_matrix,
    prepare_problem,
    refuse_jit,
    solve_undetermined,
    solve_where_determined,
)
from kornia_learnnorm.estimators.fundamental import solve_in_coordinates
from kornia_learnnorm.estimators.match_features import (
    POINT_FEATURES,
    RESIDUAL_FEATURES,
    CommonFrame,
    match_features,
    residual_features,
)
from kornia_learnnorm.estimators.matches import correspondences_from_matches
from kornia_learnnorm.estimators.set_network import SetWeightingNetwork
from kornia_learnnorm.estimators.weighted_refinement import refine_weighted
from kornia_learnnorm.geometry.checks import check_rank2, check_tensor, is_true, weighted_mean
from kornia_learnnorm.geometry.distances import sampson_distance
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.rank2 import correct_rank2
from kornia_learnnorm.geometry.transforms import spd_transform, transform_fundamental, unit_fundamental
from kornia_learnnorm.normalizers.hartley import Hartley
from kornia_learnnorm.pretrained import check_architecture, load_module, save_module

__all__ = ["LearnedEightPoint", "LearnedEstimate", "StageEstimate"]

FORMAT = "kornia_learnnorm.eight_point.v1"
ARCHITECTURE = (
    "width",
    "depth",
    "stages",
    "learn_transforms",
    "rank2",
    "refine_steps",
)  # arguments of the constructor in a file
EARLY_STEPS = 3  # of the refinement, in all stages but the last
MAX_EIGHT_DISTANCE = 0.01  # of the frame's unit; quadratic mean after the optimal correction of eight inliers
MIN_WEIGHT = 1e-6  # added to weights of which the largest is one
BOUND = 2.0  # the parameters of the transforms stay within plus and minus this


class StageEstimate(NamedTuple):
    """What one stage gives.

    Attributes:
        F_mat: fundamental matrices of rank 2 and unit Frobenius norm, (B, 3, 3).
        logits: logits of the probabilities that the correspondences are inliers, (B, N).
    """

    F_mat: Tensor
    logits: Tensor


class LearnedEstimate(NamedTuple):
    r"""Fundamental matrices of a batch of image pairs, and what the layer makes of their correspondences.

    Attributes:
        F_mat: fundamental matrices of rank 2 and unit Frobenius norm, :math:`x_2^\top F x_1 = 0`, (B, 3, 3).
        E_mat: :math:`K_2^\top F K_1` with unit Frobenius norm, (B, 3, 3), or None without cameras.
        determined: whether the correspondences determine a matrix; see :class:`~kornia_learnnorm.TwoViewEstimate`.
        gap: relative gap of the design matrix that ``determined`` is decided on, (B,).
        weights: probability of each correspondence to be an inlier, (B, N); zero for absent ones, one half in sets that
            do not determine their matrix.
        stages: what each stage gives, before its refinement, the last one last.
    """

    F_mat: Tensor
    E_mat: Tensor | None
    determined: Tensor
    gap: Tensor
    weights: Tensor
    stages: tuple[StageEstimate, ...]


class LearnedEightPoint(nn.Module):
    r"""Estimate the fundamental matrix from matches with outliers in one differentiable pass.

    Each stage reads the correspondences and, from the second on, their distances under the matrix of the stage before.
    It predicts a logit for every correspondence and the parameters of two transforms. The weighted eight-point
    algorithm follows, with weights

    .. math:: w_i = \frac{\sigma(l_i)}{\|(F x_1)_{1:2}\|^2 + \|(F^\top x_2)_{1:2}\|^2}

    (in the first stage :math:`\sigma(l_i)`) and transforms :math:`T = B(p)\, T_{Hartley}`, where :math:`B` builds an
    SPD transform and Hartley's is that of the weighted points. A few robust steps of Levenberg-Marquardt on the Sampson
    distances, weighted by :math:`\sigma(l_i)`, end each stage
    (:func:`~kornia_learnnorm.estimators.weighted_refinement.refine_weighted`).

    Eight correspondences determine their matrix whatever the weights: there the result is the optimal correction of
    their null matrix, :func:`~kornia_learnnorm.optimal_rank2`, or Hartley's projection where the correction leaves the
    eight more than 1 % of their mean distance from the centroid away: some of them are outliers then. The networks
    get a gradient of zero.

    The order of the correspondences has no effect. Swapping the views gives :math:`F^\top` up to sign. Moving both
    images by one translation and scaling them by one factor moves :math:`F` along; rotations and different factors are
    only trained.

    Args:
        width: channels of the networks.
        depth: blocks of each stage's network.
        stages: number of stages.
        learn_transforms: predict transforms; without, they are Hartley's of the weighted points, and the heads of the
            networks get no gradient (``find_unused_parameters=True`` of DistributedDataParallel).
        rank2: how the singularity constraint is enforced, see :func:`kornia_learnnorm.find_fundamental`.
        refine_steps: steps of the refinement of the last stage, and at most three of the others; 0 refines none.

    Attributes:
        detach_stages: send no gradient from a stage into the one before and don't refine the last, as when the layer
            itself is trained; a loss of every stage takes its place.
        trained_on: names of the data that the weights were trained on, saved with them; empty where not known.

    Raises:
        ValueError: if a number is not whole or too small, ``learn_transforms`` is no bool, or ``rank2`` is neither
            ``"projection"`` nor ``"optimal"``.

    Example:
        >>> layer = LearnedEightPoint(width=16, depth=2)
        >>> layer(torch.rand(2, 100, 2), torch.rand(2, 100, 2)).shape
        torch.Size([2, 3, 3])

    """

    def __init__(
        self,
        width: int = 48,
        depth: int = 4,
        stages: int = 3,
        learn_transforms: bool = True,
        rank2: Literal["projection", "optimal"] = "projection",
        refine_steps: int = 10,
    ) -> None:
        super().__init__()
        check_rank2(rank2)
        numbers = {"width": (width, 1), "depth": (depth, 1), "stages": (stages, 1), "refine_steps": (refine_steps, 0)}
        for name, (number, least) in numbers.items():
            if not isinstance(number, int) or number < least:
                raise ValueError(f"{name} must be a whole number, at least {least}, got {number!r}")
        if not isinstance(learn_transforms, bool):
            raise ValueError(f"learn_transforms must be true or false, got {learn_transforms!r}")
        self.width, self.depth, self.stages = width, depth, stages
        self.learn_transforms = learn_transforms
        self.rank2: Literal["projection", "optimal"] = rank2
        self.refine_steps = refine_steps
        self.networks = nn.ModuleList(
            SetWeightingNetwork(POINT_FEATURES + (RESIDUAL_FEATURES if stage else 0), width, depth, 10)
            for stage in range(stages)
        )
        self.detach_stages = False
        self.trained_on: tuple[str, ...] = ()

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"learn_transforms={self.learn_transforms}, rank2={self.rank2!r}, trained_on={self.trained_on}"

    def forward(
        self,
        points1: Tensor,
        points2: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> Tensor:
        r"""Return the fundamental matrices; arguments, shapes and errors as for :meth:`estimate`."""
        return self.estimate(points1, points2, weights=weights, mask=mask, scores=scores).F_mat

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        *,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> LearnedEstimate:
        r"""Return the fundamental matrices, the weights of the correspondences and what each stage gives.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`, of any floating-point dtype, that
                multiply the predicted ones; zero means absent.
            mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`. Masked rows
                may hold any value, NaN too, and get a gradient of zero; without a mask NaN is an error.
            scores: optional scores of the matches with shape :math:`(B, N)`, 1 minus Lowe's ratio or a matcher's
                confidence, from 0 to 1, which the networks read.
            K1: optional cameras of the first view with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
            K2: optional cameras of the second view; both or none.

        Returns:
            the matrices, weights and stages, in the dtype of the points.

        Raises:
            TypeError: if the points are not floating-point tensors of one dtype, weights, scores or cameras not
                floating-point, or the mask not boolean.
            ShapeError: if a shape is wrong.
            ValueError: if there are fewer than eight rows, shapes do not pair up, an unmasked value is not finite, a
                weight is negative, a score is outside of 0 to 1, or only one camera is given or one is not invertible.

        """
        problem = prepare_problem(points1, points2, weights, mask, K1, K2)
        scores = None if scores is None else _check_scores(scores, points1, mask).to(problem.x1)

        def solve(problem: LinearProblem, rows: Tensor | None) -> tuple[Tensor, ...]:
            found = self._solve(problem, scores if scores is None or rows is None else scores[rows])
            return tuple(value for stage in found for value in stage)

        def solve_rest(problem: LinearProblem) -> tuple[Tensor, ...]:
            number = self.stages if self.detach_stages else self.stages + 1
            return (solve_undetermined(problem, Hartley()), torch.zeros_like(problem.x1[..., 0])) * number

        flat = [value.to(points1.dtype) for value in solve_where_determined(problem, solve, solve_rest)]
        stages = tuple(StageEstimate(*flat[i : i + 2]) for i in range(0, len(flat), 2))
        F_mat, logits = stages[-1]
        probability = logits.sigmoid()
        if problem.weights is not None:
            probability = torch.where(problem.weights > 0, probability, 0.0)
        E_mat = essential_matrix(F_mat, K1, K2)
        return LearnedEstimate(F_mat, E_mat, problem.determined, problem.gap, probability, stages[: self.stages])

    def from_matches(
        self,
        keypoints1: Tensor,
        keypoints2: Tensor,
        matches: Tensor | Sequence[Tensor],
        scores: Tensor | Sequence[Tensor] | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> LearnedEstimate:
        r"""Return the estimate of the matches of a matching network, whose scores get gradients.

        Args:
            keypoints1: pixels in the first view with shape :math:`(B, M_1, 2)`.
            keypoints2: pixels in the second view with shape :math:`(B, M_2, 2)`.
            matches: see :func:`~kornia_learnnorm.estimators.matches.correspondences_from_matches`.
            scores: optional, one for each match, from 0 to 1.
            K1: optional cameras of the first view, as for :meth:`estimate`.
            K2: optional cameras of the second view.

        Returns:
            the estimate; pairs with fewer than eight matches are not determined.

        Raises:
            TypeError: if keypoints, matches or scores are not tensors of the right kind.
            ShapeError: if the keypoints do not have the shape above.
            ValueError: if the matches do not fit the keypoints, or as :meth:`estimate`.

        """
        points1, points2, weights, mask = correspondences_from_matches(keypoints1, keypoints2, matches, scores)
        return self.estimate(points1, points2, mask=mask, scores=weights, K1=K1, K2=K2)

    def save_pretrained(self, path: str | Path) -> None:
        """Write weights and architecture to one safetensors file, beside the target and then renamed.

        Args:
            path: the file to write.

        Raises:
            ValueError: if ``path`` does not end in ``.safetensors``.
            OSError: if it cannot be written.

        """
        save_module(path, self, FORMAT, {key: getattr(self, key) for key in ARCHITECTURE})

    @classmethod
    def from_pretrained(cls, name: str | Path = "robust-synthetic") -> LearnedEightPoint:
        """Load a trained estimator: one that ships with the package, by name, or a safetensors file.

        Args:
            name: ``"robust-synthetic"``, ``"robust"``, ``"robust-tiny"``, or the path of a ``.safetensors`` file.

        Returns:
            the estimator, in evaluation mode.

        Raises:
            FileNotFoundError: if there are no such weights; the message lists those that ship.
            ValueError: if the file is not an estimator of this package or its tensors do not fit.

        """

        def build(path: Path, text: str) -> LearnedEightPoint:
            try:
                architecture = dict(json.loads(text))
                if set(architecture) != set(ARCHITECTURE):
                    raise ValueError(f"expected {', '.join(ARCHITECTURE)}, got {', '.join(map(str, architecture))}")
                check_architecture(architecture)
                return cls(**architecture)
            except (ValueError, TypeError, AttributeError, RuntimeError) as error:
                raise ValueError(f"{path} describes no estimator of this version: {error}") from error

        return load_module(name, FORMAT, build)

    def _solve(self, problem: LinearProblem, scores: Tensor | None) -> list[StageEstimate]:
        """Return what the stages give for sets that determine their matrix."""
        given = problem.weights
        present = None if given is None else (given > 0).to(problem.x1)
        absent = None if given is None else given <= 0
        frame = CommonFrame.from_points(problem.points1, problem.points2, present)
        features = match_features(frame, scores, present)
        factor: Tensor | None = None
        found: list[StageEstimate] = []
        for network in self.networks:
            seen = features
            if found:
                with torch.set_grad_enabled(torch.is_grad_enabled() and not self.detach_stages):
                    before = self._refine(problem, frame, found[-1], min(EARLY_STEPS, self.refine_steps))
                    residuals, factor = residual_features(frame, *before, present)
                seen = torch.cat([features, residuals], -1)
            logits, params = network(seen.to(self.dtype), absent)
            logits, params = logits.to(problem.x1), params.to(problem.x1)
            weights = logits.sigmoid() if factor is None else logits.sigmoid() * factor
            weights = weights if given is None else weights * given
            F_mat = self._solve_weighted(problem, weights, params, frame.swapped)
            found.append(StageEstimate(F_mat, logits))
        return found if self.detach_stages else [*found, self._refine(problem, frame, found[-1], self.refine_steps)]

    def _refine(self, problem: LinearProblem, frame: CommonFrame, stage: StageEstimate, steps: int) -> StageEstimate:
        """Return a stage's matrices after robust refinement; for eight matches, those of :func:`_solve_eight`."""
        given, x1, x2 = problem.weights, frame.x1, frame.x2
        if x1.shape[1] == 8:
            # The stage has no effect; through the zero, its network, scores and weights still get a gradient of zero.
            return StageEstimate(_solve_eight(problem, frame) + 0.0 * stage.F_mat, stage.logits)
        weights = stage.logits.sigmoid() if given is None else stage.logits.sigmoid() * given
        F_frame = transform_fundamental(stage.F_mat, frame.inverse, frame.inverse)
        x1, x2 = convert_points_to_homogeneous(x1), convert_points_to_homogeneous(x2)
        refined = refine_weighted(x1, x2, F_frame, weights, steps)
        F_mat = unit_fundamental(transform_fundamental(refined, frame.T, frame.T))
        if given is not None:
            eight = ((given > 0).sum(1) <= 8)[:, None, None]
            F_mat = torch.where(eight, _solve_eight(problem, frame), F_mat)
        return StageEstimate(F_mat, stage.logits)

    def _solve_weighted(self, problem: LinearProblem, weights: Tensor, params: Tensor, swapped: Tensor) -> Tensor:
        """Return the matrices of the weighted eight-point algorithm with the predicted transforms."""
        weights = weights / weights.detach().amax(1, keepdim=True)
        weights = weights + MIN_WEIGHT * (1.0 if problem.weights is None else (problem.weights > 0).to(weights))
        weighted = LinearProblem.from_points(problem.points1, problem.points2, weights)
        if not self.learn_transforms:
            return solve_in_coordinates(weighted, weighted.T1, weighted.T2, self.rank2)
        first, second = (BOUND * torch.tanh(params / BOUND)).chunk(2, -1)
        params1 = torch.where(swapped[:, None], second, first)
        params2 = torch.where(swapped[:, None], first, second)
        T1, T2 = spd_transform(params1) @ weighted.T1, spd_transform(params2) @ weighted.T2
        return solve_in_coordinates(weighted, T1, T2, self.rank2)

    def __prepare_scriptable__(self) -> NoReturn:
        """Raise a TypeError: ``torch.jit`` is not supported."""
        refuse_jit()

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the networks' weights."""
        return next(self.parameters()).dtype


def _solve_eight(problem: LinearProblem, frame: CommonFrame) -> Tensor:
    """Return the optimal corrections of the null matrices of eight matches; Hartley's where they don't fit.

    A correction that leaves large distances is one of outliers. There the optimum of the first-order distances is, on
    average, worse than the projection in Hartley's coordinates.
    """
    corrected = correct_rank2(problem, problem.null_matrix)
    projected = solve_in_coordinates(problem, problem.T1, problem.T2)
    present = None if problem.weights is None else (problem.weights > 0).to(problem.x1)
    F_frame = transform_fundamental(corrected.detach(), frame.inverse, frame.inverse)
    square = sampson_distance(frame.x1, frame.x2, F_frame).square()
    fits = weighted_mean(square[..., None], present) < MAX_EIGHT_DISTANCE**2
    return torch.where(fits[..., None], corrected, projected)


def _check_scores(scores: Tensor, points1: Tensor, mask: Tensor | None) -> Tensor:
    """Return the scores, zero where masked; raise a clear error for scores outside of 0 to 1 or of a wrong shape."""
    check_tensor("scores", scores)
    if scores.shape != points1.shape[:-1]:
        raise ValueError(f"scores must have shape {[*points1.shape[:-1]]}, got {[*scores.shape]}")
    scores = scores if mask is None else torch.where(mask, scores, 0.0)
    if is_true(~((scores >= 0) & (scores <= 1)).all()):
        low, high = scores.aminmax()
        raise ValueError(f"scores must be between 0 and 1, got {low.item():g} to {high.item():g}")
    return scores

r"""The learned eight-point algorithm: a network weighs the correspondences and chooses the transforms, in stages."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor, nn

from kornia_learnnorm.estimators.fundamental_stages import SQUARE_FLOOR, FundamentalRefinement
from kornia_learnnorm.estimators.linear import essential_matrix, prepare_problem, solve_undetermined
from kornia_learnnorm.estimators.match_features import POINT_FEATURES, RESIDUAL_FEATURES, CommonFrame
from kornia_learnnorm.estimators.matches import MatchLayer
from kornia_learnnorm.estimators.set_network import SetWeightingNetwork
from kornia_learnnorm.estimators.stages import TRANSFORM_PARAMS, Refinement, in_pieces, run_stages
from kornia_learnnorm.geometry.checks import (
    check_cameras,
    check_tensor,
    check_whole_number,
    inference_mode,
    read_condition,
    weighted_mean,
)
from kornia_learnnorm.geometry.problem import LinearProblem, solve_where_determined
from kornia_learnnorm.models.contract import TwoViewModel
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.pretrained import check_architecture, load_module, save_module

__all__ = [
    "LearnedEightPoint",
    "LearnedEstimate",
    "LearnedLayer",
    "StageEstimate",
    "check_scores",
    "inlier_probability",
]

FORMAT = "kornia_learnnorm.eight_point.v1"
# A normal variable's variance over the geometric mean of its squared length, by its number of components.
VARIANCE = {1: 3.562, 2: 0.8905}
LOG_RANGE = math.log(4 / math.sqrt(2 * math.pi))  # outliers are four of the frame's units wide
MIN_JUDGED = 16  # matches of a set whose distances tell inliers: a matrix fits fewer by chance


class StageEstimate(NamedTuple):
    """What one stage gives."""

    F_mat: Tensor  # fundamental matrices of rank 2 and unit Frobenius norm, (B, 3, 3)
    logits: Tensor  # of the probabilities that the correspondences are inliers, (B, N)


class LearnedLayer(MatchLayer):
    """Networks weigh the correspondences and choose the transforms of a model's DLT, in stages.

    Arguments, attributes and errors are those of :class:`LearnedEightPoint`; ``model`` says what the matrix is.
    """

    scores_are = "scores"
    model_name: str  # of the model whose files this class loads
    # Numbers that a stage's network reads of a correspondence, reads from the second on, and gives for the whole set.
    features, residual_features, outputs = POINT_FEATURES, RESIDUAL_FEATURES, 2 * TRANSFORM_PARAMS
    # Arguments that files hold.
    architecture: tuple[str, ...] = ("width", "depth", "stages", "learn_transforms", "refine_steps")
    added: ClassVar[dict[str, Any]] = {}  # those that files of earlier versions lack

    def __init__(
        self, model: TwoViewModel, width: int, depth: int, stages: int, learn_transforms: bool, refine_steps: int
    ) -> None:
        super().__init__()
        for name, number in {"width": width, "depth": depth, "stages": stages}.items():
            check_whole_number(name, number, 1)
        check_whole_number("refine_steps", refine_steps, 0)
        if not isinstance(learn_transforms, bool):
            raise ValueError(f"learn_transforms must be true or false, got {learn_transforms!r}")
        self.model, self.width, self.depth, self.stages = model, width, depth, stages
        self.learn_transforms, self.refine_steps = learn_transforms, refine_steps
        self.networks = nn.ModuleList(
            SetWeightingNetwork(self.features + (self.residual_features if stage else 0), width, depth, self.outputs)
            for stage in range(stages)
        )
        self.detach_stages = False
        self.trained_on: tuple[str, ...] = ()

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"learn_transforms={self.learn_transforms}, trained_on={self.trained_on}"

    def forward(
        self,
        points1: Tensor,
        points2: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> Tensor:
        r"""Return the matrices; arguments, shapes and errors as for :meth:`LearnedEightPoint.estimate`."""
        return self._estimate(points1, points2, weights, mask, scores)[1][-1].F_mat

    def save_pretrained(self, path: str | Path) -> None:
        """Write weights and architecture to one safetensors file, beside the target and then renamed.

        Args:
            path: the file to write.

        Raises:
            ValueError: if ``path`` does not end in ``.safetensors``.
            OSError: if it cannot be written.

        """
        save_module(
            path, self, FORMAT, {"model": self.model.name} | {key: getattr(self, key) for key in self.architecture}
        )

    @classmethod
    def from_pretrained(cls, name: str | Path) -> Self:
        """Load a trained estimator: one that ships with the package, by name, or a safetensors file."""

        def build(held: dict[str, Any]) -> LearnedLayer:
            architecture = cls.added | held
            model = architecture.pop("model", Fundamental.name)  # files before the name was written
            if model != cls.model_name:
                raise ValueError(f"it is of the model {model!r}, expected {cls.model_name!r} for a {cls.__name__}")
            if set(architecture) != set(cls.architecture):
                raise ValueError(f"expected {', '.join(cls.architecture)}, got {', '.join(map(str, architecture))}")
            check_architecture(architecture)
            return cls(**architecture)

        layer: Self = load_module(name, FORMAT, "estimator", build, cls.model_name)  # type: ignore[assignment]
        return layer

    def start_from(self, layer: LearnedEightPoint) -> Self:
        """Load the first networks of an estimator of fundamental matrices; what only the own ones read is zero."""
        columns = torch.tensor([*range(POINT_FEATURES), *range(self.features, self.features + RESIDUAL_FEATURES)])
        for own, other in zip(self.networks, layer.networks, strict=False):
            state = {k: v for k, v in other.state_dict().items() if not k.startswith("head.2.")}
            new, old = own.state_dict(), state.pop("stem.weight")
            new["stem.weight"] = torch.zeros_like(new["stem.weight"]).index_copy(1, columns[: old.shape[1]], old)
            own.load_state_dict(new | state)
        return self

    def _estimate(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None, mask: Tensor | None, scores: Tensor | None
    ) -> tuple[LinearProblem, tuple[StageEstimate, ...]]:
        """Return the problem, what each stage gives and the final estimate."""
        problem = prepare_problem(self.model, points1, points2, weights, mask)
        scores = None if scores is None else check_scores(scores, points1, mask).to(problem.x1)

        def solve(problem: LinearProblem, rows: Tensor | None) -> tuple[Tensor, ...]:
            given = scores if scores is None or rows is None else scores[rows]
            with inference_mode():
                pieces = [self._run(*piece) for piece in in_pieces(problem, given)]
            return tuple(map(torch.cat, zip(*pieces, strict=True)))

        def solve_rest(problem: LinearProblem) -> tuple[Tensor, ...]:
            number = self.stages if self.detach_stages else self.stages + 1
            M, logits = solve_undetermined(problem, None), torch.zeros_like(problem.x1[..., 0])
            return M.expand(number, -1, -1, -1).transpose(0, 1), logits.expand(number, -1, -1).transpose(0, 1)

        M, logits = solve_where_determined(problem, solve, solve_rest)
        return problem, tuple(map(StageEstimate, M.to(points1.dtype).unbind(1), logits.to(points1.dtype).unbind(1)))

    def _run(self, problem: LinearProblem, scores: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return matrices (B, S, 3, 3) and logits (B, S, N) of stages and final estimate, of determined sets."""
        options = self.learn_transforms, self.refine_steps, self.detach_stages
        return run_stages(self.model, self.networks, problem, scores, *options, self._refinement)

    def _refinement(self, problem: LinearProblem, frame: CommonFrame) -> Refinement:
        return Refinement(self.model, problem, frame)


class LearnedEstimate(NamedTuple):
    """Fundamental matrices of a batch of image pairs, and what the layer makes of their correspondences."""

    F_mat: Tensor  # of rank 2 and unit Frobenius norm, x2^T F x1 = 0, (B, 3, 3)
    E_mat: Tensor | None  # K2^T F K1 with unit Frobenius norm, (B, 3, 3), or None without cameras
    determined: Tensor  # whether the correspondences determine a matrix, (B,) bool; see TwoViewEstimate
    gap: Tensor  # relative gap of the design matrix that `determined` is decided on, (B,)
    # Probability of each correspondence to be an inlier of the matrix, (B, N); zero for absent ones, one half in sets
    # that do not determine their matrix.
    weights: Tensor
    stages: tuple[StageEstimate, ...]  # what each stage gives, before its refinement, the last one last


class LearnedEightPoint(LearnedLayer):
    r"""Estimate the fundamental matrix from matches with outliers in one differentiable pass.

    Each stage reads the correspondences and, from the second on, their distances under the matrix of the stage before.
    It predicts a logit for every correspondence and the parameters of two transforms. The weighted eight-point
    algorithm follows, with weights

    .. math:: w_i = \frac{\sigma(l_i)}{\|(F x_1)_{1:2}\|^2 + \|(F^\top x_2)_{1:2}\|^2}

    (in the first stage :math:`\sigma(l_i)`) and transforms :math:`T = B(p)\, T_{Hartley}`, where :math:`B` builds an
    SPD transform and Hartley's is that of the weighted points. A few robust steps of Levenberg-Marquardt on the Sampson
    distances, weighted by :math:`\sigma(l_i)`, end each stage unless a search does
    (:func:`~kornia_learnnorm.estimators.optimize.refine_unrolled`).

    In the last stage of sets of 16 correspondences and more, with :math:`\sum_i \sigma(l_i) \ge 8`, samples are drawn
    by :math:`\sigma(l_i)`: minimal ones of seven, and a third as many of 20, which average the noise. Of their matrices
    and the network's, the one of least robust cost over all correspondences is fitted to all of them, weighted by
    :math:`\sigma(l_i)^{0.2}`. In evaluation, those of them with a mean :math:`\sigma(l_i)` above 0.7 in the first stage
    leave the other stages and the minimal samples out.

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
        samples: minimal samples in the last stage; without (0), there are none of 20 either, and the last fit is that
            of the other stages.

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

    model_name = Fundamental.name
    architecture = ("width", "depth", "stages", "learn_transforms", "rank2", "refine_steps", "samples")
    added: ClassVar[dict[str, Any]] = {"samples": 64}

    def __init__(
        self,
        width: int = 48,
        depth: int = 4,
        stages: int = 2,
        learn_transforms: bool = True,
        rank2: Literal["projection", "optimal"] = "projection",
        refine_steps: int = 10,
        samples: int = 96,
    ) -> None:
        super().__init__(Fundamental(rank2), width, depth, stages, learn_transforms, refine_steps)
        check_whole_number("samples", samples, 0)
        self.rank2, self.samples = rank2, samples

    def _refinement(self, problem: LinearProblem, frame: CommonFrame) -> Refinement:
        return FundamentalRefinement(self.model, problem, frame, self.samples, not self.training)

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
        return super().from_pretrained(name)  # configurations need the name of the class, not Self

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"learn_transforms={self.learn_transforms}, rank2={self.rank2!r}, trained_on={self.trained_on}"

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

        Shapes and errors are those of :meth:`~kornia_learnnorm.EightPoint.estimate`, but for those of the scores.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`.
            points2: pixels in the second view.
            weights: optional; they multiply the predicted ones.
            mask: optional, true for the rows that are correspondences.
            scores: optional scores of the matches with shape :math:`(B, N)`, 1 minus Lowe's ratio or a matcher's
                confidence, from 0 to 1, which the networks read.
            K1: optional cameras of the first view.
            K2: optional cameras of the second view; both or none.

        Returns:
            the matrices, weights and stages, in the dtype of the points.

        Raises:
            TypeError: if the scores are not floating-point.
            ValueError: if the scores do not have the shape of the matches, or one is outside of 0 to 1.

        """
        problem, stages = self._estimate(points1, points2, weights, mask, scores)
        check_cameras(K1, K2, points1.shape[0])
        F_mat, logits = stages[-1]
        probability = inlier_probability(self.model, problem, F_mat, logits, problem.determined).to(F_mat.dtype)
        E_mat = essential_matrix(F_mat, K1, K2)
        return LearnedEstimate(F_mat, E_mat, problem.determined, problem.gap, probability, stages[: self.stages])


def inlier_probability(
    model: TwoViewModel, problem: LinearProblem, M: Tensor, logits: Tensor, determined: Tensor
) -> Tensor:
    """Return the probabilities (B, N) of inliers of matrices (B, 3, 3) in pixels, with logits (B, N) before them.

    By Bayes' rule: distances of inliers are normally distributed, those of outliers uniformly over the image. The
    logits alone decide in sets of fewer than 16 correspondences, which a matrix may fit by chance, and in undetermined
    ones.
    """
    present = torch.ones_like(problem.x1[..., 0]) if problem.present is None else problem.present
    frame = CommonFrame.from_points(problem.points1, problem.points2, problem.present)
    x1, x2 = convert_points_to_homogeneous(torch.stack([frame.x1, frame.x2])).mT
    M, prior = model.carry(M.to(x1), frame.inverse, frame.inverse), logits.to(x1)
    swapped = frame.swapped[:, None, None]  # distances of a homography are not the same both ways
    M = torch.where(swapped, model.swap(M), M)
    x1, x2 = torch.where(swapped, x2, x1), torch.where(swapped, x1, x2)
    squares = model.squares(model.residual(M / torch.linalg.matrix_norm(M, keepdim=True), x1, x2))
    mean = weighted_mean((squares + SQUARE_FLOOR)[..., None].log(), prior.sigmoid() * present).exp()
    variance = mean * VARIANCE[model.components]
    evidence = model.components * (LOG_RANGE - variance.log() / 2) - squares / (2 * variance)
    enough = determined & (present.sum(1) >= MIN_JUDGED)
    return torch.where(enough[:, None], prior + evidence, prior).sigmoid() * (present > 0)


def check_scores(scores: Tensor, points1: Tensor, mask: Tensor | None) -> Tensor:
    """Return the scores, zero where masked; raise a clear error for scores outside of 0 to 1 or of a wrong shape."""
    check_tensor("scores", scores)
    if scores.shape != points1.shape[:-1]:
        raise ValueError(f"scores must have shape {[*points1.shape[:-1]]}, got {[*scores.shape]}")
    scores = scores if mask is None else torch.where(mask, scores, 0.0)
    if read_condition(~((scores >= 0) & (scores <= 1)).all()):
        low, high = scores.aminmax()
        raise ValueError(f"scores must be between 0 and 1, got {low.item():g} to {high.item():g}")
    return scores

"""Base class of the learned layers: networks predict weights and transforms of a DLT, in stages."""

import math
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor, nn

from kornia_learnnorm.estimators.linear import solve_linear
from kornia_learnnorm.estimators.matches import MatchLayer
from kornia_learnnorm.estimators.moments import SQUARE_FLOOR
from kornia_learnnorm.estimators.network_features import POINT_FEATURES, RESIDUAL_FEATURES, CommonFrame
from kornia_learnnorm.estimators.set_network import SetWeightingNetwork
from kornia_learnnorm.estimators.stages import TRANSFORM_PARAMS, Refinement, in_pieces, run_stages
from kornia_learnnorm.geometry import checks
from kornia_learnnorm.geometry.problem import LinearProblem, prepare_problem, solve_where_determined
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.two_view_model import TwoViewModel
from kornia_learnnorm.pretrained import check_architecture, load_module, save_module

FORMAT = "kornia_learnnorm.eight_point.v1"
# Variance of a normal vector's components over the geometric mean of its squared length, by number of components.
VARIANCE = {1: 3.562, 2: 0.8905}
LOG_RANGE = math.log(4 / math.sqrt(2 * math.pi))  # outliers are uniform over a width of four frame units
MIN_JUDGED = 16  # smallest set whose distances count in inlier probabilities: a matrix fits fewer by chance


class StageEstimate(NamedTuple):
    """Result of one stage."""

    F_mat: Tensor  # fundamental matrices of rank 2 and unit Frobenius norm, (B, 3, 3)
    logits: Tensor  # of the probabilities that the correspondences are inliers, (B, N)


class LearnedLayer(MatchLayer):
    """Base class of the learned layers: networks predict weights and transforms of a model's DLT, in stages.

    Arguments, attributes and errors are those of :class:`LearnedEightPoint`; ``model`` defines the matrix.
    """

    scores_are = "scores"
    model_name: str  # of the model whose files this class loads
    # Features of a correspondence, additional ones from the second stage on, and a network's outputs for the whole set.
    features, residual_features, outputs = POINT_FEATURES, RESIDUAL_FEATURES, 2 * TRANSFORM_PARAMS
    architecture: tuple[str, ...]  # arguments that files hold
    added: ClassVar[dict[str, Any]] = {}  # values of arguments that files of earlier versions lack
    refinement: type[Refinement] = Refinement
    learn_transforms = True

    def __init__(
        self, model: TwoViewModel, width: int, depth: int, stages: int, refine_steps: int, samples: int
    ) -> None:
        super().__init__()
        for name, number in {"width": width, "depth": depth, "stages": stages}.items():
            checks.check_whole_number(name, number, 1)
        for name, number in {"refine_steps": refine_steps, "samples": samples}.items():
            checks.check_whole_number(name, number, 0)
        self.model, self.width, self.depth, self.stages = model, width, depth, stages
        self.refine_steps, self.samples = refine_steps, samples
        sizes = [self.features] + (stages - 1) * [self.features + self.residual_features]
        self.networks = nn.ModuleList(SetWeightingNetwork(size, width, depth, self.outputs) for size in sizes)
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
        """Write weights and architecture to one ``.safetensors`` file, whole or not at all.

        ValueError for another suffix, OSError if it cannot be written.
        """
        architecture = {key: getattr(self, key) for key in self.architecture}
        save_module(path, self, FORMAT, {"model": self.model.name} | architecture)

    @classmethod
    def from_pretrained(cls, name: str | Path) -> Self:
        """Load a trained estimator: one that ships with the package, by name, or a safetensors file."""

        def build(held: dict[str, Any]) -> Self:  # type: ignore[type-var]
            architecture = cls.added | held
            model = architecture.pop("model", Fundamental.name)  # files of earlier versions have no name
            if model != cls.model_name:
                raise ValueError(f"it is of the model {model!r}, expected {cls.model_name!r} for a {cls.__name__}")
            if set(architecture) != set(cls.architecture):
                raise ValueError(f"expected {', '.join(cls.architecture)}, got {', '.join(map(str, architecture))}")
            check_architecture(architecture)
            return cls(**architecture)

        return load_module(name, FORMAT, "estimator", build, cls.model_name)

    def start_from(self, layer: "LearnedLayer") -> Self:
        """Load the first networks of an estimator of fundamental matrices; weights of additional inputs are zero."""
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
        """Return the problem and the estimates of all stages, the final one last."""
        problem = prepare_problem(self.model, points1, points2, weights, mask)
        scores = None if scores is None else check_scores(scores, points1, mask).to(problem.x1)

        def solve(problem: LinearProblem, rows: Tensor | None) -> tuple[Tensor, ...]:
            given = scores if scores is None or rows is None else scores[rows]
            with checks.inference_mode():
                pieces = [self._run(*piece) for piece in in_pieces(problem, given)]
            return tuple(map(torch.cat, zip(*pieces, strict=True)))

        def solve_rest(problem: LinearProblem) -> tuple[Tensor, ...]:
            number = self.stages if self.detach_stages else self.stages + 1
            M, logits = self.model.fallback(solve_linear(problem, None)), torch.zeros_like(problem.x1[..., 0])
            return M.expand(number, -1, -1, -1).transpose(0, 1), logits.expand(number, -1, -1).transpose(0, 1)

        M, logits = solve_where_determined(problem, solve, solve_rest)
        return problem, tuple(map(StageEstimate, M.to(points1.dtype).unbind(1), logits.to(points1.dtype).unbind(1)))

    _run = run_stages


def inlier_probability(
    model: TwoViewModel, problem: LinearProblem, M: Tensor, logits: Tensor, determined: Tensor
) -> Tensor:
    """Return the posterior inlier probabilities (B, N) under matrices (B, 3, 3) in pixels, from prior logits (B, N).

    By Bayes' rule: distances of inliers are normally distributed, those of outliers uniformly over the image. The
    logits alone decide in sets of fewer than 16 correspondences, which a matrix may fit by chance, and in undetermined
    ones.
    """
    present = torch.ones_like(problem.x1[..., 0]) if problem.present is None else problem.present
    frame = CommonFrame.from_points(problem.points1, problem.points2, problem.present)
    x1, x2 = convert_points_to_homogeneous(torch.stack([frame.x1, frame.x2])).mT
    M, prior = model.carry(M.to(x1), frame.inverse, frame.inverse), logits.to(x1)
    swapped = frame.swapped[:, None, None]  # distances under a homography are not symmetric
    M = torch.where(swapped, model.swap(M), M)
    x1, x2 = torch.where(swapped, x2, x1), torch.where(swapped, x1, x2)
    squares = model.squares(model.residual(M / torch.linalg.matrix_norm(M, keepdim=True), x1, x2))
    weights = present if problem.weights is None else problem.weights
    mean = checks.weighted_mean((squares + SQUARE_FLOOR)[..., None].log(), prior.sigmoid() * weights).exp()
    variance = mean * VARIANCE[model.components]
    evidence = model.components * (LOG_RANGE - variance.log() / 2) - squares / (2 * variance)
    enough = determined & (present.sum(1) >= MIN_JUDGED)
    return torch.where(enough[:, None], prior + evidence, prior).sigmoid() * (present > 0)


def check_scores(scores: Tensor, points1: Tensor, mask: Tensor | None) -> Tensor:
    """Return the scores, zero where masked; raise a clear error for scores outside of 0 to 1 or of a wrong shape."""
    checks.check_tensor("scores", scores)
    if scores.shape != points1.shape[:-1]:
        raise ValueError(f"scores must have shape {[*points1.shape[:-1]]}, got {[*scores.shape]}")
    scores = scores if mask is None else torch.where(mask, scores, 0.0)
    if checks.read_condition(~((scores >= 0) & (scores <= 1)).all()):
        low, high = scores.aminmax()
        raise ValueError(f"scores must be between 0 and 1, got {low.item():.9g} to {high.item():.9g}")
    return scores

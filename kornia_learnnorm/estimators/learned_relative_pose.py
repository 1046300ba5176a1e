r"""The learned relative pose of calibrated cameras: essential matrix, rotation and translation from matches."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.learned_layer import LearnedLayer, check_scores, inlier_probability
from kornia_learnnorm.estimators.optimize import choose
from kornia_learnnorm.estimators.pose_stages import run_pose_stages
from kornia_learnnorm.estimators.stages import in_pieces
from kornia_learnnorm.geometry.checks import check_cameras, inference_mode, is_known_true
from kornia_learnnorm.geometry.dlt import MIN_GAP
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.pose import choose_pose
from kornia_learnnorm.geometry.problem import LinearProblem, prepare_problem
from kornia_learnnorm.models.essential import Calibrated, Essential
from kornia_learnnorm.models.fundamental import Fundamental


class PoseStage(NamedTuple):
    """Result of one stage."""

    E_mat: Tensor  # essential matrices of unit Frobenius norm, (B, 3, 3)
    logits: Tensor  # of the probabilities that the correspondences are inliers, (B, N)


class RelativePoseEstimate(NamedTuple):
    """Relative poses of a batch of image pairs, and the inlier probabilities of their correspondences."""

    E_mat: Tensor  # essential matrices of unit Frobenius norm, x2^T K2^-T E K1^-1 x1 = 0, (B, 3, 3)
    F_mat: Tensor  # K2^-T E K1^-1 with unit Frobenius norm, (B, 3, 3)
    R: Tensor  # rotations of X2 = R X1 + t, (B, 3, 3)
    t: Tensor  # translations of unit length, (B, 3)
    determined: Tensor  # whether only finitely many matrices fit the correspondences, (B,) bool
    gap: Tensor  # relative gap of the design matrix, which decides `determined`, (B,)
    # Inlier probability of each correspondence, (B, N); zero for absent ones, one half in sets that are not determined.
    weights: Tensor
    stages: tuple[PoseStage, ...]  # the last one holds the result


class LearnedRelativePose(LearnedLayer):
    r"""Estimate the relative pose of calibrated cameras from matches with outliers in one differentiable pass.

    It is :class:`~kornia_learnnorm.LearnedEightPoint` for calibrated cameras. Its networks also read the viewing rays
    of both points, the scale of the set in pixels and, from the second stage on, the distances in pixels. Each stage
    computes the :math:`9 \times 9` matrix of second moments of the weighted design rows. The candidates are the
    essential matrices in the span of its eigenvectors with the four smallest eigenvalues
    (:func:`~kornia_learnnorm.geometry.five_point.essential_in_span`), the one nearest to the smallest of these, that of
    the previous stage and, in the last stage, those of minimal samples drawn by the weights. If fewer than 40 % of the
    correspondences agree with the best of these, as many samples are drawn again near it. The candidate with the least
    robust cost is refined by reweighted least squares on the Sampson distances over the five parameters of a relative
    pose; gradients pass through this refinement alone. In evaluation mode, sets of 16 or more correspondences with a
    mean probability above 0.7 in the first stage skip its matrix, the other networks and half of the samples.

    If a score test finds that the correspondences contradict the cameras (inexact intrinsics or lens distortion), the
    pose is that of a refined fundamental matrix, provided that its standard error is at most three times as large and
    it fits to a few pixels.

    The order of the correspondences has no effect. Swapping the views, with their cameras, gives :math:`E^\top` up to
    sign. Up to ten matrices fit five correspondences exactly; rounding may decide between them. Planes and forward
    motion need no special treatment. A camera that only rotates has no translation: the returned direction is
    arbitrary. Undistort the points first if the distortion is known.

    Args:
        width: channels of the networks.
        depth: blocks of each stage's network.
        stages: number of stages.
        refine_steps: reweightings in the last stage, and at most two in the others. Gradients are the derivatives of
            these steps: more steps bring them closer to those of the optimum where most correspondences are right.
        samples: minimal samples in the last stage.

    Attributes and errors are those of :class:`~kornia_learnnorm.LearnedEightPoint`; ``detach_stages`` also turns off
    the minimal samples.

    Example:
        >>> layer = LearnedRelativePose(width=16, depth=2)
        >>> K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> layer(500 * torch.rand(2, 100, 2), 500 * torch.rand(2, 100, 2), K, K).shape
        torch.Size([2, 3, 3])
    """

    model_name = Essential.name
    architecture = ("width", "depth", "stages", "refine_steps", "samples")
    features, residual_features = LearnedLayer.features + 5, LearnedLayer.residual_features + 1
    outputs = 1  # logarithm of a factor on the scale of the robust loss
    learn_transforms = False

    def __init__(
        self, width: int = 48, depth: int = 4, stages: int = 2, refine_steps: int = 5, samples: int = 64
    ) -> None:
        eye = torch.eye(3)[None]
        super().__init__(Essential(eye, eye), width, depth, stages, refine_steps, samples)

    @classmethod
    def from_pretrained(cls, name: str | Path = "robust-pose-synthetic") -> "LearnedRelativePose":
        """Load a trained estimator in evaluation mode: ``"robust-pose-synthetic"``, ``"robust-pose"``, or a file.

        Errors are those of :meth:`~kornia_learnnorm.LearnedEightPoint.from_pretrained`.
        """
        return super().from_pretrained(name)  # configurations need the name of the class, not Self

    @classmethod
    def from_eight_point(
        cls, layer: LearnedEightPoint, stages: int = 2, refine_steps: int = 5, samples: int = 64
    ) -> "LearnedRelativePose":
        """Return an untrained estimator whose networks start from those of an estimator of fundamental matrices.

        Their additional inputs, rays and distances in pixels, have no effect before training. Stages beyond those of
        ``layer`` are new.
        """
        return cls(layer.width, layer.depth, stages, refine_steps, samples).start_from(layer)

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"refine_steps={self.refine_steps}, samples={self.samples}, trained_on={self.trained_on}"

    def forward(  # type: ignore[override]
        self,
        points1: Tensor,
        points2: Tensor,
        K1: Tensor,
        K2: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> Tensor:
        """Return the essential matrices; arguments, shapes and errors as for :meth:`estimate`."""
        *_, states, _ = self._pose_stages(points1, points2, K1, K2, weights, mask, scores)
        return unit_matrix(states[-1].essential()).to(points1.dtype)

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
        *,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> RelativePoseEstimate:
        r"""Return essential matrices, poses, the inlier probabilities and the result of each stage.

        Arguments, shapes and errors are those of :meth:`~kornia_learnnorm.LearnedEightPoint.estimate`, with
        :math:`N \ge 5`; the cameras are required. Points are pixels; with a mean focal length below 10, they count as
        normalised coordinates.

        Returns:
            the matrices, poses, weights and stages, in the dtype of the points. Of the four poses of an essential
            matrix, the one with the largest weight of correspondences in front of both cameras is returned. Degenerate
            sets, such as fewer than five different correspondences, get the pose of a sideways motion, without
            gradient.
        """
        found = self._pose_stages(points1, points2, K1, K2, weights, mask, scores)
        (problem, cameras, determined, gap, states, logits), dtype = found, points1.dtype
        pairs = zip(states, logits, strict=True)
        stages = tuple(PoseStage(unit_matrix(state.essential()).to(dtype), logit.to(dtype)) for state, logit in pairs)
        state, (inverse1, inverse2) = states[-1], (torch.linalg.inv_ex(K)[0] for K in cameras)
        F_mat = unit_matrix(inverse2.mT @ state.essential() @ inverse1)
        probability = inlier_probability(Fundamental(), problem, F_mat, logits[-1], determined)
        R, t = choose_pose(*state.poses(), problem.points1, problem.points2, *cameras, probability.detach())
        F_mat, R, t, probability = (value.to(dtype) for value in (F_mat, R, t, probability))
        return RelativePoseEstimate(stages[-1].E_mat, F_mat, R, t, determined, gap, probability, stages)

    def _pose_stages(
        self,
        points1: Tensor,
        points2: Tensor,
        K1: Tensor | None,
        K2: Tensor | None,
        weights: Tensor | None,
        mask: Tensor | None,
        scores: Tensor | None,
    ) -> tuple[LinearProblem, tuple[Tensor, Tensor], Tensor, Tensor, list[Calibrated], list[Tensor]]:
        """Return the problem, the cameras, which sets are determined and by how much, and the stages."""
        if K1 is None or K2 is None:
            raise ValueError("cameras K1 and K2 are needed; LearnedEightPoint does without")
        problem = prepare_problem(self.model, points1, points2, weights, mask, Essential.sample_size)
        check_cameras(K1, K2, points1.shape[0])
        scores = None if scores is None else check_scores(scores, points1, mask).to(problem.x1)
        K1, K2 = (K.to(problem.x1).expand(points1.shape[0], 3, 3) for K in (K1, K2))
        determined, gap = _determined(problem)
        solved, C1, C2, rows, eye = problem, K1, K2, determined[:, None], torch.eye(3).to(K1)
        if not is_known_true(determined.all()):
            solved = problem.with_generic_points(determined)  # the results of the generic points are dropped
            C1, C2 = (torch.where(rows[..., None], K, eye) for K in (K1, K2))
        with inference_mode():
            pieces = [run_pose_stages(self, *piece) for piece in in_pieces(solved, C1, C2, scores)]
        all_states, all_logits = zip(*pieces, strict=True)
        states = [Calibrated(*map(torch.cat, zip(*stage, strict=True))) for stage in zip(*all_states, strict=True)]
        sideways = Essential(eye[None], eye[None]).calibrated(eye.new_tensor(self.model.preferred).view(1, 3, 3))
        states = [choose(determined, state, sideways) for state in states]
        logits = [torch.where(rows, torch.cat(stage), 0.0) for stage in zip(*all_logits, strict=True)]
        return problem, (K1, K2), determined, gap, states, logits


@torch.no_grad()
def _determined(problem: LinearProblem) -> tuple[Tensor, Tensor]:
    """Return which sets have five independent rows in their design matrix, (B,) bool, and the relative gap, (B,)."""
    A = problem.model.rows(problem.x1, problem.x2)
    if problem.present is not None:
        A = A * problem.present[..., None]
    values = torch.linalg.eigvalsh(A.mT @ A).clamp(min=0)
    gap = (values[:, 4] / (values[:, 8] + (values[:, 8] == 0))).sqrt()
    return gap > MIN_GAP, gap

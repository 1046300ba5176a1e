r"""The learned homography: from matches of a plane, or of a camera that only rotates."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.homography_stages import HomographyRefinement
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.learned_layer import LearnedLayer, inlier_probability
from kornia_learnnorm.estimators.network_features import CommonFrame
from kornia_learnnorm.geometry.checks import check_whole_number
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.homography import Homography


class HomographyStage(NamedTuple):
    """Result of one stage."""

    H_mat: Tensor  # homographies of unit Frobenius norm, (B, 3, 3)
    logits: Tensor  # of the probabilities that the correspondences are inliers, (B, N)


class HomographyEstimate(NamedTuple):
    """Homographies of a batch of image pairs, and the inlier probabilities of their correspondences."""

    H_mat: Tensor  # of unit Frobenius norm, map homogeneous pixels of image 1 to image 2, (B, 3, 3)
    determined: Tensor  # whether the correspondences determine an invertible matrix, (B,) bool
    gap: Tensor  # relative gap of the design matrix that `determined` is decided on, (B,)
    # Inlier probability of each correspondence, (B, N); zero for absent ones, one half in sets that are not determined.
    weights: Tensor
    stages: tuple[HomographyStage, ...]  # result of each stage before its refinement, in order


class LearnedHomography(LearnedLayer):
    r"""Estimate the homography of a plane, or of a camera that only rotates, from matches with outliers in one pass.

    It is :class:`~kornia_learnnorm.LearnedEightPoint` for homographies, differentiable too. The network of each stage
    predicts an inlier probability for every correspondence and two transforms, the weighted DLT follows in their
    coordinates, and reweighted least squares on the Sampson distances refines its matrix. In the last stage of sets of
    eight or more correspondences, minimal samples of four are drawn by the probabilities. Of their matrices and the
    network's, the one of least robust cost over all correspondences is fitted to all of them. The probabilities have
    little weight in this fit: where noise is coarse, full weights suppress correct matches that the matrix needs. In
    evaluation mode, sets of 16 or more correspondences with a mean probability above 0.7 in the first stage skip the
    other stages.

    Four correspondences determine their matrix exactly, whatever the weights; the networks get a gradient of zero. The
    order of the correspondences has no effect. Swapping the views gives :math:`H^{-1}` up to scale. :math:`H` is
    equivariant to a translation and a scale that are common to both images.

    Do not use it on scenes with relief: it returns the homography that most matches agree on, without a warning. Among
    many outliers and without scores it fails more often if one image is rotated by more than about 90 degrees against
    the other, which was rare in its training: rotate the image first, or pass scores.

    Args:
        width: channels of the networks.
        depth: blocks of each stage's network.
        stages: number of stages.
        refine_steps: reweightings in the last stage, and at most three in the others. Gradients are the derivatives of
            these steps: many steps make them huge where few matches are inliers.
        samples: minimal samples in the last stage; with 0, the last fit begins at the network's matrix.

    Attributes and errors are those of :class:`~kornia_learnnorm.LearnedEightPoint`.

    Example:
        >>> layer = LearnedHomography(width=16, depth=2)
        >>> layer(torch.rand(2, 100, 2), torch.rand(2, 100, 2)).shape
        torch.Size([2, 3, 3])
    """

    model: Homography
    model_name, takes_cameras = Homography.name, False
    architecture = ("width", "depth", "stages", "refine_steps", "samples")
    added: ClassVar[dict[str, Any]] = {"samples": 64}
    refinement = HomographyRefinement

    def __init__(
        self, width: int = 48, depth: int = 4, stages: int = 2, refine_steps: int = 3, samples: int = 64
    ) -> None:
        super().__init__(Homography(), width, depth, stages, True, refine_steps)
        check_whole_number("samples", samples, 0)
        self.samples = samples

    @classmethod
    def from_pretrained(cls, name: str | Path = "robust-homography") -> LearnedHomography:
        """Load a trained estimator in evaluation mode: ``"robust-homography"``, or the path of a ``.safetensors`` file.

        FileNotFoundError if there are no such weights, with a list of those that ship; ValueError if the file is not
        an estimator of this package or its tensors do not fit.
        """
        return super().from_pretrained(name)  # configurations need the name of the class, not Self

    @classmethod
    def from_eight_point(
        cls, layer: LearnedEightPoint, stages: int = 2, refine_steps: int = 3, samples: int = 64
    ) -> LearnedHomography:
        """Return an untrained estimator whose networks start from those of an estimator of fundamental matrices.

        Stages beyond those of ``layer`` are new.
        """
        return cls(layer.width, layer.depth, stages, refine_steps, samples).start_from(layer)

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        *,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> HomographyEstimate:
        r"""Return the homographies, the inlier probabilities and the result of each stage.

        Arguments, shapes and errors are those of :meth:`~kornia_learnnorm.LearnedEightPoint.estimate`, without cameras
        and with :math:`N \ge 4`.

        Returns:
            the matrices, weights and stages, in the dtype of the points. Sets that do not determine an invertible
            matrix, such as fewer than four different correspondences or four of which three are collinear, get the
            identity, without gradient.
        """
        problem, found = self._estimate(points1, points2, weights, mask, scores)
        stages = tuple(HomographyStage(*stage) for stage in found)
        probability = inlier_probability(self.model, problem, *found[-1], problem.determined).to(points1.dtype)
        number = self.stages
        return HomographyEstimate(stages[-1].H_mat, problem.determined, problem.gap, probability, stages[:number])

    def _run(self, problem: LinearProblem, scores: Tensor | None) -> tuple[Tensor, Tensor]:
        """Run the stages from the view whose points spread less to the other: errors are not the same both ways."""
        swapped = CommonFrame.from_points(problem.points1, problem.points2, problem.present).swapped[:, None, None]
        points1, points2 = problem.points1, problem.points2
        points1, points2 = torch.where(swapped, points2, points1), torch.where(swapped, points1, points2)
        ordered = LinearProblem.from_points(points1, points2, problem.weights, self.model)
        M, logits = super()._run(ordered, scores)
        return torch.where(swapped[..., None], unit_matrix(self.model.swap(M)), M), logits

r"""The learned homography of a plane, or of a camera that only rotates, from matches with outliers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.learned_layer import LearnedLayer, inlier_probability
from kornia_learnnorm.estimators.moments import SQUARE_FLOOR, geometric_scale, least_cost
from kornia_learnnorm.estimators.network_features import CommonFrame
from kornia_learnnorm.estimators.optimize import UNROLLED_LOSS
from kornia_learnnorm.estimators.stages import Refinement
from kornia_learnnorm.estimators.weighted_samples import draw_matches, evenly_ranked
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.homography import Homography, solve_four_points, squared_distances

# Scales of the robust loss in early stages, in comparisons and in the last fit: geometric means of inlier distances.
EARLY_SCALE, COMPARED_SCALE, LAST_SCALE = 3.0, 1.5, 6.0
NEAR = 3.0  # geometric means; in evaluation, distances beyond about this hardly count in the mean itself
LAST_POWER = 0.05  # exponent of the probabilities in the last fit: nearly equal weights, as the loss rejects outliers
LOCAL_STEPS = 2  # reweighting steps from a candidate
MAX_SCORED = 128  # matches on which candidates are pre-scored
SHORTLIST = 2  # matrices of minimal samples that are refined
MIN_MARGIN = 1e-3  # frame units; smallest shift of a point that makes three points of a minimal sample collinear
MIN_MATCHES = 8  # smallest set for which samples are drawn: some sample fits most of fewer matches by chance


class HomographyStage(NamedTuple):
    """Result of one stage."""

    H_mat: Tensor  # homographies of unit Frobenius norm, (B, 3, 3)
    logits: Tensor  # of the probabilities that the correspondences are inliers, (B, N)


class HomographyEstimate(NamedTuple):
    """Homographies of a batch of image pairs, and the inlier probabilities of their correspondences."""

    H_mat: Tensor  # of unit Frobenius norm, map homogeneous pixels of image 1 to image 2, (B, 3, 3)
    determined: Tensor  # whether the correspondences determine an invertible matrix, (B,) bool
    gap: Tensor  # relative gap of the design matrix, which decides `determined`, (B,)
    # Inlier probability of each correspondence, (B, N); zero for absent ones, one half in sets that are not determined.
    weights: Tensor
    stages: tuple[HomographyStage, ...]  # result of each stage before its refinement, in order


class HomographyRefinement(Refinement):
    r"""Refine matrices by reweighted least squares; in the last stage, run the search of :class:`LearnedHomography`.

    A step needs only the :math:`9 \times 9` matrix of the second moments of the design rows, computed from weighted
    moments of view 1's points: it is cheap even for thousands of matches.

    A match is weighted by its inlier probability times :math:`(1 + r)^{-2}`, the derivative of Geman and McClure's
    loss, with :math:`r` its squared distance over the squared scale. In the last stage it is the probability to the
    power of 0.05 times :math:`(1 + r^2)^{-2}`, which gives inliers nearly equal weights.
    """

    model: Homography
    min_searched = MIN_MATCHES

    def __init__(
        self, model: Homography, problem: LinearProblem, frame: CommonFrame, samples: int, settle: bool
    ) -> None:
        super().__init__(model, problem, frame, samples, settle)
        products = (self.x1[:, :, None] * self.x1[:, None]).flatten(1, 2)
        self.evidence = model.sampson_terms(self.x1, self.x2), products

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after ``steps`` steps.

        The choice among candidates has no derivative; adding zero times M gives the transforms a gradient of zero.
        """
        inliers = probability if self.weights is None else probability * self.weights
        near = NEAR if self.settle else None
        mean, weights = geometric_scale(inliers, self.model.dof, SQUARE_FLOOR, near), inliers
        if last:
            weights = probability.clamp(min=torch.finfo(M.dtype).tiny) ** LAST_POWER
            weights = weights if self.weights is None else weights * self.weights
        M = (M / torch.linalg.matrix_norm(M, keepdim=True))[:, None]

        def weigh(squares: Tensor) -> Tensor:
            if last:
                return weights[:, None] * UNROLLED_LOSS((squares / (LAST_SCALE**2 * mean(squares))).square())[1]
            return weights[:, None] * UNROLLED_LOSS(squares / (EARLY_SCALE**2 * mean(squares)))[1]

        if last and steps and self.samples:
            with torch.no_grad():
                own = self._descend(M, self.evidence, weigh, LOCAL_STEPS)
                squares = self.model.sampson_squares(own, self.evidence[0])[0]
                best = self._most_consistent(own, inliers, COMPARED_SCALE**2 * mean(squares))
            few = (inliers > 0).sum(1) < MIN_MATCHES
            M = torch.where(few[:, None, None, None], M, best + 0.0 * M)
        return self._descend(M, self.evidence, weigh, steps)[:, 0]

    def _most_consistent(self, own: Tensor, inliers: Tensor, square_scale: Tensor) -> Tensor:
        """Return the matrices with the least cost, (B, 1, 3, 3), among ``own`` and those of minimal samples."""
        # Sort the matches by weight, so that samples and choices do not depend on the order of the input.
        order = inliers.argsort(dim=1, descending=True, stable=True)
        drawn = draw_matches(inliers, order, self.samples, self.model.sample_size)[:, None].expand(-1, 3, -1)
        views = (torch.unflatten(x.gather(2, drawn), 2, (self.samples, -1)) for x in (self.x1, self.x2))
        solved = solve_four_points(*(x.permute(0, 2, 3, 1).flatten(0, 1) for x in views))
        M, margin = (torch.unflatten(value, 0, (-1, self.samples)) for value in solved)
        present = (inliers > 0).to(inliers)
        some = evenly_ranked(order, present, MAX_SCORED)
        few = present.gather(1, some)
        terms, products = (value.gather(2, some[:, None].expand(-1, value.shape[1], -1)) for value in self.evidence)

        def losses(M: Tensor, terms: Tensor) -> Tensor:
            return UNROLLED_LOSS(self.model.sampson_squares(M, terms)[0] / square_scale.to(M))[0]

        def weigh(squares: Tensor) -> Tensor:
            return few[:, None] * UNROLLED_LOSS(squares / square_scale)[1]

        M = least_cost(M, margin > MIN_MARGIN, losses(M.float(), terms.float()), few, SHORTLIST)
        M = torch.cat([own, self._descend(M, (terms, products), weigh, LOCAL_STEPS)], 1)
        return least_cost(M, M.isfinite().all((2, 3)), losses(M, self.evidence[0]), present, 1)

    def _descend(
        self, M: Tensor, evidence: tuple[Tensor, Tensor], weigh: Callable[[Tensor], Tensor], steps: int
    ) -> Tensor:
        """Return the matrices (B, K, 3, 3) after steps of reweighted least squares; differentiable."""
        terms, products = evidence
        for _ in range(steps):
            parts = self.model.sampson_parts(M, terms)
            M = self.model.reweighted_step(M, terms, products, parts, weigh(squared_distances(parts)))[0]
        return M


class LearnedHomography(LearnedLayer):
    r"""Estimate the homography of a plane, or of a camera that only rotates, from matches with outliers in one pass.

    It is :class:`~kornia_learnnorm.LearnedEightPoint` for homographies, and is differentiable too. In each stage, a
    network predicts an inlier probability for every correspondence and two transforms, the weighted DLT is solved in
    the transformed coordinates, and reweighted least squares on the Sampson distances refine its matrix. In the last
    stage, sets of eight or more correspondences are searched: minimal samples of four are drawn by the probabilities.
    Among their matrices and the network's, the one with the least robust cost over all correspondences is fitted to all
    of them. This fit hardly uses the probabilities: with coarse noise, full weights would suppress correct matches that
    the matrix needs. In evaluation mode, sets of 16 or more correspondences with a mean probability above 0.7 in the
    first stage skip the other stages.

    Four correspondences determine the matrix exactly: weights have no effect, and the networks get a gradient of zero.
    The order of the correspondences has no effect. Swapping the views gives :math:`H^{-1}` up to scale. :math:`H` is
    equivariant to a translation and a scale that are common to both images.

    Do not use it on scenes with relief: it returns the homography that most matches agree on, without a warning. For
    rotated images, see :class:`~kornia_learnnorm.LearnedEightPoint`.

    Args:
        width: channels of the networks.
        depth: blocks of each stage's network.
        stages: number of stages.
        refine_steps: reweightings in the last stage, and at most three in the others. Gradients are the derivatives of
            these steps: many steps make them huge where few matches are inliers.
        samples: minimal samples in the last stage; with 0, the last fit starts from the network's matrix.

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
        super().__init__(Homography(), width, depth, stages, refine_steps, samples)

    @classmethod
    def from_pretrained(cls, name: str | Path = "robust-homography") -> "LearnedHomography":
        """Load a trained estimator in evaluation mode: ``"robust-homography"``, or the path of a ``.safetensors`` file.

        Errors are those of :meth:`~kornia_learnnorm.LearnedEightPoint.from_pretrained`.
        """
        return super().from_pretrained(name)  # configurations need the name of the class, not Self

    @classmethod
    def from_eight_point(
        cls, layer: LearnedEightPoint, stages: int = 2, refine_steps: int = 3, samples: int = 64
    ) -> "LearnedHomography":
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
        stages = tuple(HomographyStage(*stage) for stage in found[: self.stages])
        probability = inlier_probability(self.model, problem, *found[-1], problem.determined).to(points1.dtype)
        return HomographyEstimate(found[-1].F_mat, problem.determined, problem.gap, probability, stages)

    def _run(self, problem: LinearProblem, scores: Tensor | None) -> tuple[Tensor, Tensor]:
        """Run the stages with the view whose points spread less as the first: distances under H are not symmetric."""
        swapped = CommonFrame.from_points(problem.points1, problem.points2, problem.present).swapped[:, None, None]
        points1, points2 = problem.points1, problem.points2
        points1, points2 = torch.where(swapped, points2, points1), torch.where(swapped, points1, points2)
        M, logits = super()._run(LinearProblem.from_points(points1, points2, problem.weights, self.model), scores)
        return torch.where(swapped[..., None], unit_matrix(self.model.swap(M)), M), logits

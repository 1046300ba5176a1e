r"""The learned eight-point algorithm: in each stage, a network weights the correspondences and predicts transforms."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.learned_layer import LearnedLayer, StageEstimate, inlier_probability
from kornia_learnnorm.estimators.linear import essential_matrix
from kornia_learnnorm.estimators.moments import SQUARE_FLOOR, Evidence, descend, geometric_scale, least_cost, pick
from kornia_learnnorm.estimators.stages import Refinement
from kornia_learnnorm.estimators.weighted_samples import evenly_ranked, fit_samples, sample_null_spaces
from kornia_learnnorm.geometry.checks import check_cameras, is_known_true
from kornia_learnnorm.geometry.seven_point import fundamental_in_span
from kornia_learnnorm.models.fundamental import Fundamental, Rank2, Rank2Method

COMPARED_SCALE, FIT_SCALE = 2.2, 3.0  # scales of the loss to compare and to fit, in geometric means of the distances
LAST_FLOOR = 0.002  # frame units, about half a pixel; its square is added to the squared scale of the last fit
LAST_POWER = 0.2  # exponent of the probabilities in the last fit: nearly equal weights, as the loss rejects outliers
FIRST_STEPS, LOCAL_STEPS = 1, 3  # reweighting steps from the network's matrix before the search, and from candidates
SEARCH_STEPS = 6  # refinement steps of the last stage that the search replaces
RELAXATION = 1.3  # factor on a step: a robust loss has less curvature than its weights imply
MAX_SCORED = 128  # matches on which the matrices of samples are pre-scored
SHORTLIST = 6  # best matrices of samples, which are then compared on all matches
# Smallest number of matches, and sum of their probabilities, for a search: some sample fits most of fewer by chance.
MIN_MATCHES, MIN_INLIERS = 16, 8


class LearnedEstimate(NamedTuple):
    """Fundamental matrices of a batch of image pairs, and the inlier probabilities of their correspondences."""

    F_mat: Tensor  # of rank 2 and unit Frobenius norm, x2^T F x1 = 0, (B, 3, 3)
    E_mat: Tensor | None  # K2^T F K1 with unit Frobenius norm, (B, 3, 3), or None without cameras
    determined: Tensor  # whether the correspondences determine a matrix, (B,) bool; see TwoViewEstimate
    gap: Tensor  # relative gap of the design matrix, which decides `determined`, (B,)
    # Inlier probability of each correspondence, (B, N); zero for absent ones, one half in sets that are not determined.
    weights: Tensor
    stages: tuple[StageEstimate, ...]  # result of each stage before its refinement, in order


class FundamentalRefinement(Refinement):
    """Refine a stage's matrices robustly; in the last stage, run the search of :class:`LearnedEightPoint`."""

    min_searched = MIN_MATCHES

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after ``steps`` steps; in the last stage, the search replaces six of them.

        The choice among candidates has no derivative; adding zero times M gives the transforms a gradient of zero.
        """
        if not (last and steps and self.samples):
            return super().optimize(M, probability, steps, last)
        weights = probability if self.weights is None else probability * self.weights
        evidence, mean = Evidence.from_points(self.x1, self.x2), geometric_scale(weights, self.model.dof, SQUARE_FLOOR)
        with torch.no_grad():
            state = self.model.state(M)
            own = descend(evidence, state, weights[:, None], lambda s: FIT_SCALE**2 * mean(s), FIRST_STEPS).matrix()
            best = self._most_consistent(evidence, torch.stack([own, M], 1), weights, mean)
        state = Rank2(best.axes + 0.0 * M[:, None], best.A)
        power = probability.clamp(min=torch.finfo(M.dtype).tiny) ** LAST_POWER
        power = power if self.weights is None else power * self.weights
        # The scale is computed anew in each step, so that derivatives do not depend on where the fit began.
        options = (lambda s: FIT_SCALE**2 * mean(s) + LAST_FLOOR**2), max(1, steps - SEARCH_STEPS), RELAXATION
        fitted: Tensor = descend(evidence, state, power[:, None], *options).matrix()
        present = weights > 0
        few = (present.sum(1) < MIN_MATCHES) | ((probability * present).sum(1) < MIN_INLIERS)
        if is_known_true(~few.any()):
            return fitted
        return torch.where(few[:, None, None], super().optimize(M, probability, steps, last), fitted)

    def _most_consistent(
        self, evidence: Evidence, M: Tensor, weights: Tensor, mean: Callable[[Tensor], Tensor]
    ) -> Rank2:
        """Return the states with the least cost over all matches, among matrices (B, S, 3, 3) and those of samples.

        The scale of the cost is the least mean distance of any candidate, since the weights may be poor.
        """
        present = (weights > 0).to(weights)
        # Sort the matches by weight, so that samples and choices do not depend on the order of the input.
        order = weights.argsort(dim=1, descending=True, stable=True)
        drawn, real = self._draw(evidence, weights, order)
        some = evenly_ranked(order, present, MAX_SCORED)
        squares = evidence.single().select(some).squares(drawn.float())[0]
        means = geometric_scale(weights.gather(1, some).to(squares), self.model.dof, LAST_FLOOR**2)(squares)[..., 0]
        least = torch.where(real & means.isfinite(), means, torch.inf).amin(1)[:, None, None].to(M)
        square_scale = COMPARED_SCALE**2 * mean(evidence.squares(M)[0]).amin(1, keepdim=True).minimum(least)
        losses = squares.div_(squares + square_scale.to(squares))  # of Geman and McClure
        M = torch.cat([M, least_cost(drawn, real, losses, present.gather(1, some), SHORTLIST)], 1)
        state, number = self.model.state(M.flatten(0, 1)), M.shape[1]
        all_alike = present[:, None].expand(-1, number, -1)
        state = descend(evidence, state, all_alike, lambda _: square_scale, LOCAL_STEPS, RELAXATION)
        losses = evidence.losses(torch.unflatten(state.matrix(), 0, (-1, number)), square_scale)
        best: Rank2 = pick(state, (losses @ present[..., None])[..., 0].argmin(1), number)
        return best

    def _draw(self, evidence: Evidence, weights: Tensor, order: Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrices of samples, (B, S, 3, 3), and which of them are real.

        There are a third as many large samples as minimal ones; sets with few outliers use the large ones alone.
        """
        large = self.model.constrain(fit_samples(evidence, weights, order, -(-self.samples // 3)))
        real = torch.ones_like(large[..., 0, 0], dtype=torch.bool)
        if self.all_settled:
            return large, real
        basis, determined = sample_null_spaces(evidence, weights, order, self.samples, self.model.sample_size)
        drawn, singular = fundamental_in_span(basis.flatten(0, 1))
        shape = -1, 3 * self.samples
        singular = singular.view(shape) & determined.repeat_interleave(3, 1)
        if self.few_outliers is not None:
            singular = singular & ~self.few_outliers[:, None]
        return torch.cat([large, drawn.view(*shape, 3, 3)], 1), torch.cat([real, singular], 1)


class LearnedEightPoint(LearnedLayer):
    r"""Estimate the fundamental matrix from matches with outliers in one differentiable pass.

    The network of each stage reads the correspondences and, from the second stage on, their distances under the matrix
    of the stage before. It predicts a logit :math:`l_i` for every correspondence and the parameters :math:`p` of two
    transforms. The weighted eight-point algorithm follows, with weights

    .. math:: w_i = \frac{\sigma(l_i)}{\|(F x_1)_{1:2}\|^2 + \|(F^\top x_2)_{1:2}\|^2}

    (in the first stage :math:`\sigma(l_i)`) and transforms :math:`T = B(p)\, T_{Hartley}`, where :math:`B` builds a
    symmetric positive definite transform and :math:`T_{Hartley}` normalises the weighted points. Each stage ends with a
    few robust Levenberg-Marquardt steps on the Sampson distances, weighted by :math:`\sigma(l_i)`
    (:func:`~kornia_learnnorm.estimators.optimize.refine_unrolled`) or, in the last stage, with a search.

    The search runs on sets of 16 or more correspondences with :math:`\sum_i \sigma(l_i) \ge 8`. It draws samples by
    :math:`\sigma(l_i)`: minimal samples of seven, and a third as many samples of 20, which average the noise. Among
    their matrices and the network's, the one with the least robust cost over all correspondences is fitted to all of
    them, with weights :math:`\sigma(l_i)^{0.2}`. In evaluation mode, sets of 16 or more with a mean
    :math:`\sigma(l_i)` above 0.7 in the first stage skip the other stages and the minimal samples.

    With eight correspondences the null vector does not depend on the weights. The result is then its weighted optimal
    correction, :func:`~kornia_learnnorm.optimal_rank2`. If its root mean square distance to the eight exceeds 1 % of
    their mean distance from the centroid, some are outliers, and the result is the rank-2 projection in Hartley's
    coordinates. The networks get a gradient of zero.

    The order of the correspondences has no effect. Swapping the views gives :math:`F^\top` up to sign. :math:`F` is
    equivariant to a translation and a scale that are common to both images; to rotations and different scales only
    approximately, by training. Where the least-squares rotation from one view's points to the other's is larger than 45
    degrees, the networks read the points of one view rotated back. With few correspondences and many outliers, such as
    64 with 80 % outliers, this rotation often cannot be told from chance: if you know it, rotate the image first.

    Args:
        width: channels of the networks.
        depth: blocks of each stage's network.
        stages: number of stages.
        learn_transforms: predict transforms; otherwise they are Hartley's for the weighted points, and the heads of the
            networks get no gradient (set ``find_unused_parameters=True`` in DistributedDataParallel).
        rank2: how the singularity constraint is enforced, see :func:`kornia_learnnorm.find_fundamental`.
        refine_steps: refinement steps in the last stage (after a search six fewer, at least one), at most three in the
            others; 0 turns both off. Gradients are those of the steps: 40 bring them closer to those of the optimum.
        samples: minimal samples of the search; 0 turns the search off.

    Attributes:
        detach_stages: for training with a loss on every stage: no gradient passes to the previous stage, and the last
            stage is not refined.
        trained_on: names of the data that the weights were trained on, saved with them; empty if unknown.

    Raises:
        ValueError: if a number is not whole or too small, ``learn_transforms`` is no bool, or ``rank2`` is neither
            ``"projection"`` nor ``"optimal"``.

    Example:
        >>> import torch
        >>> layer = LearnedEightPoint(width=16, depth=2)
        >>> layer(torch.rand(2, 100, 2), torch.rand(2, 100, 2)).shape
        torch.Size([2, 3, 3])
    """

    model_name = Fundamental.name
    architecture = ("width", "depth", "stages", "learn_transforms", "rank2", "refine_steps", "samples")
    added: ClassVar[dict[str, Any]] = {"samples": 64}
    refinement = FundamentalRefinement

    def __init__(
        self,
        width: int = 48,
        depth: int = 4,
        stages: int = 2,
        learn_transforms: bool = True,
        rank2: Rank2Method = "projection",
        refine_steps: int = 10,
        samples: int = 96,
    ) -> None:
        super().__init__(Fundamental(rank2), width, depth, stages, refine_steps, samples)
        if not isinstance(learn_transforms, bool):
            raise ValueError(f"learn_transforms must be true or false, got {learn_transforms!r}")
        self.rank2, self.learn_transforms = rank2, learn_transforms

    @classmethod
    def from_pretrained(cls, name: str | Path = "robust-synthetic") -> "LearnedEightPoint":
        """Load a trained estimator for evaluation: ``"robust-synthetic"``, ``"robust"``, ``"robust-tiny"``, or a file.

        FileNotFoundError, which lists the shipped weights, if there are none of this name; ValueError if the file is
        not an estimator of this package or its tensors do not fit.
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
        r"""Return the fundamental matrices, the inlier probabilities and the result of each stage.

        Shapes and errors are those of :meth:`~kornia_learnnorm.EightPoint.estimate`, and the errors of scores below.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`.
            points2: pixels in the second view.
            weights: optional; they multiply the predicted weights.
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

r"""RANSAC for fundamental matrices, essential matrices and homographies."""

import math
import time
from contextlib import nullcontext
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from kornia_learnnorm.estimators.linear import solve_linear
from kornia_learnnorm.geometry.checks import check_cameras, check_choice, solve_dtype, without_autocast
from kornia_learnnorm.geometry.distances import Distance
from kornia_learnnorm.geometry.distinct_points import distinct_points
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.essential import Calibrated, Essential
from kornia_learnnorm.models.fundamental import Fundamental, Rank2Method
from kornia_learnnorm.models.homography import Homography
from kornia_learnnorm.models.two_view_model import TwoViewModel
from kornia_learnnorm.normalizers.closed_form import Hartley
from kornia_learnnorm.normalizers.normalizer import Normalizer, check_normalizer
from kornia_learnnorm.ransac.argument_checks import check_matches, check_numbers
from kornia_learnnorm.ransac.dominant_plane import try_dominant_plane
from kornia_learnnorm.ransac.fits import fit_final, optimize_locally
from kornia_learnnorm.ransac.minimal_solver import solve_minimal_samples
from kornia_learnnorm.ransac.samplers import Sampler, UniformSampler, WeightedSampler
from kornia_learnnorm.ransac.scoring import MAX_MEDIAN_DISTANCES, Hypotheses, PairScorer, finite_and_bounded
from kornia_learnnorm.ransac.threads import one_thread

FIRST_BATCH = 64  # samples in the first batch; each batch is four times as large as the one before
MAX_SCORED = 4096  # correspondences that hypotheses are scored on, drawn once
FEW_INLIERS = 0.25  # inlier ratio; below, the last samples, a tenth or at least a batch, are near the best matrix
NEAR = 20.0  # thresholds; the matches this near the best matrix have a smaller share of outliers
Cameras = tuple[Tensor, Tensor]


class RansacResult(NamedTuple):
    """Result of RANSAC on one image pair; matrices are zeros where none was found."""

    F_mat: Tensor  # of rank 2 and unit Frobenius norm, (3, 3)
    inliers: Tensor  # which correspondences are inliers, (N,) bool
    num_samples: int  # minimal samples drawn
    score: float  # MSAC score of `F_mat`, the sum of max(0, 1 - d^2 / threshold^2) over the correspondences
    # Nearest to K2^T F K1, with unit norm and singular values (s, s, 0), (3, 3); None without cameras. Up to scale,
    # F = K2^-T E K1^-1, unless the correspondences contradict the cameras.
    E_mat: Tensor | None = None


class RANSAC(nn.Module):
    r"""Estimate a fundamental matrix, an essential matrix or a homography from correspondences with outliers.

    Minimal samples of seven, or with a normaliser samples of eight for :func:`~kornia_learnnorm.find_fundamental`, are
    solved in batches, and MSAC scores their matrices. Local optimisation fits the best matrices of each batch
    to their inliers by reweighted least squares, and the best of them also by the DLT with the normaliser. The inlier
    ratio of the best matrix so far decides how many samples are still needed. If it is low, or the samples run out, the
    last samples are drawn from the matches near that matrix. If most inliers of a fundamental matrix lie on a plane,
    and the others could agree by chance, the matrix of this plane and of the parallax of the other matches is tried as
    well. In the final fit, the best matrices are fitted with the Geman-McClure loss, and the one of least cost is
    refined by Levenberg-Marquardt if it has not converged.

    With both cameras, minimal samples of five run through Nister's five-point solver, and local optimisation and the
    final fit are least squares on essential matrices; distances stay in pixels. If a fundamental matrix fits
    significantly better (p < 0.001) and its pose still fits, with at most three times the standard error, this matrix
    is the result: the intrinsics are then inexact, or the lens or shutter is not that of a pinhole camera.
    ``normalizer`` and ``rank2`` have no effect with cameras.

    Among matches that share a point exactly, in either view, only the one of highest weight counts (the first of equal
    ones), because many matches on one point would agree with every epipolar line through it.

    On the CPU, PyTorch uses one thread during a call, see :func:`~kornia_learnnorm.ransac.threads.one_thread`.

    :meth:`forward` has the signature of ``kornia.geometry.RANSAC(model_type="fundamental_8pt")``; the constructor's
    arguments differ, the matrix has unit Frobenius norm, and weights guide the sampling.

    Args:
        normalizer: maps ``(points1, points2, weights)`` to the transforms of both views, for samples of eight and for
            the refits of local optimisation. Leave it out to draw samples of seven, of which fewer are needed.
        inl_th: largest distance of an inlier, pixels.
        max_samples: largest number of minimal samples (Kornia's ``max_iter`` counts batches of 2,048).
        max_seconds: time after which no further batch of samples (64 at first, up to 1,024; 4,096 for a homography) is
            drawn; with it the result depends on the machine.
        confidence: probability, in :math:`(0, 1]`, that a sample without outliers is drawn before sampling stops, if
            the best matrix so far has all inliers; 1 draws all ``max_samples`` samples. By default 0.999999, because a
            sample must have little noise, too; 0.9999 for a homography; and 0.999 with cameras, which reduce the effect
            of noise.
        distance: ``"sampson"``, or ``"symmetric"`` (Fan et al., Eq. 8).
        rank2: how the singularity constraint is enforced on samples of eight: ``"projection"`` in the normaliser's
            coordinates (Hartley's when not given), the default with a ``normalizer``, or ``"optimal"`` correction.
            Matrices of samples of seven are singular.
        refine: run local optimisation and the final fit; otherwise return the best matrix of the minimal samples.
        seed: makes every call on the same input and device give the same result; None draws from PyTorch's generator.
        model: ``"fundamental"``, ``"homography"``, or a model of your own, which replaces ``distance`` and ``rank2``. A
            homography has minimal samples of four, no cameras and no ``rank2``; its symmetric distance is the root of
            the sum of both squared transfer errors.

    Raises:
        TypeError: if ``normalizer`` cannot be called, ``model`` is no model, or ``inl_th``, ``confidence``,
            ``max_seconds`` or ``seed`` is not a number.
        ValueError: if a number is out of its range, ``max_samples`` is not whole, or ``model``, ``distance`` or
            ``rank2`` is an unknown name.

    Reference:
        P. Torr, A. Zisserman, MLESAC, CVIU 2000 (MSAC); O. Chum, J. Matas, J. Kittler, Locally optimized RANSAC, DAGM
        2003; O. Chum, T. Werner, J. Matas, Two-view geometry estimation unaffected by a dominant plane, CVPR 2005.

    Example:
        >>> import kornia_learnnorm as kln
        >>> _ = torch.manual_seed(0)
        >>> F_true = kln.find_fundamental(torch.rand(1, 8, 2) * 600, torch.rand(1, 8, 2) * 600)[0].double()
        >>> points1, points2 = torch.rand(2, 400, 2, dtype=torch.float64) * 600
        >>> a, b, c = (F_true @ torch.cat([points1, torch.ones(400, 1)], -1).mT).unbind(0)
        >>> points2[:300, 1] = -(a * points2[:, 0] + c)[:300] / b[:300]  # on their epipolar lines
        >>> F_mat, inliers = RANSAC(seed=0)(points1, points2)
        >>> bool(inliers[:300].all()), (F_mat - F_true).norm() < 1e-6 or (F_mat + F_true).norm() < 1e-6
        (True, tensor(True))
    """

    def __init__(
        self,
        normalizer: Normalizer | None = None,
        inl_th: float = 1.0,
        max_samples: int = 50_000,
        max_seconds: float | None = None,
        confidence: float | None = None,
        distance: Distance = "sampson",
        rank2: Rank2Method | None = None,
        refine: bool = True,
        seed: int | None = None,
        model: Literal["fundamental", "homography"] | TwoViewModel = "fundamental",
    ) -> None:
        super().__init__()
        check_numbers(inl_th, max_samples, max_seconds, confidence, seed)
        if normalizer is not None:
            check_normalizer(normalizer)
        if rank2 is not None and model == "homography":
            raise ValueError(f"rank2 is a constraint of fundamental matrices, got {rank2!r} for a homography")
        if rank2 is None:
            rank2 = "optimal" if normalizer is None else "projection"
        if isinstance(model, str):
            if str(model) == "essential":
                raise ValueError("model 'essential' is 'fundamental' called with the cameras K1 and K2")
            check_choice("model", model, ("fundamental", "homography"))
            model = Homography(distance) if model == "homography" else Fundamental(rank2, distance)
        if not isinstance(model, TwoViewModel):
            raise TypeError(f"model must be a name or a TwoViewModel, got {model!r}")
        self.model = model
        self.normalizer = Hartley() if normalizer is None and rank2 == "projection" else normalizer
        self.rank2: Rank2Method = rank2
        self.inl_th, self.max_samples, self.max_seconds, self.confidence = inl_th, max_samples, max_seconds, confidence
        self.distance, self.refine = distance, refine
        self.seed = None if seed is None else int(seed)

    def extra_repr(self) -> str:
        """Return the parameters."""
        names = ("inl_th", "max_samples", "max_seconds", "confidence", "distance", "rank2", "refine", "seed")
        return ", ".join([f"model={self.model.name!r}", *(f"{name}={getattr(self, name)!r}" for name in names)])

    def forward(
        self,
        kp1: Tensor,
        kp2: Tensor,
        weights: Tensor | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return matrix and inliers of one pair, as Kornia's RANSAC; arguments and errors as for :meth:`estimate`."""
        F_mat, inliers, *_ = self.estimate(kp1, kp2, weights, K1, K2)
        return F_mat, inliers

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        weights: Tensor | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> RansacResult:
        r"""Estimate the matrix of one image pair: fundamental or homography, and with cameras also essential.

        Args:
            points1: pixels in the first image with shape :math:`(N, 2)`, :math:`N \ge 8`, with cameras
                :math:`N \ge 5`, float32 or float64. Rows that are not finite, more than 1e6 median distances from the
                other points, or share a point with a better match, are not inliers.
            points2: pixels in the second image with shape :math:`(N, 2)`.
            weights: optional non-negative scores :math:`(N,)`, higher is better, such as one minus Lowe's ratio or
                LightGlue's scores. Matches are sampled in proportion to the squares of their weights, so a match of
                weight zero is never sampled; of matches that share a point, the one of highest weight counts.
            K1: optional camera of the first image with shape :math:`(3, 3)`.
            K2: optional camera of the second image with shape :math:`(3, 3)`; both or none.

        Returns:
            the matrix ``F_mat`` :math:`(3, 3)`, :math:`x_2^\top F x_1 = 0`, its inliers before it is rounded to the
            dtype of the points, the number of samples and the score; no gradients. ``F_mat`` also holds a homography,
            from :math:`N \ge 4` matches of which more than four are inliers.

            If no matrix has more than eight inliers (five with cameras, four for a homography), or fewer weights than
            that are positive, the matrix is zero and there are no inliers. If every sample is degenerate, as on a plane
            without noise or without motion, the matrix is one of those that fit; with cameras, at most two fit a plane.

        Raises:
            TypeError: if the points are not floating-point tensors of one dtype, or weights or cameras not
                floating-point.
            ShapeError: if a shape is wrong.
            ValueError: if there are fewer than eight rows (five with cameras, four for a homography), the views do not
                pair up, a weight is negative or not finite, only one camera is given, or one is not a finite and
                invertible (3, 3) matrix with a last row of (0, 0, w > 0).
        """
        check_cameras(K1, K2)
        if K1 is not None and not isinstance(self.model, Fundamental):
            text = f"K1 and K2 make a fundamental matrix an essential one, got model {self.model.name}"
            raise ValueError(f"{text}: leave them out")
        cameras = None if K1 is None or K2 is None else (K1, K2)
        least = self.model.min_points if cameras is None else Essential.sample_size
        check_matches(points1, points2, weights, least)
        threads = one_thread() if points1.device.type == "cpu" else nullcontext()
        # Inference mode is faster, but a normaliser may cache tensors, which could not be used in training then.
        gradients = torch.inference_mode() if self.normalizer is None else torch.no_grad()
        with threads, without_autocast(points1), gradients:
            kept = torch.ones_like(points1[:, 0], dtype=torch.bool)
            # `not <=` is also true of NaN, unlike `>`.
            if not torch.maximum(points1.abs().max(), points2.abs().max()) <= MAX_MEDIAN_DISTANCES * self.inl_th:
                kept = finite_and_bounded(points1, points2, self.inl_th)
            best = distinct_points(points1[kept], points2[kept], None if weights is None else weights[kept])
            kept = kept.masked_scatter(kept, best)
            weights = None if weights is None else weights[kept]
            result = self._estimate(points1[kept], points2[kept], weights, cameras, least)
            inliers = torch.zeros_like(kept).masked_scatter(kept, result.inliers)
        E_mat = None if result.E_mat is None else result.E_mat.clone()
        return result._replace(F_mat=result.F_mat.clone(), inliers=inliers.clone(), E_mat=E_mat)

    def _estimate(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None, cameras: Cameras | None, least: int
    ) -> RansacResult:
        """Estimate from matches that are finite, bounded, and one on each point."""
        if (len(points1) if weights is None else int((weights > 0).sum())) < least:
            return _failure(points1, 0, cameras)
        x1, x2 = (points.to(solve_dtype(points.device)) for points in (points1, points2))
        seed = int(torch.randint(2**62, ())) if self.seed is None else self.seed
        generator = torch.Generator(x1.device).manual_seed(seed)
        size = least if self.normalizer is not None else min(least, self.model.sample_size)
        sampler: Sampler = UniformSampler(len(x1), x1.device, size)
        if weights is not None:
            sampler = WeightedSampler(weights.to(x1), size)
        scored: Tensor | slice = slice(None)
        if len(x1) >= 2 * self.model.prescored:
            scored = torch.randperm(len(x1), generator=generator, device=x1.device)[:MAX_SCORED]
        scorer = PairScorer(x1, x2, self.inl_th, self.model, scored)
        scorer = scorer if cameras is None else scorer.of_cameras(*cameras)
        pool, drawn = self._search(scorer, sampler, generator)
        if self.refine and type(scorer.model) is Fundamental:  # not a model of essential matrices, or of one's own
            pool = try_dominant_plane(scorer, pool, generator)
        if len(pool.F_mat) == 0:
            return _failure(points1, drawn, cameras)
        state = fit_final(scorer, pool) if self.refine else scorer.model.state(pool.F_mat[:1])
        if bool(scorer.model.is_degenerate(state)):
            return _failure(points1, drawn, cameras)
        F = state.matrix()
        distances = scorer.distances(F)[0]
        if int((inliers := distances <= self.inl_th).sum()) <= least:
            return _failure(points1, drawn, cameras)
        score = float((1 - (distances / self.inl_th).square()).clamp(min=0).nansum())
        F_mat = unit_matrix(scorer.to_pixels(F)[0]).to(points1.dtype)
        E_mat = None
        if isinstance(scorer.model, Essential):
            pose = state if isinstance(state, Calibrated) else scorer.model.state(F)
            E_mat = pose.essential()[0].to(points1.dtype)
        return RansacResult(F_mat, inliers, drawn, score, E_mat)

    def _search(self, scorer: PairScorer, sampler: Sampler, generator: torch.Generator) -> tuple[Hypotheses, int]:
        """Return the best hypotheses, best first, after drawing enough minimal samples, and how many were drawn."""
        pool, model = Hypotheses(scorer.x1.new_zeros(0, 3, 3), scorer.x1.new_zeros(0)), scorer.model
        most = self.max_samples - (self.max_samples // 10 if self.refine else 0)
        batch, drawn, needed, start, near_best = FIRST_BATCH, 0, most, time.perf_counter(), False
        while drawn < needed:
            if self.max_seconds is not None and drawn and time.perf_counter() - start > self.max_seconds:
                break
            source = sampler
            if near_best and len(pool.F_mat):
                source = sampler.among(scorer.distances(pool.F_mat[:1])[0] < NEAR * self.inl_th)
            rows = source.draw(min(batch, needed - drawn), generator)
            drawn, batch = drawn + len(rows), min(4 * batch, model.max_batch)
            F_mat = solve_minimal_samples(scorer, rows, self.model, self.normalizer)
            found = scorer.best(scorer.shortlist(F_mat) if self.refine else F_mat, model.pool_size)
            pool = pool.join(found, model.pool_size)
            needed = needed if near_best else min(most, self._samples_needed(pool, scorer, sampler))
            # The final fit optimises the pool that ends the search; of essential matrices, only the best one.
            fitted_later = drawn >= needed and not isinstance(model, Essential)
            if self.refine and not fitted_later and len(found.F_mat):
                pool = pool.join(self._optimize(scorer, found.F_mat), model.pool_size)
                needed = needed if near_best else min(most, self._samples_needed(pool, scorer, sampler))
            if self.refine and not near_best and drawn >= needed:
                few = len(pool.F_mat) > 0 and scorer.inliers(pool.F_mat[:1]).to(scorer.x1).mean() < FEW_INLIERS
                if few or drawn >= most:
                    near_best, needed = True, min(drawn + max(model.max_batch, drawn // 9), self.max_samples)
        return pool, drawn

    def _optimize(self, scorer: PairScorer, M: Tensor) -> Hypotheses:
        """Return the best of the matrices fitted to their inliers, the first of them also by the normaliser."""
        if self.normalizer is not None and scorer.model is self.model:
            points1, points2 = (points[None, scorer.rows] for points in scorer.pixels)
            problem = LinearProblem.from_points(points1, points2, scorer.inliers(M[:1]).to(M), self.model)
            M = torch.cat([scorer.from_pixels(solve_linear(problem, self.normalizer)), M])
        return optimize_locally(scorer, M)

    def _samples_needed(self, pool: Hypotheses, scorer: PairScorer, sampler: Sampler) -> int:
        """Return how many samples contain an outlier-free one with the confidence, if the best matrix is right."""
        confidence = scorer.model.confidence if self.confidence is None else self.confidence
        if len(pool.F_mat) == 0 or confidence == 1:
            return self.max_samples
        hit_rate = min(sampler.hit_rate(scorer.inliers(pool.F_mat[:1])[0], scorer.rows), 1 - 1e-9)
        if hit_rate == 0:
            return self.max_samples
        return math.ceil(min(self.max_samples, math.log(1 - confidence) / math.log1p(-hit_rate)))


def _failure(points: Tensor, drawn: int, cameras: Cameras | None) -> RansacResult:
    inliers = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    E_mat = None if cameras is None else points.new_zeros(3, 3)
    return RansacResult(points.new_zeros(3, 3), inliers, drawn, 0.0, E_mat)

r"""RANSAC whose minimal samples and refits run through a normaliser."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from numbers import Integral, Real
from typing import Literal

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor, nn

from kornia_learnnorm.estimators.epipolar_cost import EpipolarCost
from kornia_learnnorm.estimators.fundamental import Normalizer, check_rank2, find_fundamental
from kornia_learnnorm.estimators.minimal import are_determined, solve_samples
from kornia_learnnorm.estimators.refinement import minimize
from kornia_learnnorm.estimators.robust_losses import Factor, GemanMcClure, Loss, Truncated, sampson_factor
from kornia_learnnorm.geometry.checks import solve_dtype
from kornia_learnnorm.geometry.manifold import Rank2, decompose
from kornia_learnnorm.ransac.constrained_fit import constrained_fit
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE, ProsacSampler, Sampler, UniformSampler
from kornia_learnnorm.ransac.scoring import COARSE, FARTHEST, Hypotheses, PairScorer, in_proportion
from kornia_learnnorm.ransac.threads import one_thread

__all__ = ["RANSAC"]

BATCHES = (64, 1024)  # samples in the first batch, and in the largest
SCORED = 4096  # correspondences, drawn once, that hypotheses are scored on, at most
POOL = 8  # hypotheses of a batch that are optimised,
SCALES = (3.0, 2.0, 1.5, 1.0, 1.0)  # of the threshold in each step: a noisy sample sees few of its inliers
FINAL_POOL = 4  # the same in the end, first to their inliers, then
LOSS_SCALE = 0.7  # on a loss of this times the threshold:
REWEIGHTINGS = 3  # so many steps of least squares,
TOLERANCE = 1e-3  # which end close enough to the optimum where they have this share of the cost to gain; elsewhere
STEPS = 10  # so many of Levenberg-Marquardt, at most,
COSINE = 1e-3  # until the derivatives are this close to orthogonal


class RANSAC(nn.Module):
    r"""Robust estimation of a fundamental matrix from correspondences with outliers.

    Minimal samples of eight run through :func:`~kornia_learnnorm.find_fundamental` with any normaliser, a thousand at
    once, and MSAC scores them. The best of each batch are fitted to their inliers by reweighted least squares, and
    the first also by the normaliser (local optimisation); the inliers of the best matrix so far say how many samples
    are still needed. In the end the best few are fitted on Geman and McClure's loss, and the one of least cost goes on
    to Levenberg-Marquardt where least squares have not converged.

    PyTorch is held to one thread meanwhile, see :func:`~kornia_learnnorm.ransac.threads.one_thread`.

    Its call takes and returns what that of ``kornia.geometry.RANSAC(model_type="fundamental_8pt")`` does. What differs:
    the arguments below, of which ``max_iter`` counts samples; the matrix has unit Frobenius norm; and weights steer the
    sampling.

    Args:
        normalizer: maps ``(points1, points2, weights)`` to the transforms of both views, in whose coordinates matrices
            are projected to rank 2. When not given, none is needed, since ``rank2`` is ``"optimal"``: that takes fewer
            samples than any normalisation, and a fraction of the time.
        inl_th: largest distance of an inlier, pixels.
        max_iter: largest number of minimal samples.
        max_seconds: time after which no further batch of samples, 64 at first and up to 1,024, is drawn; with it the
            result depends on the machine.
        confidence: probability, in :math:`(0, 1]`, that sampling does not stop before a sample without outliers, if the
            best matrix so far has found all inliers; 1 draws all ``max_iter`` samples. It is close to 1 by default,
            since a sample must not have much noise either.
        factor: the distance, :func:`~kornia_learnnorm.estimators.robust_losses.sampson_factor` or
            :func:`~kornia_learnnorm.estimators.robust_losses.symmetric_factor` (Fan et al., Eq. 7).
        rank2: how the singularity constraint is enforced, see :func:`~kornia_learnnorm.find_fundamental`.
        refine: whether to optimise; otherwise the result is the minimal sample of highest score.
        sampler: what weights do: :class:`~kornia_learnnorm.ransac.samplers.ProsacSampler` or
            :class:`~kornia_learnnorm.ransac.samplers.WeightedSampler`.
        seed: makes every call on the same input and device give the same result; None draws from PyTorch's generator.

    Raises:
        TypeError: if ``normalizer``, ``factor`` or ``sampler`` cannot be called, or a number is none.
        ValueError: if a number is out of its range or ``rank2`` is neither of its values.

    Reference:
        P. Torr, A. Zisserman, MLESAC, CVIU 2000 (MSAC); O. Chum, J. Matas, J. Kittler, Locally optimized RANSAC, DAGM
        2003; O. Chum, J. Matas, Matching with PROSAC, CVPR 2005.

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
        max_iter: int = 50_000,
        max_seconds: float | None = None,
        confidence: float = 0.999999,
        factor: Factor = sampson_factor,
        rank2: Literal["optimal"] | None = None,
        refine: bool = True,
        sampler: Callable[[Tensor], Sampler] = ProsacSampler,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        for name, value in {"inl_th": inl_th, "confidence": confidence, "max_seconds": max_seconds}.items():
            if not _is_number(value) and (value is not None or name != "max_seconds"):
                raise TypeError(f"{name} must be a number, got {value!r}")
        if not 1e-12 <= inl_th <= 1e12:
            raise ValueError(f"inl_th must be a positive number of pixels, from 1e-12 to 1e12, got {inl_th}")
        if not _is_whole(max_iter) or max_iter < 1:
            raise ValueError(f"max_iter must be a whole number of samples, at least 1, got {max_iter}")
        if max_seconds is not None and not max_seconds > 0:
            raise ValueError(f"max_seconds must be positive or None, got {max_seconds}")
        if seed is not None and not _is_whole(seed):
            raise TypeError(f"seed must be a whole number or None, got {seed!r}")
        if seed is not None and not 0 <= seed < 2**63:
            raise ValueError(f"seed must lie in [0, 2^63), got {seed}")
        if not 0 < confidence <= 1:
            raise ValueError(f"confidence must lie in (0, 1], got {confidence}")
        if normalizer is not None and (isinstance(normalizer, type) or not callable(normalizer)):
            raise TypeError(f"normalizer must be a module or function, got {normalizer!r}")
        check_rank2(rank2)
        for name, function in (("factor", factor), ("sampler", sampler)):
            if not callable(function):
                raise TypeError(f"{name} must be a function or a class, got {function!r}")
        self.normalizer = normalizer
        self.rank2: Literal["optimal"] | None = "optimal" if normalizer is None else rank2
        self.inl_th, self.max_iter, self.max_seconds, self.confidence = inl_th, max_iter, max_seconds, confidence
        self.factor, self.refine, self.sampler, self.seed = factor, refine, sampler, None if seed is None else int(seed)

    def forward(self, kp1: Tensor, kp2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        r"""Estimate the fundamental matrix of one image pair.

        Args:
            kp1: pixels in the first image with shape :math:`(N, 2)`, :math:`N \ge 8`, float32 or float64. Rows that are
                not finite, or a million times as far from the others as these from each other, are no inliers.
            kp2: pixels in the second image with shape :math:`(N, 2)`.
            weights: optional non-negative scores :math:`(N,)`, higher is better, such as one minus Lowe's ratio. They
                steer sampling only; zero is never sampled.

        Returns:
            the matrix :math:`(3, 3)` of unit Frobenius norm, :math:`x_2^\top F x_1 = 0`, and the inliers :math:`(N,)`,
            boolean, which are those of the matrix before it is rounded to float32. Neither has a gradient. Zeros and no
            inliers where no matrix of rank 2 was found that has more than eight of them, and where fewer than eight
            weights are positive. Where no sample determines a matrix, as of a plane without noise or a camera that does
            not move, it is one of those that fit.

        Raises:
            TypeError: if the points are not floating-point tensors of one dtype, or the weights not floating-point.
            ShapeError: if a shape is wrong.
            ValueError: if there are fewer than eight rows, the views do not pair up, or a weight is negative or not
                finite.

        """
        _check(kp1, kp2, weights)
        device = kp1.device.type
        precision = torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()
        # Inference mode is faster, but what a normaliser keeps of it would be of no use in training.
        no_gradient = torch.inference_mode() if self.normalizer is None else torch.no_grad()
        with one_thread(), precision, no_gradient:
            F_mat, inliers = self._estimate(kp1, kp2, weights)
        return F_mat.clone(), inliers.clone()

    def _estimate(self, kp1: Tensor, kp2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        if torch.maximum(kp1.abs().max(), kp2.abs().max()) <= FARTHEST * self.inl_th:  # and no NaN
            return self._estimate_kept(kp1, kp2, weights)
        kept = in_proportion(kp1, kp2, self.inl_th)
        F_mat, inliers = self._estimate_kept(kp1[kept], kp2[kept], None if weights is None else weights[kept])
        return F_mat, torch.zeros_like(kept).masked_scatter(kept, inliers)

    def _estimate_kept(self, kp1: Tensor, kp2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        if (len(kp1) if weights is None else int((weights > 0).sum())) < SAMPLE_SIZE:
            return _failure(kp1)
        x1, x2 = (kp.to(solve_dtype(kp.device)) for kp in (kp1, kp2))
        generator = torch.Generator(kp1.device)
        generator.manual_seed(int(torch.randint(2**62, ())) if self.seed is None else self.seed)
        sampler = UniformSampler(len(x1), x1.device) if weights is None else self.sampler(weights.to(x1))
        scored: Tensor | slice = slice(None)
        if len(x1) >= 2 * COARSE:
            scored = torch.randperm(len(x1), generator=generator, device=x1.device)[:SCORED]
        scorer = PairScorer(x1, x2, self.inl_th, self.factor, scored)
        pool = self._search(scorer, sampler, generator)
        if len(pool.F_mat) == 0:
            return _failure(kp1)
        state = self._polish(scorer, pool) if self.refine else decompose(pool.F_mat[:1])
        if state.A.det().abs() < 1e-9:
            return _failure(kp1)
        F = state.matrix()
        inliers = scorer.distances(F[0]) <= self.inl_th
        F_mat = scorer.to_pixels(F)[0]
        F_mat = (F_mat / torch.linalg.vector_norm(F_mat)).to(kp1.dtype)
        return (F_mat, inliers) if int(inliers.sum()) > SAMPLE_SIZE else _failure(kp1)

    def _search(self, scorer: PairScorer, sampler: Sampler, generator: torch.Generator) -> Hypotheses:
        """Return the best hypotheses that enough minimal samples give, best first."""
        pool = Hypotheses(scorer.x1.new_zeros(0, 3, 3), scorer.x1.new_zeros(0))
        (batch, largest), drawn, needed, start = BATCHES, 0, self.max_iter, time.perf_counter()
        while drawn < needed:
            if self.max_seconds is not None and drawn and time.perf_counter() - start > self.max_seconds:
                break
            rows = sampler.draw(min(batch, needed - drawn), generator)
            drawn, batch = drawn + len(rows), min(4 * batch, largest)
            F_mat = self._solve(scorer, rows)
            found = scorer.best(scorer.shortlist(F_mat) if self.refine else F_mat, POOL)
            pool = pool.join(found, POOL)
            needed = self._samples_needed(pool, scorer, sampler)
            # A pool that ends the search is optimised anyway.
            if self.refine and drawn < needed and len(found.F_mat):
                pool = pool.join(self._optimize(scorer, found.F_mat), POOL)
                needed = self._samples_needed(pool, scorer, sampler)
        return pool

    def _solve(self, scorer: PairScorer, rows: Tensor) -> Tensor:
        """Return the matrices of the minimal samples (K, 8) that determine one; of all, if none does."""
        x1, x2 = scorer.samples(rows)
        if self.normalizer is None:
            F_mat = solve_samples(x1, x2, 0.01 * self.inl_th)
            if len(F_mat):
                return F_mat
        else:
            determined = are_determined(x1, x2, 0.01 * self.inl_th)
            rows = rows[determined] if bool(determined.any()) else rows
        points1, points2 = (points[rows] for points in scorer.pixels)
        return scorer.from_pixels(find_fundamental(points1, points2, None, self.normalizer, self.rank2))

    def _optimize(self, scorer: PairScorer, F_mat: Tensor) -> Hypotheses:
        """Fit matrices to their inliers, and with a normaliser the first by it, and rate what comes out."""
        if self.normalizer is not None:
            inliers = scorer.inliers(F_mat[:1]).to(F_mat)
            points1, points2 = (points[None, scorer.rows] for points in scorer.pixels)
            refit = find_fundamental(points1, points2, inliers, self.normalizer, self.rank2)
            F_mat = torch.cat([scorer.from_pixels(refit), F_mat])
        losses = [Truncated(scale * self.inl_th) for scale in SCALES]
        x1, x2 = scorer.x1[:, scorer.rows], scorer.x2[:, scorer.rows]
        return scorer.best(constrained_fit(x1, x2, F_mat, losses, self.factor).F_mat, POOL)

    def _polish(self, scorer: PairScorer, pool: Hypotheses) -> Rank2:
        """Return the optimum (1, 3, 3) on all correspondences that is next to the best of the pool."""
        loss = GemanMcClure(LOSS_SCALE * self.inl_th)
        losses: list[Loss] = [Truncated(self.inl_th), *REWEIGHTINGS * [loss]]
        fit = constrained_fit(scorer.x1, scorer.x2, pool.F_mat[:FINAL_POOL], losses, self.factor)
        best = int(fit.cost.argmin())
        state, cost = decompose(fit.F_mat[best : best + 1]), float(fit.cost[best])
        if not float(fit.gain[best]) <= TOLERANCE:
            ones = torch.ones_like(scorer.x1[:1])
            objective = EpipolarCost(scorer.x1[None], scorer.x2[None], ones, self.factor, loss)
            optimum = minimize(objective, state, STEPS, COSINE)[1]
            state, cost = optimum.state, float(optimum.cost[0])
        # The loss is nowhere above that of MSAC, so that the pool's best has no more of it than this but for a margin.
        share = 1 - float(pool.score[0]) / scorer.terms.shape[-1]
        most = self.inl_th**2 * (1.1 * share * scorer.x1.shape[-1] + SAMPLE_SIZE)
        return state if cost <= most else decompose(pool.F_mat[:1])

    def _samples_needed(self, pool: Hypotheses, scorer: PairScorer, sampler: Sampler) -> int:
        """Return how many samples hold one without outliers with the confidence, if the best matrix is right."""
        if len(pool.F_mat) == 0 or self.confidence == 1:
            return self.max_iter
        hit_rate = min(sampler.hit_rate(scorer.inliers(pool.F_mat[:1])[0], scorer.rows), 1 - 1e-9)
        if hit_rate == 0:
            return self.max_iter
        return math.ceil(min(self.max_iter, math.log(1 - self.confidence) / math.log1p(-hit_rate)))


def _failure(kp: Tensor) -> tuple[Tensor, Tensor]:
    return kp.new_zeros(3, 3), torch.zeros(len(kp), dtype=torch.bool, device=kp.device)


def _is_number(value: object) -> bool:
    return not isinstance(value, bool) and isinstance(value, Real)


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _check(kp1: Tensor, kp2: Tensor, weights: Tensor | None) -> None:
    for name, points in (("kp1", kp1), ("kp2", kp2)):
        if not isinstance(points, Tensor) or points.dtype not in (torch.float32, torch.float64):
            got = points.dtype if isinstance(points, Tensor) else type(points)
            raise TypeError(f"{name} must be a float32 or float64 tensor, got {got}")
        KORNIA_CHECK_SHAPE(points, ["N", "2"])
    if kp1.dtype != kp2.dtype:
        raise TypeError(f"kp1 and kp2 must have one dtype, got {kp1.dtype} and {kp2.dtype}")
    if kp1.shape != kp2.shape:
        raise ValueError(f"kp1 and kp2 must pair up, got shapes {[*kp1.shape]} and {[*kp2.shape]}")
    if len(kp1) < SAMPLE_SIZE:
        raise ValueError(f"at least {SAMPLE_SIZE} correspondences are needed, got {len(kp1)}")
    if weights is None:
        return
    if not isinstance(weights, Tensor) or not weights.is_floating_point():
        got = weights.dtype if isinstance(weights, Tensor) else type(weights)
        hint = "; of a boolean mask, take the rows" if got == torch.bool else ""
        raise TypeError(f"weights must be a floating-point tensor, got {got}{hint}")
    if weights.shape != kp1.shape[:1]:
        raise ValueError(f"weights must have shape {[*kp1.shape[:1]]}, got {[*weights.shape]}")
    known = weights[(kp1.isfinite() & kp2.isfinite()).all(-1)]
    if not bool(known.isfinite().all()) or bool((known < 0).any()):
        raise ValueError("weights must be finite and not negative where the points are finite")

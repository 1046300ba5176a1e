r"""Fundamental matrices of scenes where most matches lie on one plane.

Samples from the plane fit any epipole, so that the best of them may take chance agreement for parallax. The homography
:math:`H` of the plane and two matches off it determine the epipole :math:`e_2`, since the line through :math:`H x_1`
and :math:`x_2` passes through it, and :math:`F = [e_2]_\times H` (O. Chum, T. Werner, J. Matas, Two-view geometry
estimation unaffected by a dominant plane, CVPR 2005). Matrices are in the coordinates of a scorer.
"""

import math
from typing import cast

import torch
from kornia.geometry.epipolar import cross_product_matrix
from torch import Tensor

from kornia_learnnorm.estimators.robust_losses import Truncated
from kornia_learnnorm.geometry.constrained_fit import Fit
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.homography import Homography
from kornia_learnnorm.ransac.fits import optimize_locally
from kornia_learnnorm.ransac.samplers import UniformSampler
from kornia_learnnorm.ransac.scoring import Hypotheses, PairScorer

PLANES = 64  # samples of three inliers that are tried; one in five is on a plane that holds 60 % of them
ON_PLANE = 3.0  # thresholds; matches this near the homography are those of the plane
MIN_PLANAR_SHARE = 0.6  # of the inliers on one plane; below, no plane dominates
# Of the matches off the plane, and the log of the chance that so many agree with an epipole; a matrix that more agree
# with has parallax. Errors of matches on a plane are not independent: the chance is larger than computed.
MAX_EXPLAINED, MIN_LOG_CHANCE = 0.5, -30.0
PLANE_SCALES = (3.0, 1.5, 1.0)  # thresholds of the steps of the homography's fit
OFF_PLANE = 2.0  # thresholds; a match that the homography misses by more has parallax
MIN_OFF_PLANE = 3  # matches off the plane that must agree on an epipole, since any two determine one
EPIPOLES = 1000  # pairs of matches off the plane that are tried
FITTED = 4  # matrices of these that are fitted to their inliers
MIN_EXPECTED = 1e-9  # inliers by chance, of matches that the plane moves to infinity
MAX_COMPARED = 256  # matches on which planes and epipoles are compared
MIN_SCORE_GAIN = 5.0  # inliers; of the matrix of a plane and parallax over the best of the samples, to be kept


def try_dominant_plane(scorer: PairScorer, pool: Hypotheses, generator: torch.Generator) -> Hypotheses:
    """Return hypotheses, best first, with that of a plane and parallax where a plane holds most inliers of the best."""
    if len(pool.F_mat) == 0 or (H := find_dominant_plane(scorer, pool.F_mat[:1], generator)) is None:
        return pool
    found = fit_parallax(scorer, H, generator)
    if float(found.score.sum() - pool.score[0]) <= MIN_SCORE_GAIN:
        return pool
    return pool.join(found, scorer.model.pool_size)


def find_dominant_plane(scorer: PairScorer, F: Tensor, generator: torch.Generator) -> Tensor | None:
    r"""Return the homography (3, 3) of the plane that holds most inliers of a matrix (1, 3, 3), or None.

    None where no plane holds 60 % of them, or where most of the matches off it, or more than would by chance, agree
    with the matrix. Of the homographies :math:`[e_2]_\times F - e_2 v^\top` that agree with :math:`F`, three matches
    determine one (R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, result 13.6).
    """
    inliers = scorer.inliers(F)[0]
    x1, x2 = (x[:, scorer.rows] for x in (scorer.x1, scorer.x2))
    inlying1, inlying2 = x1[:, inliers], x2[:, inliers]
    e2 = torch.linalg.svd(F[0])[0][:, 2]
    A = cross_product_matrix(e2[None])[0] @ F[0]
    rows = torch.randint(inlying1.shape[1], (PLANES, 3), generator=generator, device=x1.device)
    first, second = inlying1.mT[rows], inlying2.mT[rows]
    across = torch.linalg.cross(second, e2.expand_as(second))
    depth = (torch.linalg.cross(second, first @ A.mT) * across).sum(-1) / across.square().sum(-1)
    v = (torch.linalg.inv_ex(first)[0] @ depth[..., None])[..., 0]
    H = A - e2[:, None] * v[:, None]
    every = math.ceil(inlying1.shape[1] / MAX_COMPARED)
    some1, some2 = inlying1[:, ::every], inlying2[:, ::every]
    on_plane = offsets(H.float(), some1.float(), some2.float()) < ON_PLANE * scorer.threshold
    share, best = on_plane.to(x1).mean(-1).max(0)
    if float(share) <= MIN_PLANAR_SHARE:
        return None
    off = offsets(H[best], x1, x2) / scorer.threshold
    if float(inliers[off > ON_PLANE].to(x1).mean()) > MAX_EXPLAINED or log_chance(off, inliers) < MIN_LOG_CHANCE:
        return None
    losses = [Truncated(scale * scorer.threshold) for scale in PLANE_SCALES]
    fit = Homography().reweighted_fit(some1, some2, unit_matrix(H[best][None]), losses)
    return cast(Fit, fit).F_mat[0]


def offsets(H: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """Return the distances (*, N) of x2 (3, N) from where homographies (*, 3, 3) move x1, pixels."""
    u, v, w = (H @ x1).unbind(-2)
    scale = x2[2] / w
    return torch.hypot(u * scale - x2[0], v * scale - x2[1]).nan_to_num_(nan=math.inf)


def log_chance(distance: Tensor, inliers: Tensor) -> float:
    r"""Return the log of the number of epipoles that have as many inliers off the plane by chance, at most.

    A match at the distance of :math:`r` thresholds (M,) from the plane, in a random direction from it, is an inlier
    with probability :math:`2 / \pi \arcsin(1 / r)`. Chernoff's bound, times the epipoles that two matches determine.
    """
    off = distance > ON_PLANE
    number, agree = int(off.sum()), int(inliers[off].sum())
    expected = max(2 / math.pi * float(torch.asin(1 / distance[off]).sum()), MIN_EXPECTED)
    excess = agree * math.log(agree / expected) - agree + expected if agree > expected else 0.0
    return 2 * math.log(max(number, 1)) - excess


def fit_parallax(scorer: PairScorer, H: Tensor, generator: torch.Generator) -> Hypotheses:
    """Return the best matrix of the homography (3, 3) of a plane and an epipole; none of too few matches off it."""
    x1, x2 = (x[:, scorer.rows] for x in (scorer.x1, scorer.x2))
    off = (offsets(H, x1, x2) > OFF_PLANE * scorer.threshold).nonzero()[:, 0]
    if len(off) < MIN_OFF_PLANE:
        return Hypotheses(H.new_zeros(0, 3, 3), H.new_zeros(0))
    rows = off[UniformSampler(len(off), off.device, 2).draw(EPIPOLES, generator)]
    first, second = x1.mT[rows], x2.mT[rows]
    e2 = torch.linalg.cross(*torch.linalg.cross(first @ H.mT, second).unbind(1))
    F = unit_matrix(cross_product_matrix(e2) @ H)
    best = scorer.best(F, FITTED, off[:: math.ceil(len(off) / MAX_COMPARED)])  # the matches of the plane fit all
    if len(best.F_mat):
        best = optimize_locally(scorer, best.F_mat)
    return Hypotheses(*(values[:1] for values in best))

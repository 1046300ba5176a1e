r"""The homography of a scene that is mostly a plane, and the parallax of the rest.

Offsets that one radial distortion of both images explains do not count as parallax. Points are pixels (N, 2) in
float64, matrices (3, 3), and thresholds pixels.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import left_to_right_epipolar_distance
from torch import Tensor

from kornia_learnnorm.data.images import Size, import_cv2
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.transforms import affine_transform
from kornia_learnnorm.models.two_view_model import Residuals

OFF_PLANE = 2.0  # thresholds, or standard deviations; a match that the homography misses by more is off the plane
MIN_PARALLAX_INLIERS = 3  # matches off the plane that must agree on an epipole, since any two determine one
MAX_DISTORTION = 0.2  # of the radius at the corners of an image
MAX_LM_STEPS = 10
TOLERANCE = 1e-6  # cosine of offsets and derivatives at which Levenberg-Marquardt has converged
MIN_PLANAR_SHARE = 0.5  # of the inliers on one homography; below, the scene is no plane
NOISE = (1.0, 0.5, 0.25, 0.125)  # thresholds; noise that is tried, SIFT errs by 0.1 px or so
MAX_LOG_CHANCE_PARALLAX = -3.0  # log10 of the expected number of epipoles that chance gives as much parallax
NEARLY_PLANE = 0.8  # of the inliers within the threshold of one homography; above, signs of offsets must agree, too
MIN_SIGNS, MAX_SIGNS = 100, 2000  # matches off the plane; fewer are too far apart to share a side, more are thinned
AT_INFINITY = 1e6  # halves of the diagonal; offset of a point that the homography moves to infinity


class Parallax(NamedTuple):
    """How much of the matches one homography explains, with the radial distortion that suits it best."""

    near: float  # share of the inliers of F within the threshold of it
    wide: float  # share of the inliers of F within three thresholds of it
    log_chance: float  # log10 of the expected number of epipoles that chance gives as much parallax, at most 0

    @property
    def planar(self) -> bool:
        """Whether the scene is a plane or the camera only rotates, so that the matches do not determine F."""
        return self.wide > MIN_PLANAR_SHARE and self.log_chance > MAX_LOG_CHANCE_PARALLAX

    def describe(self, threshold: float) -> str:
        """Return one sentence for the user."""
        text = f"one homography explains {self.near:.0%} of the inliers within {threshold:g} px and {self.wide:.0%} "
        text += f"within {3 * threshold:g} px"
        if self.planar:
            return f"{text} (a plane, or a camera that only rotates), and the rest do not determine the epipole"
        return f"{text}; the rest determine the epipole"


def measure_parallax(
    points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, size1: Size, size2: Size
) -> Parallax:
    """Return the parallax of matches (N, 2) of a fundamental matrix (3, 3)."""
    inliers = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
    H = find_main_plane(points1[inliers], points2[inliers], threshold)
    if H is None:
        return Parallax(0.0, 0.0, 0.0)
    offsets = offsets_from_plane(points1, points2, H, size1, size2, threshold)
    off_plane = offsets.norm(dim=-1)
    near, wide = (float((off_plane[inliers] < k * threshold).double().mean()) for k in (1, 3))
    evidence = parallax_evidence(points1, points2, F_mat, off_plane, threshold)
    if near >= NEARLY_PLANE and evidence <= MAX_LOG_CHANCE_PARALLAX:
        evidence = max(evidence, sign_evidence(points1, points2, F_mat, offsets, threshold))
    return Parallax(near, wide, min(0.0, evidence))


def find_main_plane(points1: Tensor, points2: Tensor, threshold: float) -> Tensor | None:
    """Return the homography that explains most matches within a threshold, by OpenCV's MAGSAC, or None."""
    cv2 = import_cv2()
    try:
        H = cv2.findHomography(points1.numpy(), points2.numpy(), cv2.USAC_MAGSAC, threshold)[0]
    except cv2.error:  # OpenCV 4 raises when too few points are left to sample from
        H = None
    return None if H is None or not np.isfinite(H).all() else torch.from_numpy(H).double()


def parallax(points1: Tensor, points2: Tensor, H: Tensor) -> Tensor:
    """Return the distances (*, N) of points2 from where homographies (*, 3, 3) move points1, pixels."""
    moved = convert_points_to_homogeneous(points1) @ H.mT
    distance: Tensor = (moved[..., :2] / moved[..., 2:] - points2).norm(dim=-1)
    return distance.nan_to_num(nan=math.inf)


def parallax_evidence(
    points1: Tensor, points2: Tensor, F_mat: Tensor, distance: Tensor, threshold: float, noises: Sequence[float] = NOISE
) -> float:
    r"""Return log10 of the expected number of epipoles with as much evidence among matches without parallax.

    Without parallax, a match at the distance :math:`r` from :math:`H x_1` lies in any direction from it. With parallax,
    and noise of a standard deviation :math:`\sigma`, its distance :math:`d` from its epipolar line is more likely by

    .. math:: \exp(-d^2 / 2 \sigma^2) \, / \, \big(\exp(-r^2 / 4 \sigma^2) \, I_0(r^2 / 4 \sigma^2)\big)

    The evidence is this likelihood ratio over all matches off the plane, a share of which has parallax. It is that of
    the likeliest noise, out of some shares of the threshold, and share, out of ten. Two matches determine an epipole,
    so the two that agree best do not count. Of one epipole, chance gives a ratio of :math:`\Lambda` with a probability
    of at most :math:`1 / \Lambda` (Markov's inequality).

    Matches are pixels (N, 2); ``distance`` is :math:`r`, (N,), that of :func:`parallax` or the length
    of :func:`offsets_from_plane`; ``noises`` are standard deviations, as shares of the threshold.
    """
    across = left_to_right_epipolar_distance(points1[None], points2[None], F_mat[None])[0]
    shares, evidence = torch.arange(0.05, 1.0, 0.1).to(F_mat), math.inf
    for noise in noises:
        off = (distance > OFF_PLANE * noise * threshold) & distance.isfinite()
        if (number := int(off.sum())) < MIN_PARALLAX_INLIERS:
            continue
        d, r = (value[off] / (noise * threshold) for value in (across, distance))
        ratio = (torch.exp(-d.square() / 2) / torch.special.i0e(r.square() / 4)).sort().values[:-2]
        gain = float(torch.log1p(shares[:, None] * (ratio - 1)).sum(-1).max())
        tests = len(noises) * len(shares) * number * (number - 1) / 2
        evidence = min(evidence, math.log10(tests) - gain / math.log(10))
    return evidence


def sign_evidence(points1: Tensor, points2: Tensor, F_mat: Tensor, offsets: Tensor, threshold: float) -> float:
    """Return log10 of the chance, at most, that errors of matches off the plane agree as much in sign.

    Detectors err along the edges of the image, so that on a facade errors alone have a direction in common (B. Zeisl
    et al., Estimation of location uncertainty for scale invariant feature points, BMVC 2009), but either sign. Parallax
    has that of its neighbours. Of the matches off the plane that agree with F, those nearest to each other, further
    than three thresholds apart, are compared (as in M. Schilling, Multivariate two-sample tests based on nearest
    neighbors, JASA 1986). These pairs are a forest, so that signs by chance agree independently: Chernoff's bound.

    ``offsets`` (N, 2) are those of :func:`offsets_from_plane`; the noise is any of :data:`NOISE`. Minus infinity where
    fewer than :data:`MIN_SIGNS` matches can be compared, whatever the noise.
    """
    across = left_to_right_epipolar_distance(points1[None], points2[None], F_mat[None])[0]
    distance, evidence, most = offsets.norm(dim=-1), 0.0, 0
    for least in (OFF_PLANE * noise * threshold for noise in NOISE):
        off = ((distance > least) & distance.isfinite() & (across < least)).nonzero()[:, 0]
        if (number := len(off)) < MIN_PARALLAX_INLIERS:
            continue
        most = max(most, number)
        off = off[:: 1 + number // MAX_SIGNS]
        apart = torch.cdist(points1[off], points1[off])
        apart, nearest = apart.where(apart > 3 * threshold, math.inf).min(1)
        pairs = torch.stack([torch.arange(len(off)), nearest], 1)[apart.isfinite()].sort(1).values
        pairs = torch.unique(pairs, dim=0)
        agree = float((offsets[off][pairs].prod(1).sum(-1) > 0).double().mean()) if len(pairs) else 0.0
        if agree > 0.5:
            information = sum(share * math.log10(2 * share) for share in (agree, 1 - agree) if share > 0)
            evidence = min(evidence, math.log10(len(NOISE)) - len(pairs) * information)
    return evidence if most >= MIN_SIGNS else -math.inf


def offsets_from_plane(
    points1: Tensor, points2: Tensor, H: Tensor, size1: Size, size2: Size, threshold: float
) -> Tensor:
    r"""Return the offsets (N, 2) of points2 from where the plane and a radial distortion move points1, pixels.

    A point at the radius :math:`r` from the centre of its image, in halves of the diagonal, is that of a pinhole camera
    at the radius :math:`r (1 + k r^2)`, with one :math:`|k| \le 0.2` for both images. It and the homography (3, 3)
    minimise Geman and McClure's loss at the scale of the threshold, from the given ones on. Points that are moved to
    infinity are infinitely far.
    """
    sizes = torch.tensor([size1, size2]).double()
    # To halves of the diagonal, from the centre.
    T1, T2 = affine_transform(torch.eye(2).double() / (sizes.norm(dim=1) / 2)[:, None, None], sizes / 2)
    x1, x2 = (T @ convert_points_to_homogeneous(x).mT[None] for T, x in ((T1, points1), (T2, points2)))
    H = T2 @ H @ torch.linalg.inv(T1)
    start = _Parameters(torch.cat([(H / torch.linalg.matrix_norm(H)).flatten(), H.new_zeros(1)])[None])
    cost = RobustCost(_BentPlane(), x1, x2, torch.ones_like(x1[:, 0]), GemanMcClure(threshold * float(T2[0, 0])))
    _, optimum = minimize(cost, start, MAX_LM_STEPS, TOLERANCE)
    offsets = _BentPlane().linearise(optimum.state.matrix(), x1, x2)[0].view(2, -1).mT
    return torch.where(offsets.abs() < AT_INFINITY, offsets / T2[0, 0], math.inf)


class _Parameters(NamedTuple):
    """Nine entries of a homography, and a distortion as a share of its bound, through artanh, (1, 10)."""

    values: Tensor

    def matrix(self) -> Tensor:
        return self.values

    def retract(self, step: Tensor) -> Self:
        return self._replace(values=self.values + step)

    def tangents(self) -> Tensor:
        return torch.eye(10).to(self.values)[None]


class _BentPlane(Residuals):
    components = 2

    def linearise(self, M: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the offsets (1, 2 N) of x2 from where x1 is moved, and their derivatives (1, 10, 2 N)."""
        H, bend = M[0, :9].view(3, 3), torch.tanh(M[0, 9])
        k, slope = MAX_DISTORTION * bend, MAX_DISTORTION * (1 - bend.square())
        u1, u2 = x1[0, :2], x2[0, :2]
        square1, square2 = u1.square().sum(0), u2.square().sum(0)
        ideal1 = torch.cat([u1 * (1 + k * square1), x1[0, 2:]])
        moved = H @ ideal1
        v, by_point = moved[:2] / moved[2], ideal1 / moved[2]
        # Over the local scale: a distortion that shrinks an image must not shrink its errors.
        stretch = 1 + 2 * k * square2
        offsets = (v - u2 * (1 + k * square2)) / stretch
        zero = torch.zeros_like(by_point)
        rows = [torch.cat([by_point, zero, -v[0] * by_point]), torch.cat([zero, by_point, -v[1] * by_point])]
        by_k = (H[:2, :2] @ (u1 * square1) - v * (H[2, :2] @ (u1 * square1))) / moved[2]
        by_k = (by_k - u2 * square2 - 2 * square2 * offsets) / stretch
        J = torch.cat([torch.stack(rows, 1) / stretch, slope * by_k[None]])
        # A point that is moved to infinity has no derivatives, so that it does not count.
        finite = (J.isfinite().all(0) & offsets.isfinite()).all(0)
        offsets, J = torch.where(finite, offsets, AT_INFINITY), torch.where(finite, J, 0.0)
        return offsets.flatten()[None], J.flatten(1)[None]

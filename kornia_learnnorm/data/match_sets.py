"""Sets of correspondences of image pairs: samples of eight, or matches with outliers, with their supervision."""

from typing import NamedTuple, Self

import torch
from torch import Generator, Tensor

from kornia_learnnorm.data.store import CorrespondenceStore, MaxRatio, passes_ratio_test
from kornia_learnnorm.estimators.linear import find_fundamental
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.normalizers.closed_form import Identity
from kornia_learnnorm.protocol import RATIO

RESIDUAL_BATCH = 8192  # samples solved at once, which bounds the memory


class MatchSets(NamedTuple):
    """Sets of N correspondences each, and further correspondences of the same image pairs, all in pixels."""

    points1: Tensor  # (B, N, 2)
    points2: Tensor  # (B, N, 2)
    heldout1: Tensor  # (B, M, 2), of the same pair; true inliers where the ground truth is known; M may be 0
    heldout2: Tensor  # (B, M, 2)
    pair: Tensor  # (B,) int64, index of the image pair in its source
    scores: Tensor | None = None  # (B, N), from 0 to 1, as 1 minus Lowe's ratio
    inliers: Tensor | None = None  # (B, N), one for inliers, zero for outliers, NaN where that is not known
    labelled: Tensor | None = None  # (B,) bool, whether the ground truth is known; None where it is known of no set
    K1: Tensor | None = None  # cameras, (B, 3, 3), NaN where unknown
    K2: Tensor | None = None
    E_mat: Tensor | None = None  # true essential matrices of unit Frobenius norm, (B, 3, 3), NaN where unknown
    image1: Tensor | None = None  # grey values, (B, 1, H, W), uint8
    image2: Tensor | None = None

    def select(self, rows: Tensor) -> Self:
        """Return the sets of the given rows (indices or mask)."""
        return type(self)._make(None if part is None else part[rows] for part in self)

    def with_residual_below(self, max_residual: float | None) -> Self:
        """Return the sets whose :func:`plain_residual` is below a limit in pixels; None keeps all."""
        return self if max_residual is None else self.select(plain_residual(self.points1, self.points2) < max_residual)


def plain_residual(points1: Tensor, points2: Tensor) -> Tensor:
    """Return the mean symmetric epipolar distance of samples (S, N, 2) under the un-normalised eight-point algorithm.

    It is in pixels, (S,), float64. Fan et al. drop samples of 60 px and more (section 4, training procedure).
    """
    identity, residuals = Identity(), []
    for x1, x2 in zip(*(torch.split(points.double(), RESIDUAL_BATCH) for points in (points1, points2)), strict=True):
        F_mat = find_fundamental(x1, x2, normalizer=identity)
        residuals.append(symmetric_epipolar_distance(x1, x2, F_mat).mean(-1))
    return torch.cat(residuals)


def draw_samples(
    store: CorrespondenceStore, generator: Generator, size: int = 8, max_ratio: MaxRatio = RATIO, num_heldout: int = 0
) -> MatchSets:
    """Draw samples: shuffle the correspondences of each pair and split them into sets of ``size``, without the rest.

    The samples are float32, in the order of the pairs. ``max_ratio`` is exclusive; None keeps all. The ``num_heldout``
    correspondences of a sample are drawn with replacement from its pair; they are not in the sample and pass the ratio
    test of 0.8, whatever ``max_ratio`` is; NaN where the pair has none. ValueError if ``size`` is below 8, or no pair
    fills a sample.
    """
    if size < 8:
        raise ValueError(f"a sample needs at least 8 correspondences, got size={size}")
    points = torch.cat([torch.from_numpy(store.points1), torch.from_numpy(store.points2)], -1)
    pair = torch.repeat_interleave(torch.arange(len(store)), torch.from_numpy(store.offsets).diff())
    rows = torch.from_numpy(passes_ratio_test(store.ratio, max_ratio)).nonzero()[:, 0]
    rows = rows[torch.randperm(len(rows), generator=generator)]
    rows = rows[torch.argsort(pair[rows], stable=True)]
    of_pairs = torch.split(rows, torch.bincount(pair[rows], minlength=len(store)).tolist())
    rows = torch.cat([own[: len(own) // size * size] for own in of_pairs]).reshape(-1, size)
    if len(rows) == 0:
        limit = "" if max_ratio is None else f" with ratio below {max_ratio}"
        raise ValueError(f"no pair of the store has {size} correspondences{limit}, which a sample needs")
    pool = torch.from_numpy(passes_ratio_test(store.ratio, RATIO)).nonzero()[:, 0]  # pair after pair
    count, sample_pair = torch.bincount(pair[pool], minlength=len(store)), pair[rows[:, 0]]
    first, passing = (count.cumsum(0) - count)[sample_pair], count[sample_pair]
    cut, rest = points[rows], points.new_full((len(rows), num_heldout, 4), torch.nan)
    drawable = passing > size
    samples, first, count = rows[drawable], first[drawable, None], passing[drawable, None]

    def draw() -> Tensor:  # rows of the pool that belong to the pairs of the samples
        u = torch.rand(len(samples), num_heldout, generator=generator, dtype=torch.float64)
        return pool[(u * count).long() + first]

    drawn = draw()
    while bool((own := (drawn[..., None] == samples[:, None, :]).any(-1)).any()):
        drawn = torch.where(own, draw(), drawn)
    rest[drawable] = points[drawn]
    return MatchSets(cut[..., :2], cut[..., 2:], rest[..., :2], rest[..., 2:], sample_pair)

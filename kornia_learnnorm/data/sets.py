r"""Sets of correspondences of image pairs: samples of eight, or matches with outliers, and what supervises them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.residual_filter import plain_residual
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.protocol import RATIO

__all__ = ["MatchSets", "draw_samples"]


class MatchSets(NamedTuple):
    """Sets of N correspondences each, and further correspondences of the same image pairs.

    Attributes:
        points1: pixels in the first view, (B, N, 2).
        points2: pixels in the second view, (B, N, 2).
        heldout1: pixels in the first view of correspondences held out of the set, (B, M, 2); M may be 0. They are true
            inliers where the ground truth is known.
        heldout2: pixels in the second view of correspondences held out of the set, (B, M, 2).
        pair: index of the image pair in its source, (B,) int64.
        scores: a score for each match, 1 minus Lowe's ratio, (B, N), or None.
        inliers: one for inliers, zero for outliers, NaN where that is not known, (B, N), or None.
        labelled: whether the ground truth is known, (B,) bool, or None where it is known of no set.
    """

    points1: Tensor
    points2: Tensor
    heldout1: Tensor
    heldout2: Tensor
    pair: Tensor
    scores: Tensor | None = None
    inliers: Tensor | None = None
    labelled: Tensor | None = None

    def select(self, rows: Tensor) -> MatchSets:
        """Return the sets of the given rows (indices or mask)."""
        return MatchSets(*(None if field is None else field[rows] for field in self))  # type: ignore[arg-type]

    def with_residual_below(self, max_residual: float | None) -> MatchSets:
        """Return the sets whose :func:`plain_residual` is below a limit in pixels; None keeps all."""
        return self if max_residual is None else self.select(plain_residual(self.points1, self.points2) < max_residual)


def draw_samples(
    store: CorrespondenceStore,
    generator: torch.Generator,
    size: int = 8,
    max_ratio: float | None = RATIO,
    num_heldout: int = 0,
    max_residual: float | None = None,
    require_heldout: bool = True,
) -> MatchSets:
    """Draw samples: shuffle the correspondences of each pair and split them into sets of ``size``, without the rest.

    Held-out correspondences come from the same pair, are not in the sample and pass the ratio test of 0.8, whatever
    ``max_ratio`` is.

    Args:
        store: correspondences of image pairs.
        generator: source of all randomness; equal states give equal samples.
        size: correspondences per sample, at least 8.
        max_ratio: keep correspondences with Lowe's ratio below this; None keeps all.
        num_heldout: held-out correspondences per sample, drawn with replacement.
        max_residual: drop samples whose :func:`~kornia_learnnorm.data.residual_filter.plain_residual` is at least this
            many pixels; None keeps all.
        require_heldout: refuse a store in which a pair has no correspondence to hold out; if False, the held-out points
            of such a pair's samples are NaN.

    Returns:
        samples in the order of the pairs, float32.

    Raises:
        ValueError: if ``size`` is below 8, no pair fills a sample, or a pair has no correspondence to hold out.

    """
    if size < 8:
        raise ValueError(f"a sample needs at least 8 correspondences, got size={size}")
    points = torch.cat([torch.from_numpy(store.points1), torch.from_numpy(store.points2)], -1)
    pair = torch.repeat_interleave(torch.arange(len(store)), torch.from_numpy(store.offsets).diff())
    ratio = torch.from_numpy(store.ratio)
    rows = torch.arange(len(points)) if max_ratio is None else torch.nonzero(ratio < max_ratio)[:, 0]
    rows = rows[torch.randperm(len(rows), generator=generator)]
    rows = rows[torch.argsort(pair[rows], stable=True)]
    count = torch.bincount(pair[rows], minlength=len(store))
    place = torch.arange(len(rows)) - (count.cumsum(0) - count)[pair[rows]]
    rows = rows[place < (count // size * size)[pair[rows]]].reshape(-1, size)
    if len(rows) == 0:
        limit = "" if max_ratio is None else f" with ratio below {max_ratio}"
        raise ValueError(f"no pair of the store has {size} correspondences{limit}, which a sample needs")
    sample_pair, passes = pair[rows[:, 0]], ratio < RATIO
    passing = torch.bincount(pair[passes], minlength=len(store))[sample_pair]
    if num_heldout and require_heldout and int(passing.min()) <= size:
        few = int(passing.min())
        expected = f"expected more than the {size} of a sample"
        raise ValueError(f"held-out correspondences: a pair has only {few} with ratio below {RATIO}, {expected}")
    cut, rest = points[rows], points.new_full((len(rows), num_heldout, 4), torch.nan)
    drawable = passing > size
    rest[drawable] = points[_draw_heldout(rows[drawable], sample_pair[drawable], pair, passes, num_heldout, generator)]
    samples = MatchSets(cut[..., :2], cut[..., 2:], rest[..., :2], rest[..., 2:], sample_pair)
    return samples.with_residual_below(max_residual)


def _draw_heldout(
    rows: Tensor, sample_pair: Tensor, pair: Tensor, passes: Tensor, number: int, generator: torch.Generator
) -> Tensor:
    """Draw ``number`` rows for each sample from its pair that pass the ratio test and are not in the sample."""
    pool = torch.nonzero(passes)[:, 0]
    count = torch.bincount(pair[pool], minlength=int(pair.max()) + 1)
    start = count.cumsum(0) - count

    def draw() -> Tensor:
        u = torch.rand(len(rows), number, generator=generator, dtype=torch.float64)
        return pool[(u * count[sample_pair, None]).long() + start[sample_pair, None]]

    drawn = draw()
    while bool((own := (drawn[..., None] == rows[:, None, :]).any(-1)).any()):
        drawn = torch.where(own, draw(), drawn)
    return drawn

"""Random sets of matches with outliers, as many as wanted from each image pair, and their mix for training."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import torch
from kornia.geometry.epipolar import cross_product_matrix
from torch import Generator, Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.data.store import CorrespondenceStore, MaxRatio, passes_ratio_test, read_store
from kornia_learnnorm.data.synthetic.draws import log_uniform, normal, uniform
from kornia_learnnorm.data.synthetic.random_matches import SyntheticMatches, random_matches
from kornia_learnnorm.data.training_samples import SEEDS_PER_RUN, Block, block_generator, check_draws, expand_path
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.transforms import affine_transform, transform_points
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

MIN_HELDOUT = 32  # true inliers of a pair that is used, or matches where they are not known
LABEL_THRESHOLD = 2.0  # pixels from the true epipolar lines up to which a match counts as an inlier


def augment(sets: MatchSets, generator: Generator) -> MatchSets:
    """Return sets with image planes rotated, scaled and flipped, views swapped, and outliers added.

    Rotations: up to about 15 degrees for each view alone, in half of the sets; a quarter turn or none for both; any
    angle for each view in a tenth. Scales: log-uniform 0.6-1.6 for both, 0.8-1.25 for one, and as much for the aspect
    of both. Half of the sets are mirrored, in half the views are swapped. In half of the sets up to 40 % of the matches
    get a wrong partner: another match's, or their own shifted by 5-150 px in any direction. Directions in the cameras
    don't change: their matrices take the maps.
    """
    if sets.image1 is not None:
        raise ValueError("sets with images are not augmented: set augmented to 0")
    batch_size, centre = len(sets.points1), sets.points1.mean(1)
    A1, A2 = (A.to(centre) for A in _maps(batch_size, generator))
    points1, heldout1 = (transform_points(p - centre[:, None], A1) for p in (sets.points1, sets.heldout1))
    points2, heldout2 = (transform_points(p - centre[:, None], A2) for p in (sets.points2, sets.heldout2))
    swap = uniform((batch_size, 1, 1), 0.0, 1.0, generator) < 0.5
    points1, points2 = torch.where(swap, points2, points1), torch.where(swap, points1, points2)
    heldout1, heldout2 = torch.where(swap, heldout2, heldout1), torch.where(swap, heldout1, heldout2)
    share = uniform((batch_size, 1), -0.4, 0.4, generator).clamp(min=0.0)
    replaced = uniform(tuple(points1.shape[:2]), 0.0, 1.0, generator) < share
    points2 = torch.where(replaced[..., None], _wrong_partners(points2, generator), points2)
    inliers = None if sets.inliers is None else torch.where(replaced, 0.0, sets.inliers)
    scores = None if sets.scores is None else torch.where(replaced, 0.2 * sets.scores, sets.scores)
    cameras: list[Tensor | None] = [sets.K1, sets.K2, sets.E_mat]
    if sets.K1 is not None and sets.K2 is not None and sets.E_mat is not None:
        shift = affine_transform(torch.eye(2).to(centre).expand(batch_size, 2, 2), centre)
        K1, K2 = (A.to(K) @ shift.to(K) @ K for A, K in ((A1, sets.K1), (A2, sets.K2)))
        cameras = [torch.where(swap, a, b) for a, b in ((K2, K1), (K1, K2), (sets.E_mat.mT, sets.E_mat))]
    return MatchSets(points1, points2, heldout1, heldout2, sets.pair, scores, inliers, sets.labelled, *cameras)


def _maps(batch_size: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Return linear maps of both image planes as transforms (B, 3, 3)."""
    shape = (batch_size, 1)
    some, any_angle = (uniform(shape, 0.0, 1.0, generator) < p for p in (0.5, 0.1))
    quarter = (uniform(shape, 0.0, 4.0, generator).floor() * (uniform(shape, 0.0, 1.0, generator) < 0.4)) * math.pi / 2
    scale = log_uniform(shape, 0.6, 1.6, generator)
    aspect = log_uniform(shape, 0.8, 1.25, generator)
    mirror = torch.where(uniform(shape, 0.0, 1.0, generator) < 0.5, -1.0, 1.0)
    maps = []
    for view in range(2):
        angle = quarter + torch.where(some, 0.13 * normal(shape, generator), 0.0)
        angle = torch.where(any_angle, uniform(shape, 0.0, 2 * math.pi, generator), angle)
        own = scale * (log_uniform(shape, 0.8, 1.25, generator) if view else 1.0)
        linear = torch.cat([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).view(-1, 2, 2)
        linear = torch.cat([mirror * aspect, torch.ones_like(aspect)], -1)[..., None] * linear
        maps.append(affine_transform(own[..., None] * linear, torch.zeros_like(linear[:, 0])))
    return maps[0], maps[1]


def _wrong_partners(points2: Tensor, generator: Generator) -> Tensor:
    """Return other points in the second view: another point's partner, or the own one shifted by 5-150 px."""
    shape, others = (*points2.shape[:2], 1), points2.shape[1] - 1
    further = (uniform(shape, 0.0, 1.0, generator) * others).long().clamp(max=others - 1) + 1  # than the own one
    index = ((torch.arange(shape[1])[:, None].to(further) + further) % shape[1]).expand_as(points2)
    angle = uniform(shape, 0.0, 2 * math.pi, generator)
    length = log_uniform(shape, 5.0, 150.0, generator)
    shifted = points2 + (length * torch.cat([angle.cos(), angle.sin()], -1)).to(points2)
    return torch.where(uniform(shape, 0.0, 1.0, generator) < 0.5, points2.gather(1, index), shifted)


class SetSource(Protocol):
    """Anything that draws sets of matches."""

    def draw(self, num_sets: int, num_points: int, generator: Generator) -> MatchSets:
        """Return sets of one size, which depend on nothing but the arguments and the generator's state."""


@dataclass(eq=False)
class StoreSets:
    """Random sets of matches of the image pairs of stores; half of the draws with the ratio test.

    Args:
        paths: store files, or some pairs of them as ``file.h5@3:10``; environment variables are filled in.
        num_heldout: matches of the pair that are drawn beside the set; some can be in it too.
        max_ratios: limits of Lowe's ratio, of which each draw takes one; None for no limit.
        labels: use the ground truth where there is one; pairs without are supervised by their own matches.
    """

    paths: Sequence[str]
    num_heldout: int = 48
    max_ratios: Sequence[float | None] = (RATIO, None)
    labels: bool = True

    def __post_init__(self) -> None:
        check_draws(self.paths, self.num_heldout, self.max_ratios)
        stores = (read_store(expand_path(path)) for path in self.paths)
        pairs = (_Pair(store, index, self.labels) for store in stores for index in range(len(store)))
        self._pairs = [pair for pair in pairs if len(pair.heldout) >= MIN_HELDOUT]
        if not self._pairs:
            raise ValueError(f"no pair of {', '.join(self.paths)} has {MIN_HELDOUT} matches to hold out")
        self._sizes = [torch.tensor([len(pair.passing(ratio)) for pair in self._pairs]) for ratio in self.max_ratios]
        if empty := [r for r, sizes in zip(self.max_ratios, self._sizes, strict=True) if not sizes.any()]:
            raise ValueError(f"no match of {', '.join(self.paths)} has a ratio below {empty[0]}")

    def draw(self, num_sets: int, num_points: int, generator: Generator) -> MatchSets:
        """Return sets of random matches of random pairs; the pairs with most matches where too few have enough."""
        choice = int(torch.randint(len(self.max_ratios), (), generator=generator))
        ratio, sizes = self.max_ratios[choice], self._sizes[choice]
        able = (sizes >= min(num_points, int(sizes.max()))).nonzero()[:, 0]
        parts = []
        for index in able[torch.randint(len(able), (num_sets,), generator=generator)].tolist():
            pair = self._pairs[index]
            passing = pair.passing(ratio)
            rows = passing[torch.randperm(len(passing), generator=generator)]
            rows = rows[torch.arange(num_points) % len(rows)]
            chosen = torch.randint(len(pair.heldout), (self.num_heldout,), generator=generator)
            points, held, distance = pair.points[rows], pair.points[pair.heldout[chosen]], pair.distance[rows]
            inliers = torch.where(distance.isnan(), torch.nan, (distance < LABEL_THRESHOLD).float())
            about = torch.tensor(index), pair.score[rows], inliers, pair.labelled, *pair.cameras
            parts.append((points[:, :2], points[:, 2:], held[:, :2], held[:, 2:], *about))
        return MatchSets(*(torch.stack(values) for values in zip(*parts, strict=True)))


class _Pair:
    def __init__(self, store: CorrespondenceStore, index: int, labels: bool) -> None:
        rows = store.rows(index)
        points1, points2 = (torch.from_numpy(points[rows]).double() for points in (store.points1, store.points2))
        F_mat = torch.from_numpy(store.F[index]) if labels else torch.full((3, 3), torch.nan, dtype=torch.float64)
        K1, K2, R, t = (torch.from_numpy(value) for value in (*store.K[index], store.R[index], store.t[index]))
        E_mat = cross_product_matrix(t[None])[0] @ R
        self.points = torch.cat([points1, points2], -1).float()  # (M, 4), pixels in both views
        self.ratio = store.ratio[rows]  # (M,), Lowe's ratio, or NaN
        self.score = torch.from_numpy(store.score[rows])  # (M,), from 0 to 1
        # (M,), pixels from the true epipolar lines, NaN if unknown
        self.distance = symmetric_epipolar_distance(points1, points2, F_mat).float()
        # K1, K2 and E, each (3, 3), NaN if unknown
        self.cameras = K1.float(), K2.float(), (E_mat / torch.linalg.matrix_norm(E_mat)).float()
        self.names = store.names[index]  # of the images
        self.sizes: list[Size] = [(width, height) for width, height in store.image_size[index].tolist()]
        self.labelled = ~self.distance.isnan().any()
        filtered = self.passing(RATIO)
        # indices of the matches that supervise
        self.heldout = filtered[self.distance[filtered] < INLIER_THRESHOLD] if self.labelled else self.passing(None)

    def passing(self, max_ratio: MaxRatio) -> Tensor:
        """Return the indices of the matches that pass the ratio test."""
        return torch.from_numpy(passes_ratio_test(self.ratio, max_ratio)).nonzero()[:, 0]


@dataclass(eq=False)
class SyntheticSets:
    """Sets of matches of synthetic scenes, supervised by exact correspondences, or by further matches.

    Args:
        num_heldout: exact correspondences of each scene, or further matches.
        matches: function of the number of scenes, the points per scene, further exact ones and a generator.
        labels: use exact correspondences and the true inliers; without, scenes are supervised by their own matches.
        coarse: share of scenes with matches as of learned detectors, see ``random_matches``; zero for other functions.
    """

    num_heldout: int = 48
    matches: Callable[..., SyntheticMatches] = random_matches
    labels: bool = True
    coarse: float = 0.0

    def __post_init__(self) -> None:
        self.matches = partial(self.matches, coarse=self.coarse) if self.coarse else self.matches

    def draw(self, num_sets: int, num_points: int, generator: Generator) -> MatchSets:
        """Return the matches of new scenes."""
        pair, labelled = torch.arange(num_sets), torch.full((num_sets,), self.labels)
        if self.labels:
            found = self.matches(num_sets, num_points, self.num_heldout, generator)
            points1, points2, scores, inliers, exact1, exact2, *cameras = (value.float() for value in found)
            return MatchSets(points1, points2, exact1, exact2, pair, scores, inliers, labelled, *cameras)
        total = num_points + self.num_heldout
        found = self.matches(num_sets, total, 1, generator)
        order = torch.randperm(total, generator=generator)
        parts = [value[:, order].float().tensor_split([num_points], 1) for value in found[:3]]
        (points1, heldout1), (points2, heldout2), (scores, _) = parts
        inliers = torch.full_like(scores, torch.nan)
        return MatchSets(points1, points2, heldout1, heldout2, pair, scores, inliers, labelled)


@dataclass(eq=False)
class RandomSets:
    """Batches of random sets, each of one source and one size; each block is a batch, so ``data.batch_size`` is null.

    Args:
        sources: sources of sets.
        shares: how often each source is taken, up to a factor; equally often when not given.
        sizes: smallest and largest number of matches in a set; log-uniform between them.
        correspondences: matches in a batch, of all its sets.
        max_sets: largest number of sets in a batch.
        augmented: share of the batches that are augmented.
        scored: share of the batches that have scores.
        batches: batches in an epoch.
    """

    sources: Sequence[SetSource]
    shares: Sequence[float] | None = None
    sizes: tuple[int, int] = (8, 1000)
    correspondences: int = 4096
    max_sets: int = 256
    augmented: float = 0.4
    scored: float = 0.5
    batches: int = 500

    def __post_init__(self) -> None:
        number, sizes = len(self.sources), self.sizes
        if number == 0:
            raise ValueError("sources is empty: give at least one source of sets")
        shares = [1.0] * number if self.shares is None else [*self.shares]
        if len(shares) != number or min(shares) < 0 or not sum(shares) > 0:
            raise ValueError(f"shares must be one non-negative number for each of {number} sources, got {shares}")
        if not 4 <= sizes[0] <= sizes[1]:
            raise ValueError(f"sizes must be a range of at least 4 matches, the fewest of a homography, got {sizes}")
        if self.batches < 1:
            raise ValueError(f"batches must be at least 1, got {self.batches}")
        self._bounds = torch.tensor(shares).cumsum(0)

    def blocks(self, seed: int) -> list[Block]:
        """Return the largest size of each block."""
        return [Block(self.max_sets, self.max_sets)] * self.batches

    def draw(self, seed: int, block: int) -> MatchSets:
        """Return the sets of a block."""
        generator = block_generator(*divmod(seed, SEEDS_PER_RUN), block, 0)
        chance, size, augmented, scored = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
        source = self.sources[int((self._bounds < chance * self._bounds[-1]).sum())]
        low, high = self.sizes
        num_points = round(low * math.exp(size * math.log(high / low)))
        sets = source.draw(max(1, min(self.max_sets, self.correspondences // num_points)), num_points, generator)
        if augmented < self.augmented:
            sets = augment(sets, generator)
        return sets if scored < self.scored else sets._replace(scores=None)

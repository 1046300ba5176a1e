"""Sources of samples for training, stores on disk and synthetic scenes, drawn block by block.

A block depends only on the seed of the draw and its own number, so any process can draw it.
"""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.data.match_sets import MatchSets, draw_samples
from kornia_learnnorm.data.store import StoreReader
from kornia_learnnorm.data.synthetic import TwoViewScene, random_scenes
from kornia_learnnorm.protocol import MAX_RESIDUAL, RATIO

SCENES_PER_BLOCK = 8192
SEEDS_PER_RUN = 1_000_003  # seeds that a run can draw from: one for each epoch


class Block(NamedTuple):
    """Numbers of samples, and of image pairs with a sample, of a block before the filter on the residual."""

    samples: int
    pairs: int


class BlockSource(Protocol):
    """Anything that draws sets block by block, as training takes them."""

    def blocks(self, seed: int) -> list[Block]:
        """Return what each block of a draw holds before any filter; the sums are the same for all seeds."""

    def draw(self, seed: int, block: int) -> MatchSets:
        """Return the sets of a block, which depend on nothing but ``seed`` and ``block``."""


def block_generator(*key: int) -> torch.Generator:
    """Return a random generator for a key of integers, such as the seed of a draw and a block's number."""
    # torch's generator on the CPU uses 32 bits of its seed
    return torch.Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1)[0]))


@dataclass(eq=False)
class StoreSamples:
    """Samples from stores on disk; a draw uses each image pair once per ratio test, in a random block.

    Args:
        paths: store files, or some pairs of them as ``file.h5@3:10``; environment variables are filled in.
        max_ratios: limits of Lowe's ratio; 0.8 gives filtered samples, None unfiltered ones, both a mix.
        size: correspondences per sample; with a range ``(low, high)`` each block draws one size, ends included.
        num_heldout: held-out correspondences per sample.
        max_residual: drop samples whose ``plain_residual`` is at least this many pixels; None keeps all.
        block_pairs: largest number of image pairs in a block.
    """

    paths: Sequence[str]
    max_ratios: Sequence[float | None] = (RATIO,)
    size: int | tuple[int, int] = 8
    num_heldout: int = 0
    max_residual: float | None = MAX_RESIDUAL
    block_pairs: int = 1024

    def __post_init__(self) -> None:
        self.sizes = (self.size, self.size) if isinstance(self.size, int) else self.size
        if len(self.sizes) != 2 or not 8 <= self.sizes[0] <= self.sizes[1] or self.block_pairs < 1:
            got = f"size={self.size}, block_pairs={self.block_pairs}"
            raise ValueError(f"a sample needs at least 8 correspondences, a block at least one pair, got {got}")
        check_draws(self.paths, self.num_heldout, self.max_ratios)
        self.stores = [StoreReader(expand_path(path)) for path in self.paths]
        self._first = np.cumsum([0, *map(len, self.stores)])
        self._passing = [np.concatenate([store.passing(ratio) for store in self.stores]) for ratio in self.max_ratios]
        if max(int(passing.max()) for passing in self._passing) < self.sizes[1]:
            stores = ", ".join(str(store.path) for store in self.stores)
            raise ValueError(f"no pair of {stores} has {self.sizes[1]} correspondences that pass the ratio test")

    def blocks(self, seed: int) -> list[Block]:
        """Return the sizes of the blocks before the residual filter."""
        found = []
        for number, pairs in enumerate(self._pairs(seed)):
            size = self._size(block_generator(seed, number))
            samples = sum(passing[pairs] // size for passing in self._passing)
            found.append(Block(int(np.sum(samples)), int(np.count_nonzero(samples))))
        return found

    def draw(self, seed: int, block: int) -> MatchSets:
        """Return the samples of a block; ``pair`` counts the pairs of all stores in their order."""
        generator, pairs = block_generator(seed, block), self._pairs(seed)[block]
        size = self._size(generator)
        points, heldout = torch.zeros(0, size, 2), torch.zeros(0, self.num_heldout, 2)
        parts = [MatchSets(points, points, heldout, heldout, torch.zeros(0, dtype=torch.int64))]
        for store, first, stop in zip(self.stores, self._first, self._first[1:], strict=False):
            own = pairs[(pairs >= first) & (pairs < stop)]
            held = store.read((own - first).tolist()) if len(own) else None
            for ratio, passing in zip(self.max_ratios, self._passing, strict=True):
                if held is not None and passing[own].max() >= size:
                    part = draw_samples(held, generator, size, ratio, self.num_heldout)
                    parts.append(part._replace(pair=torch.from_numpy(own)[part.pair]))
        samples = MatchSets(*(torch.cat([part[field] for part in parts]) for field in range(5)))  # type: ignore[misc]
        samples = samples.select(samples.heldout1.isfinite().flatten(1).all(1))  # NaN of pairs with too few to hold out
        return samples.with_residual_below(self.max_residual)

    def _pairs(self, seed: int) -> list[NDArray[np.int64]]:
        """Return the sorted indices of the image pairs of each block."""
        order = np.random.default_rng(seed).permutation(int(self._first[-1]))
        return [np.sort(part) for part in np.array_split(order, -(-len(order) // self.block_pairs))]

    def _size(self, generator: torch.Generator) -> int:
        low, high = self.sizes
        return low if low == high else int(torch.randint(low, high + 1, (), generator=generator))


@dataclass(eq=False)
class SyntheticSamples:
    """Samples from synthetic scenes, one sample per scene.

    Args:
        number: scenes per draw, before the residual filter.
        size: correspondences per sample.
        num_heldout: held-out correspondences per sample, inliers and outliers.
        max_residual: drop samples whose ``plain_residual`` is at least this many pixels; None keeps all.
        scenes: function of the number of scenes, the points per scene and a generator, for example one of
            :mod:`kornia_learnnorm.data.synthetic`.
    """

    number: int = 262_144
    size: int = 8
    num_heldout: int = 0
    max_residual: float | None = MAX_RESIDUAL
    scenes: Callable[[int, int, torch.Generator], TwoViewScene] = random_scenes

    def __post_init__(self) -> None:
        if self.number < 1 or self.size < 8:
            raise ValueError(f"number must be positive and size at least 8, got {self.number} and {self.size}")

    def blocks(self, seed: int) -> list[Block]:
        """Return the sizes of the blocks before the residual filter."""
        sizes = [min(SCENES_PER_BLOCK, self.number - first) for first in range(0, self.number, SCENES_PER_BLOCK)]
        return [Block(size, size) for size in sizes]

    def draw(self, seed: int, block: int) -> MatchSets:
        """Return the samples of a block; each is a pair of its own."""
        number = self.blocks(seed)[block].samples
        scenes = self.scenes(number, self.size + self.num_heldout, block_generator(seed, block))
        points1, heldout1 = scenes.points1.float().tensor_split([self.size], 1)
        points2, heldout2 = scenes.points2.float().tensor_split([self.size], 1)
        pair = block * SCENES_PER_BLOCK + torch.arange(number)
        return MatchSets(points1, points2, heldout1, heldout2, pair).with_residual_below(self.max_residual)


def check_draws(paths: Sequence[str], num_heldout: int, max_ratios: Sequence[float | None]) -> None:
    """Raise ValueError without a store or a ratio, for held-out matches below 0, or Lowe's ratio outside (0, 1]."""
    if not paths or not max_ratios:
        raise ValueError(f"at least one store and one ratio expected, got {paths!r} and {max_ratios!r}")
    if num_heldout < 0:
        raise ValueError(f"num_heldout must be 0 or more, got {num_heldout}")
    if wrong := [ratio for ratio in max_ratios if ratio is not None and not 0 < ratio <= 1]:
        raise ValueError(f"max_ratios must be above 0 and at most 1, or null for no limit, got {wrong[0]:g}")


def expand_path(path: str) -> str:
    """Return the path of a store with the environment variables filled in; an unset one is a ValueError."""
    for name in re.findall(r"\$\{?(\w+)", path):
        if not os.environ.get(name):
            keys = "data.train, data.val and data.test of a configuration name stores, in init_args.paths"
            raise ValueError(f"the environment variable {name}, named in {path!r}, is not set; {keys}")
    return os.path.expandvars(path)

"""The datamodule of estimators: sets of matches of any size, drawn anew for each step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import pytorch_lightning as pl
import torch

from kornia_learnnorm.data.augmentation import augment
from kornia_learnnorm.data.sets import MatchSets, SetSource
from kornia_learnnorm.data.sources import block_generator

__all__ = ["MatchSetDataModule", "MatchSetLoader"]

EVALUATION_SEED = 4_000_000_007  # far from the seeds of training
VALIDATION_BATCHES = 64


class MatchSetLoader:
    """Batches of sets of one size each; the state is the epoch and the batch, so training resumes exactly.

    Each batch takes one source, one size and, in half of the batches, the scores of the matches. It depends on the seed
    and its number alone.
    """

    def __init__(self, module: MatchSetDataModule, sources: Sequence[SetSource], seed: int, length: int, train: bool):
        self.module, self.sources, self.seed, self.length, self.train = module, sources, seed, length, train
        self.epoch, self.batch = 0, 0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self.length

    def __iter__(self) -> Iterator[MatchSets]:
        """Yield the batches of the current epoch from the current batch on."""
        epoch = self.epoch
        for index in range(self.batch, self.length):
            last = index + 1 == self.length
            self.epoch, self.batch = (epoch + 1, 0) if last else (epoch, index + 1)
            yield self._draw(epoch if self.train else 0, index)

    def state_dict(self) -> dict[str, Any]:
        """Return the position: the epoch and the next batch."""
        return {"epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to a saved position."""
        self.epoch, self.batch = state["epoch"], state["batch"]

    def _draw(self, epoch: int, index: int) -> MatchSets:
        module, rank = self.module, self.module.trainer.global_rank if self.module.trainer else 0
        generator = block_generator(self.seed, epoch, index, rank)
        chance, size, augmented, scored = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
        shares = torch.tensor(module.shares if self.train else [1.0] * len(self.sources)).cumsum(0)
        source = self.sources[int((shares < chance * shares[-1]).sum())]
        low, high = module.sizes
        num_points = round(low * math.exp(size * math.log(high / low)))
        num_sets = max(1, min(module.max_sets, module.correspondences // num_points))
        sets = source.draw(num_sets, num_points, generator)
        if self.train and augmented < module.augmented:
            sets = augment(sets, generator)
        return sets if self.train and scored < module.scored else sets._replace(scores=None)


class MatchSetDataModule(pl.LightningDataModule):
    """Sets of matches from any sources.

    Args:
        train: sources of the training sets.
        val: sources of the validation sets; none for no validation.
        shares: how often each training source is taken, up to a factor; equally often when not given.
        sizes: smallest and largest number of matches in a set; log-uniform between them.
        correspondences: matches in a batch, of all its sets.
        max_sets: largest number of sets in a batch.
        augmented: share of the training batches that are augmented.
        scored: share of the training batches that have scores.
        steps: training batches in an epoch.
        seed: seed of the training batches; the validation batches are drawn once, from a seed of their own.
    """

    def __init__(
        self,
        train: Sequence[SetSource] = (),
        val: Sequence[SetSource] = (),
        shares: Sequence[float] | None = None,
        sizes: tuple[int, int] = (8, 1000),
        correspondences: int = 4096,
        max_sets: int = 256,
        augmented: float = 0.4,
        scored: float = 0.5,
        steps: int = 500,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not train:
            raise ValueError("data.train is empty: give at least one source of sets")
        if shares is not None and (len(shares) != len(train) or min(shares) < 0 or not sum(shares) > 0):
            raise ValueError(f"shares must be one non-negative number for each of {len(train)} sources, got {shares}")
        if not 8 <= sizes[0] <= sizes[1]:
            raise ValueError(f"sizes must be a range of at least 8 matches, got {sizes}")
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        self.train, self.val = list(train), list(val)
        self.shares = [1.0] * len(train) if shares is None else list(shares)
        self.sizes, self.correspondences, self.max_sets = tuple(sizes), correspondences, max_sets
        self.augmented, self.scored, self.steps, self.seed = augmented, scored, steps, seed

    def train_dataloader(self) -> MatchSetLoader:
        """Return the loader of the training sets."""
        return MatchSetLoader(self, self.train, self.seed, self.steps, train=True)

    def val_dataloader(self) -> Any:
        """Return the loader of the validation sets; an empty list where there are none."""
        return MatchSetLoader(self, self.val, EVALUATION_SEED, VALIDATION_BATCHES, train=False) if self.val else []

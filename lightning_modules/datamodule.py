"""Sources of samples and the datamodule that feeds them to the trainer."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.utilities import rank_zero_info
from torch.utils.data import DataLoader

from kornia_learnnorm.data.samples import Samples
from kornia_learnnorm.data.sources import Block, block_generator

# Far from the seeds of training epochs, since the synthetic source gives the same scenes for the same seed. A generator
# on the CPU reads 32 bits of it.
EVALUATION_SEED = 4_000_000_007

__all__ = ["CorrespondenceDataModule", "SampleLoader", "SampleSource"]


class SampleSource(Protocol):
    """Anything that draws samples block by block: stores of correspondences, the synthetic generator."""

    def blocks(self, seed: int) -> list[Block]:
        """Return what each block of a draw holds before any filter; the sums are the same for all seeds."""

    def draw(self, seed: int, block: int) -> Samples:
        """Return the samples of a block, which depend on nothing but ``seed`` and ``block``."""


class SampleLoader:
    """Batches of samples, drawn anew each epoch; the state is the epoch and the batch, so training resumes exactly.

    A block is cut into batches of nearly equal size, so none of its samples is lost or comes twice. The number of
    batches is the same in every epoch: how many samples the filter keeps is told from the first block of the first
    epoch, and batches are as much smaller or larger than ``batch_size`` as other blocks differ from it; an epoch ends
    early where a block has fewer samples than batches. Of several processes each takes its share of every batch, which
    can be empty.

    ``batch_size`` counts the samples of all processes together, or image pairs, each with all its samples, ``by_pair``.
    Without ``shuffle`` one draw is kept in order, for evaluation. ``workers`` processes draw the next blocks meanwhile.
    """

    def __init__(
        self,
        source: SampleSource,
        batch_size: int,
        seed: int,
        shuffle: bool,
        by_pair: bool = False,
        workers: int = 0,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        unit = "image pair" if by_pair else "sample"
        if batch_size < world_size:
            raise ValueError(f"a batch must hold at least one {unit} for each process, got {batch_size}")
        self.source = source
        self.batch_size, self.by_pair = batch_size, by_pair
        self.seed, self.shuffle = seed, shuffle
        self.workers, self.rank, self.world_size = workers, rank, world_size
        self.epoch, self.batch = 0, 0
        self._drawn: tuple[int, int, Samples] | None = None
        sizes = self._sizes(0)
        kept = len(self._units(self._draw(0, 0))) / max(sizes[0], 1)
        number = round(kept * sum(sizes))
        if number < (batch_size if shuffle else 1):
            raise ValueError(f"a batch takes {batch_size} {unit}s, the source gives {number}")
        self._length = -(-number // batch_size)

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self._length

    def __iter__(self) -> Iterator[Samples]:
        """Yield the batches of the current epoch from the current batch on."""
        epoch, start = self.epoch, self.batch
        # Batch number i of the epoch belongs to the block whose share of all samples it falls into.
        shares = np.cumsum([0, *self._sizes(epoch)])
        bounds = [int(bound) for bound in np.rint(shares * (self._length / shares[-1]))]
        first = max(block for block, bound in enumerate(bounds[:-1]) if bound <= start)
        for block, samples in zip(range(first, len(bounds) - 1), self._blocks(epoch, first), strict=True):
            number = bounds[block + 1] - bounds[block]
            for index, batch in enumerate(self._cut(samples, number, epoch, block), bounds[block]):
                if index >= start:
                    last = index + 1 == self._length
                    self.epoch, self.batch = (epoch + 1, 0) if last else (epoch, index + 1)
                    yield batch
        self.epoch, self.batch = epoch + 1, 0

    def state_dict(self) -> dict[str, Any]:
        """Return the position: the epoch and the next batch."""
        return {"epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to a saved position."""
        self.epoch, self.batch = state["epoch"], state["batch"]

    def _cut(self, samples: Samples, number: int, epoch: int, block: int) -> Iterator[Samples]:
        """Yield this process's shares of ``number`` batches, or of fewer where the samples are too few."""
        units = self._units(samples)
        order = torch.arange(len(units))
        if self.shuffle:
            order = torch.randperm(len(units), generator=block_generator(self._seed(epoch), block, 1))
        number = min(number, len(units))
        for i in range(number):
            first, stop = len(units) * i // number, len(units) * (i + 1) // number
            chosen = order[first + self.rank : stop : self.world_size]
            yield samples.select(torch.cat([order[:0], *(units[i] for i in chosen)]) if self.by_pair else chosen)

    def _units(self, samples: Samples) -> Sequence[Any]:
        """Rows of ``samples`` that stay together: those of a pair, or each alone."""
        if not self.by_pair:
            return range(len(samples.pair))
        counts = torch.unique(samples.pair, return_counts=True)[1]
        return torch.split(torch.argsort(samples.pair, stable=True), counts.tolist())

    def _sizes(self, epoch: int) -> list[int]:
        blocks = self.source.blocks(self._seed(epoch))
        return [block.pairs if self.by_pair else block.samples for block in blocks]

    def _blocks(self, epoch: int, first: int) -> Iterator[Samples]:
        """Yield the blocks of an epoch from ``first`` on."""
        number = len(self.source.blocks(self._seed(epoch)))
        if self.workers and number > first + 1:
            # The "items" are indices of blocks; the workers draw the blocks as they would collate items.
            indices: Any = range(first, number)
            draw = partial(self.source.draw, self._seed(epoch))
            loader = DataLoader(
                indices, batch_size=None, collate_fn=draw, num_workers=self.workers, worker_init_fn=_ignore_interrupts
            )
            yield from loader
        else:
            for block in range(first, number):
                yield self._draw(epoch, block)

    def _draw(self, epoch: int, block: int) -> Samples:
        seed = self._seed(epoch)
        if self._drawn is None or self._drawn[:2] != (seed, block):
            self._drawn = seed, block, self.source.draw(seed, block)
        return self._drawn[2]

    def _seed(self, epoch: int) -> int:
        return self.seed + (epoch if self.shuffle else 0)


def _ignore_interrupts(_: int) -> None:
    """Leave Ctrl-C, which reaches workers too, to the process that trains."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class CorrespondenceDataModule(pl.LightningDataModule):
    """Training, validation and test samples from any sources.

    Args:
        train: source of the training samples.
        val: source of the validation samples.
        test: source of the samples for test and predict.
        batch_size: samples in a batch.
        batch_pairs: image pairs in a training batch, each with all its samples; replaces ``batch_size`` there.
        seed: seed of the training draws; validation and test are drawn once, from a seed of their own.
        workers: processes that draw the next blocks of training samples meanwhile.
    """

    def __init__(
        self,
        train: SampleSource | None = None,
        val: SampleSource | None = None,
        test: SampleSource | None = None,
        batch_size: int = 1024,
        batch_pairs: int | None = None,
        seed: int = 0,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train, self.val, self.test = train, val, test
        self.batch_size = batch_size
        self.batch_pairs = batch_pairs
        self.seed = seed
        self.workers = workers

    def train_dataloader(self) -> SampleLoader:
        """Return the shuffled loader of the training samples."""
        return self._loader("train", self.train, self.seed * 1_000_003, shuffle=True)

    def val_dataloader(self) -> Any:
        """Return the loader of the validation samples; an empty list where there are none."""
        return [] if self.val is None else self._loader("val", self.val, EVALUATION_SEED, shuffle=False)

    def test_dataloader(self) -> SampleLoader:
        """Return the loader of the test samples, which ``predict`` uses too."""
        return self._loader("test", self.test, EVALUATION_SEED, shuffle=False)

    predict_dataloader = test_dataloader

    def _loader(self, stage: str, source: SampleSource | None, seed: int, shuffle: bool) -> SampleLoader:
        if source is None:
            raise ValueError(f"data.{stage} is not set: give it a source of samples")
        by_pair = shuffle and self.batch_pairs is not None
        batch = self.batch_pairs if by_pair and self.batch_pairs is not None else self.batch_size
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        workers = self.workers if shuffle else 0
        loader = SampleLoader(source, batch, seed, shuffle, by_pair, workers, rank, world_size)
        rank_zero_info(f"{stage}: {len(loader)} batches of about {batch} {'image pairs' if by_pair else 'samples'}")
        return loader

"""The datamodule and its loader: batches of sets of correspondences from any sources, in an order that can resume."""

import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.utilities import rank_zero_info
from torch.utils.data import DataLoader

from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.data.training_samples import SEEDS_PER_RUN, BlockSource, block_generator

EVALUATION_SEED = 4_000_000_007  # far from the seeds of training epochs, below 2^32 as the generator needs it


@dataclass(eq=False)
class BatchLoader:
    """Batches of sets, drawn anew each epoch; the state is the epoch and the batch, so training resumes exactly.

    A block is cut into batches of nearly equal size, about ``batch_size``: the first block of the first epoch, after
    the filter, decides their number in every epoch, which ends early where a block has fewer samples than batches. Each
    process takes its share of every batch, which can be empty.

    ``batch_size`` counts the samples of all processes together, or with ``by_pair`` the image pairs, each with all its
    samples. With None, each block is a batch as it is. Without ``shuffle`` one draw is kept in order, for evaluation.
    """

    source: BlockSource
    batch_size: int | None
    seed: int
    shuffle: bool
    by_pair: bool = False
    workers: int = 0
    rank: int = 0
    world_size: int = 1

    def __post_init__(self) -> None:
        self.epoch, self.batch = 0, 0
        self._drawn: tuple[int, int, MatchSets] | None = None
        self._length = len(self._sizes(0)) if self.batch_size is None else self._count(self.batch_size)

    def _count(self, batch_size: int) -> int:
        unit = "image pair" if self.by_pair else "sample"
        if batch_size < self.world_size:
            raise ValueError(f"a batch must hold at least one {unit} for each process, got {batch_size}")
        sizes = self._sizes(0)
        number = round(len(self._units(self._draw(0, 0))) / max(sizes[0], 1) * sum(sizes))
        if number < (batch_size if self.shuffle else 1):
            raise ValueError(f"a batch takes {batch_size} {unit}s, the source gives {number}")
        return max(-(-number // batch_size), len(sizes))

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[MatchSets]:
        """Yield the batches of the current epoch from the current batch on."""
        epoch, start = self.epoch, self.batch
        # Batch number i of the epoch belongs to the block whose share of all samples it falls into.
        shares = np.cumsum([0, *self._sizes(epoch)])
        least = np.arange(len(shares))  # each block has one batch or more
        extra = np.maximum.accumulate(np.rint(shares * (self._length / shares[-1])) - least)
        bounds = [int(bound) for bound in least + np.minimum(extra, self._length - least[-1])]
        first = max(block for block, bound in enumerate(bounds[:-1]) if bound <= start)
        # The "items" are indices of blocks; the workers draw the blocks as they would collate items.
        blocks: Any = range(first, len(bounds) - 1)
        workers, draw = self.workers if len(blocks) > 1 else 0, partial(self._draw, epoch)
        drawn = DataLoader(blocks, None, num_workers=workers, collate_fn=draw, worker_init_fn=_ignore_interrupts)
        for block, samples in zip(blocks, drawn, strict=True):
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

    def _cut(self, samples: MatchSets, number: int, epoch: int, block: int) -> Iterator[MatchSets]:
        """Yield this process's shares of ``number`` batches; in evaluation, of fewer where the samples are too few."""
        units = self._units(samples)
        order = torch.arange(len(units))
        if self.shuffle and self.batch_size is not None:
            order = torch.randperm(len(units), generator=block_generator(self._seed(epoch), block, 1))
        # Without the last of the announced batches, Lightning skips validation and schedule: some samples come twice.
        number = number if self.shuffle and len(units) else min(number, len(units))
        for i in range(number):
            first = len(units) * i // number
            stop = max(first + 1, len(units) * (i + 1) // number)
            chosen = order[first + self.rank : stop : self.world_size]
            yield samples.select(torch.cat([order[:0], *(units[i] for i in chosen)]) if self.by_pair else chosen)

    def _units(self, samples: MatchSets) -> Sequence[Any]:
        """Rows of ``samples`` that stay together: those of a pair, or each alone."""
        if not self.by_pair:
            return range(len(samples.pair))
        counts = torch.unique(samples.pair, return_counts=True)[1]
        return torch.split(torch.argsort(samples.pair, stable=True), counts.tolist())

    def _sizes(self, epoch: int) -> list[int]:
        return [block.pairs if self.by_pair else block.samples for block in self.source.blocks(self._seed(epoch))]

    def _draw(self, epoch: int, block: int) -> MatchSets:
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
    """Training, validation and test sets from any sources.

    Args:
        train: source of the training sets.
        val: source of the validation sets.
        test: source of the sets for test and predict.
        batch_size: sets in a batch; None for sources that draw whole batches, such as
            :class:`~kornia_learnnorm.data.training_sets.RandomSets`.
        batch_pairs: image pairs in a training batch, each with all its samples; replaces ``batch_size`` there.
        seed: seed of the training draws; that of ``seed_everything`` when not given. Validation and test are drawn
            once, from a seed of their own.
        workers: processes that draw the next blocks of training sets meanwhile.
    """

    def __init__(
        self,
        train: BlockSource | None = None,
        val: BlockSource | None = None,
        test: BlockSource | None = None,
        batch_size: int | None = 1024,
        batch_pairs: int | None = None,
        seed: int | None = None,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train, self.val, self.test = train, val, test
        self.batch_size, self.batch_pairs = batch_size, batch_pairs
        self.seed = int(os.environ.get("PL_GLOBAL_SEED", 0)) if seed is None else seed
        self.workers = workers

    def train_dataloader(self) -> BatchLoader:
        """Return the shuffled loader of the training sets."""
        return self._loader("train", self.train, self.seed * SEEDS_PER_RUN, shuffle=True)

    def val_dataloader(self) -> Any:
        """Return the loader of the validation sets; an empty list where there are none."""
        return [] if self.val is None else self._loader("val", self.val, EVALUATION_SEED, shuffle=False)

    def test_dataloader(self) -> BatchLoader:
        """Return the loader of the test sets, which ``predict`` uses too."""
        return self._loader("test", self.test, EVALUATION_SEED, shuffle=False)

    predict_dataloader = test_dataloader

    def _loader(self, stage: str, source: BlockSource | None, seed: int, shuffle: bool) -> BatchLoader:
        if source is None:
            raise ValueError(f"data.{stage} is not set: give it a source of sets")
        by_pair = shuffle and self.batch_pairs is not None
        size, unit = (self.batch_pairs, "image pairs") if by_pair else (self.batch_size, "sets")
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        loader = BatchLoader(source, size, seed, shuffle, by_pair, self.workers if shuffle else 0, rank, world_size)
        rank_zero_info(f"{stage}: {len(loader)} batches{f' of about {size} {unit}' if size else ''}")
        return loader

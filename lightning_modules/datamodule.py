"""Sources of samples and the datamodule that feeds them to the trainer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import pytorch_lightning as pl
import torch
from pytorch_lightning.utilities import rank_zero_info

from kornia_learnnorm.data.samples import Samples

# Far from the seeds of training epochs, since the synthetic source gives the same scenes for the same seed. A generator
# on the CPU reads 32 bits of it.
EVALUATION_SEED = 4_000_000_007

__all__ = ["CorrespondenceDataModule", "SampleLoader", "SampleSource"]


class SampleSource(Protocol):
    """Anything that draws samples: stores of correspondences, the synthetic generator."""

    def draw(self, seed: int) -> Samples:
        """Return samples that depend on nothing but ``seed``."""


class SampleLoader:
    """Batches of samples, drawn anew each epoch; the state is the epoch and the batch, so training resumes exactly.

    Every epoch has as many batches as the first draw fills. A shuffled loader drops the rest that fills none; an
    ordered one draws once and keeps all.

    Args:
        source: where the samples come from.
        batch_size: samples in a batch, or image pairs.
        seed: seed of all draws.
        shuffle: draw and shuffle anew each epoch (training) or keep one draw in order (evaluation).
        by_pair: count and shuffle image pairs, each with all its samples, instead of samples.

    Raises:
        ValueError: if the batch size is not positive, or a shuffled draw does not fill one batch.
    """

    def __init__(self, source: SampleSource, batch_size: int, seed: int, shuffle: bool, by_pair: bool = False) -> None:
        if batch_size < 1:
            raise ValueError(f"a batch must hold at least one sample or image pair, got {batch_size}")
        self.source = source
        self.batch_size = batch_size
        self.seed = seed
        self.shuffle = shuffle
        self.by_pair = by_pair
        self.epoch, self.batch = 0, 0
        self._drawn: tuple[int, Samples] | None = None
        number = len(self._units(self._draw(0)))
        self._length = number // batch_size if shuffle else -(-number // batch_size)
        if self._length == 0:
            unit = "image pairs" if by_pair else "samples"
            raise ValueError(f"a batch takes {batch_size} {unit}, the source gives {number}")

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self._length

    def __iter__(self) -> Iterator[Samples]:
        """Yield the batches of the current epoch from the current batch on."""
        epoch, start = self.epoch, self.batch
        samples = self._draw(epoch)
        units = self._units(samples)
        number = len(units)
        order = torch.arange(number)
        if self.shuffle:
            order = torch.randperm(number, generator=torch.Generator().manual_seed(self.seed + epoch))
            # The filter keeps slightly different numbers each epoch: a shorter epoch starts over.
            order = order.repeat(1 + self._length * self.batch_size // number)
        for index in range(start, self._length):
            last = index + 1 == self._length
            self.epoch, self.batch = (epoch + 1, 0) if last else (epoch, index + 1)
            chosen = order[index * self.batch_size : min((index + 1) * self.batch_size, len(order))]
            yield samples.select(torch.cat([units[i] for i in chosen]) if self.by_pair else chosen)

    def state_dict(self) -> dict[str, Any]:
        """Return the position: the epoch and the next batch."""
        return {"epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to a saved position."""
        self.epoch, self.batch = state["epoch"], state["batch"]

    def _units(self, samples: Samples) -> Sequence[Any]:
        """Rows of ``samples`` that stay together: those of a pair, or each alone."""
        if not self.by_pair:
            return range(len(samples.pair))
        counts = torch.unique(samples.pair, return_counts=True)[1]
        return torch.split(torch.argsort(samples.pair, stable=True), counts.tolist())

    def _draw(self, epoch: int) -> Samples:
        epoch = epoch if self.shuffle else 0
        if self._drawn is None or self._drawn[0] != epoch:
            self._drawn = epoch, self.source.draw(self.seed + epoch)
        return self._drawn[1]


class CorrespondenceDataModule(pl.LightningDataModule):
    """Training, validation and test samples from any sources.

    Args:
        train: source of the training samples.
        val: source of the validation samples.
        test: source of the samples for test and predict.
        batch_size: samples in a batch.
        batch_pairs: image pairs in a training batch, each with all its samples; replaces ``batch_size`` there.
        seed: seed of the training draws; validation and test are drawn once, from a seed of their own.
    """

    def __init__(
        self,
        train: SampleSource | None = None,
        val: SampleSource | None = None,
        test: SampleSource | None = None,
        batch_size: int = 1024,
        batch_pairs: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.train, self.val, self.test = train, val, test
        self.batch_size = batch_size
        self.batch_pairs = batch_pairs
        self.seed = seed

    def train_dataloader(self) -> SampleLoader:
        """Return the shuffled loader of the training samples."""
        return self._loader("train", self.train, self.seed * 1_000_003, shuffle=True)

    def val_dataloader(self) -> Any:
        """Return the loader of the validation samples; an empty list where there are none."""
        return [] if self.val is None else self._loader("val", self.val, EVALUATION_SEED, shuffle=False)

    def test_dataloader(self) -> SampleLoader:
        """Return the loader of the test samples."""
        return self._loader("test", self.test, EVALUATION_SEED, shuffle=False)

    def predict_dataloader(self) -> SampleLoader:
        """Return the loader of the test samples."""
        return self.test_dataloader()

    def _loader(self, stage: str, source: SampleSource | None, seed: int, shuffle: bool) -> SampleLoader:
        if source is None:
            raise ValueError(f"data.{stage} is not set: give it a source of samples")
        if shuffle and self.batch_pairs is not None:
            loader = SampleLoader(source, self.batch_pairs, seed, shuffle, by_pair=True)
            rank_zero_info(f"{stage}: {len(loader)} batches of {self.batch_pairs} image pairs")
        else:
            loader = SampleLoader(source, self.batch_size, seed, shuffle)
            rank_zero_info(f"{stage}: {len(loader)} batches of up to {self.batch_size} samples")
        return loader

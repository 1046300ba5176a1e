"""Callbacks: checkpoints, export of the trained weights, and predictions to a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import BasePredictionWriter, Callback, ModelCheckpoint
from safetensors.torch import save_file

from kornia_learnnorm.files import replacing
from lightning_modules.task import NormalizerTask

__all__ = ["Checkpoints", "ExportWeights", "WritePredictions"]


class Checkpoints(ModelCheckpoint):
    """Keep the last checkpoint as ``checkpoints/last.ckpt`` in the trainer's default root directory.

    Args:
        every_n_train_steps: steps between checkpoints.
    """

    def __init__(self, every_n_train_steps: int = 250) -> None:
        super().__init__(save_last=True, every_n_train_steps=every_n_train_steps, enable_version_counter=False)

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Choose the folder."""
        self.dirpath = str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)


class ExportWeights(Callback):
    """Write the normaliser as safetensors when training ends, for ``LearnedNormalizer.from_pretrained``.

    Args:
        filename: name of the file in the trainer's default root directory.
    """

    def __init__(self, filename: str = "weights.safetensors") -> None:
        self.filename = filename

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the normaliser."""
        if trainer.is_global_zero:
            path = Path(trainer.default_root_dir) / self.filename
            path.parent.mkdir(parents=True, exist_ok=True)
            if not isinstance(pl_module, NormalizerTask):
                raise TypeError(f"only a NormalizerTask has a normaliser to export, got {type(pl_module).__name__}")
            pl_module.normalizer.save_pretrained(path)
            print(f"wrote {path}")


class WritePredictions(BasePredictionWriter):
    """Write the tensors that ``predict`` returns to one safetensors file.

    Args:
        filename: name of the file in the trainer's default root directory.
    """

    def __init__(self, filename: str = "predictions.safetensors") -> None:
        super().__init__(write_interval="epoch")
        self.filename = filename

    def write_on_epoch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        predictions: Sequence[Any],
        batch_indices: Sequence[Any],
    ) -> None:
        """Concatenate the batches and write them beside the target, then rename."""
        path = Path(trainer.default_root_dir) / self.filename
        path.parent.mkdir(parents=True, exist_ok=True)
        fields = {key: torch.cat([batch[key] for batch in predictions]).contiguous() for key in predictions[0]}
        with replacing(path) as beside:
            save_file(fields, beside)
        print(f"wrote {path}")

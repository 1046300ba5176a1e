"""Callbacks: checkpoints, progress and expected time, export of the trained weights, and predictions to a file."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback, ModelCheckpoint, TQDMProgressBar
from pytorch_lightning.callbacks.progress.tqdm_progress import Tqdm
from pytorch_lightning.trainer.states import TrainerFn
from pytorch_lightning.utilities import rank_zero_info
from pytorch_lightning.utilities.exceptions import SIGTERMException
from safetensors.torch import save_file
from torch import Tensor, distributed
from tqdm import tqdm

from kornia_learnnorm.data.sets import StoreSets, SyntheticSets
from kornia_learnnorm.data.sources import StoreSamples, SyntheticSamples
from kornia_learnnorm.files import atomic_write, short_name
from lightning_modules.estimator_task import EstimatorTask
from lightning_modules.task import NormalizerTask

__all__ = ["Checkpoints", "ExpectedTime", "ExportWeights", "StepProgress", "WritePredictions"]


class Checkpoints(ModelCheckpoint):
    """Keep the last checkpoint as ``checkpoints/last.ckpt`` in the trainer's default root directory.

    A training that is interrupted (Ctrl-C) or terminated (SIGTERM) ends after the current step with a checkpoint; a
    second Ctrl-C ends it at once, and so does SIGTERM during a validation. Several processes end at once, since they
    would not agree on the step.

    Args:
        every_n_train_steps: steps between checkpoints.
    """

    def __init__(self, every_n_train_steps: int = 100) -> None:
        super().__init__(save_last=True, every_n_train_steps=every_n_train_steps, enable_version_counter=False)
        self._previous_handler: Any = None
        self._interrupted = self._started = False

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Choose the folder."""
        self.dirpath = str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Handle interrupts, in the main thread of a single process."""
        super().on_train_start(trainer, pl_module)
        self._interrupted, self._started = False, True
        if trainer.world_size == 1 and threading.current_thread() is threading.main_thread():
            self._previous_handler = signal.signal(signal.SIGINT, self._interrupt)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save a checkpoint where one is due, or where the training was interrupted, which ends here."""
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        terminated = trainer.received_sigterm and trainer.world_size == 1
        if self._interrupted or terminated:
            self._save_last(trainer)
            raise SIGTERMException if terminated else KeyboardInterrupt

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Say how an interrupted run can be resumed."""
        super().on_exception(trainer, pl_module, exception)
        self._restore_handler()
        if trainer.state.fn != TrainerFn.FITTING or not self._started:
            return
        last = self.last_model_path
        how = f"to go on, repeat the command with --ckpt_path {last}" if last else "no checkpoint was written"
        _print_above_bar(f"stopped at step {trainer.global_step}; {how}")

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the last step, where no checkpoint was due, and give interrupts back."""
        super().on_train_end(trainer, pl_module)
        self._restore_handler()
        if self._last_global_step_saved != trainer.global_step:
            self._save_last(trainer)

    def _save_last(self, trainer: pl.Trainer) -> None:
        self.last_model_path = str(Path(str(self.dirpath)) / "last.ckpt")
        trainer.save_checkpoint(self.last_model_path)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """Ask for the end of the training; the second time, end it."""
        if self._interrupted:
            raise KeyboardInterrupt
        self._interrupted = True
        rank_zero_info("\ninterrupted: the run ends with a checkpoint after this step; Ctrl-C again ends it at once")

    def _restore_handler(self) -> None:
        if self._previous_handler is not None:
            signal.signal(signal.SIGINT, self._previous_handler)
            self._previous_handler = None


class ExpectedTime(Callback):
    """Print the device, steps and folder of a training, soon how long it will take, and in the end how long it took.

    The command line adds it to every training.

    Args:
        measured_steps: steps whose mean time is multiplied, after one that is left out.
    """

    def __init__(self, measured_steps: int = 10) -> None:
        self.measured_steps = measured_steps
        self._first = 0
        self._start = self._begin = 0.0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print where and how far the training will go."""
        self._first, self._begin = trainer.global_step + 1, time.monotonic()
        steps = _remaining_steps(trainer)
        count = "steps until it is stopped" if steps is None else f"{steps} steps"
        _print_above_bar(f"device {pl_module.device}, {count}; results in {trainer.default_root_dir}")

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Print the expected time after the first steps."""
        done = trainer.global_step - self._first
        if done == 0:
            self._start = time.monotonic()
        elif done == self.measured_steps and (steps := _remaining_steps(trainer)):
            seconds = (time.monotonic() - self._start) / done * steps
            _print_above_bar(f"about {_duration(seconds)} for the remaining {steps} steps, without validation")

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print the time of the steps since the start, validation included."""
        steps = trainer.global_step + 1 - self._first
        _print_above_bar(f"{steps} steps in {_duration(time.monotonic() - self._begin)}")


def _print_above_bar(text: str) -> None:
    """Print a line of a training, above its progress bar where there is one."""
    with tqdm.external_write_mode():
        rank_zero_info(text)


class StepProgress(TQDMProgressBar):
    """Show the steps that a training has done out of all, in one bar over all epochs.

    Lightning's own bars count the batches of one epoch. The command line adds this bar where no other is configured.
    """

    def __init__(self) -> None:
        super().__init__(refresh_rate=1 if sys.stdout.isatty() else 100)

    def on_train_start(self, *args: Any) -> None:
        """Open the bar at the step that the training begins with."""
        super().on_train_start(*args)
        bar, done = self.train_progress_bar, self.trainer.global_step
        bar.total, bar.initial, bar.n = _total_steps(self.trainer), done, done
        bar.set_description("Step")

    def init_sanity_tqdm(self) -> Tqdm:
        """Return no bar for the two batches of validation before the training."""
        return Tqdm(disable=True)

    def get_metrics(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, Any]:
        """Return the logged values, without the number of the logger's version."""
        return {name: value for name, value in super().get_metrics(trainer, pl_module).items() if name != "v_num"}

    def on_train_epoch_start(self, *args: Any) -> None:
        """Leave the bar as it is."""

    def on_exception(self, *args: Any) -> None:
        """Close the bar of a training that ends early, so that messages begin on a new line."""
        if self._train_progress_bar is not None:
            self.train_progress_bar.close()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Show the steps and the logged values."""
        bar, done = self.train_progress_bar, trainer.global_step
        bar.n = done
        if self.is_enabled and (done % self.refresh_rate == 0 or done == bar.total):
            bar.set_postfix(self.get_metrics(trainer, pl_module))


def _total_steps(trainer: pl.Trainer) -> int | None:
    """Return the number of steps of a training; None where it has no end."""
    total = trainer.max_steps if trainer.max_steps > 0 else trainer.estimated_stepping_batches
    return int(total) if math.isfinite(total) else None


def _remaining_steps(trainer: pl.Trainer) -> int | None:
    """Return the number of steps that a training has before it; None where it has no end."""
    total = _total_steps(trainer)
    return None if total is None else total - trainer.global_step


def _duration(seconds: float) -> str:
    """Return a time to one or two digits."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


class ExportWeights(Callback):
    """Write the trained module as safetensors when training ends, for its ``from_pretrained``.

    The file names the training data: the stores, or ``synthetic scenes``; nothing for a source of another class. A
    training that ended before its first step raises a ValueError in the place of writing untrained weights.

    Args:
        filename: name of the file in the trainer's default root directory.
    """

    def __init__(self, filename: str = "weights.safetensors") -> None:
        self.filename = filename

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the module."""
        if trainer.global_step == 0:
            raise ValueError("the training ended before its first step: no weights were written")
        if trainer.is_global_zero:
            path = Path(trainer.default_root_dir) / self.filename
            path.parent.mkdir(parents=True, exist_ok=True)
            if not isinstance(pl_module, NormalizerTask | EstimatorTask):
                raise TypeError(f"expected a NormalizerTask or an EstimatorTask, got {type(pl_module).__name__}")
            trained = pl_module.normalizer if isinstance(pl_module, NormalizerTask) else pl_module.trained
            trained.trained_on = _names_of_sources(getattr(trainer, "datamodule", None))
            trained.save_pretrained(path)
            print(f"wrote {path}")


def _names_of_sources(datamodule: Any) -> tuple[str, ...]:
    """Return the names of the data that a datamodule trains on; nothing where they are not known."""
    sources = getattr(datamodule, "train", None)
    names: list[str] = []
    for source in sources if isinstance(sources, list) else [sources]:
        if isinstance(source, StoreSamples | StoreSets):
            names += [short_name(path) for path in source.paths]
        elif isinstance(source, SyntheticSamples | SyntheticSets):
            names.append("synthetic scenes")
    return tuple(dict.fromkeys(names))


class WritePredictions(Callback):
    """Write the tensors that ``predict`` returns to one safetensors file.

    Args:
        filename: name of the file in the trainer's default root directory.
    """

    def __init__(self, filename: str = "predictions.safetensors") -> None:
        self.filename = filename
        self._batches: list[dict[str, Tensor]] = []

    def on_predict_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, *args: Any, **kwargs: Any
    ) -> None:
        """Keep the predictions of a batch."""
        self._batches.append({key: value.cpu() for key, value in outputs.items()})

    def on_predict_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Concatenate the batches of all processes and write them beside the target, then rename."""
        batches = _gathered(self._batches) if trainer.world_size > 1 else self._batches
        self._batches = []
        if not trainer.is_global_zero:
            return
        path = Path(trainer.default_root_dir) / self.filename
        path.parent.mkdir(parents=True, exist_ok=True)
        fields = {key: torch.cat([batch[key] for batch in batches]) for key in batches[0]}
        with atomic_write(path) as beside:
            save_file(fields, beside)
        print(f"wrote {path}")


def _gathered(batches: list[dict[str, Tensor]]) -> list[dict[str, Tensor]]:
    """Return the batches of all processes, samples in order: of each batch, process r has every n-th from r on."""
    shares: list[Any] = [None] * distributed.get_world_size()
    distributed.all_gather_object(shares, batches)
    whole = []
    for parts in zip(*shares, strict=True):
        order = torch.cat([torch.arange(len(part["pair"])) * len(parts) + r for r, part in enumerate(parts)]).argsort()
        whole.append({key: torch.cat([part[key] for part in parts])[order] for key in parts[0]})
    return whole

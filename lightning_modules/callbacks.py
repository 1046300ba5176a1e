"""Callbacks: checkpoints, expected time, export of the trained weights, and predictions to a file."""

import shlex
import signal
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback, ModelCheckpoint
from pytorch_lightning.trainer.states import TrainerFn
from pytorch_lightning.utilities import rank_zero_info
from pytorch_lightning.utilities.exceptions import SIGTERMException
from safetensors.torch import save_file
from torch import Tensor, distributed
from tqdm import tqdm

from kornia_learnnorm import EightPoint, LearnedNormalizer
from kornia_learnnorm.data.training_samples import StoreSamples, SyntheticSamples
from kornia_learnnorm.data.training_sets import RandomSets, StoreSets, SyntheticSets
from kornia_learnnorm.files import atomic_write, explained, short_name
from lightning_modules.task import EstimatorTask, SetLoss

MEASURED_STEPS = 10  # steps whose mean time is multiplied, after one that does not count


class Checkpoints(ModelCheckpoint):
    """Keep the last checkpoint as ``checkpoints/last.ckpt`` in the trainer's default root directory.

    Ctrl-C and SIGTERM end a training after the current step with a checkpoint; a second Ctrl-C ends it at once, and so
    does SIGTERM during a validation. Several processes end at once, since they would not agree on the step.
    """

    def __init__(self, every_n_train_steps: int = 100) -> None:
        super().__init__(save_last=True, save_top_k=0, every_n_train_steps=every_n_train_steps)
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

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Save a checkpoint where one is due, or where the training was interrupted, which ends here."""
        super().on_train_batch_end(trainer, pl_module, *args)
        terminated = trainer.received_sigterm and trainer.world_size == 1
        # Within an accumulation a checkpoint would lose the gradient of its first batches.
        stepped = (args[2] + 1) % trainer.accumulate_grad_batches == 0 or trainer.is_last_batch
        if terminated or (self._interrupted and stepped):
            self._save_last(trainer)
            raise SIGTERMException if terminated else KeyboardInterrupt

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Print how an interrupted run can be resumed."""
        super().on_exception(trainer, pl_module, exception)
        self._restore_handler()
        if trainer.state.fn == TrainerFn.FITTING and self._started:
            last = self.last_model_path
            how = f"to go on, repeat the command with --ckpt_path {shlex.quote(last)}"
            how = how if Path(last).is_file() else "no checkpoint was written"
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

    def _interrupt(self, *signal_and_frame: Any) -> None:
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
    """Print the device, steps and folder of a training, soon how long it will take, and in the end how long it took."""

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print where and how far the training will go."""
        self._first, self._begin = trainer.global_step + 1, time.monotonic()
        steps = trainer.estimated_stepping_batches - trainer.global_step
        count = "steps until it is stopped" if steps == float("inf") else f"{steps:.0f} steps"
        _print_above_bar(f"device {pl_module.device}, {count}; results in {trainer.default_root_dir}")

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Print the expected time after the first steps."""
        done, steps = trainer.global_step - self._first, trainer.estimated_stepping_batches - trainer.global_step
        if done == 0:
            self._start = time.monotonic()
        elif done == MEASURED_STEPS and 0 < steps < float("inf"):
            seconds = (time.monotonic() - self._start) / done * steps
            _print_above_bar(f"about {_duration(seconds)} for the remaining {steps:.0f} steps, without validation")

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print the time of the steps since the start, validation included."""
        steps = trainer.global_step + 1 - self._first
        _print_above_bar(f"{steps} steps in {_duration(time.monotonic() - self._begin)}")


class AgainstStart(Callback):
    """Compare the errors of the validation with those before the first step.

    The latter are known where ``num_sanity_val_steps=-1`` of the trainer makes the sanity check the whole validation.
    """

    def __init__(self) -> None:
        self.start: dict[str, float] = {}  # errors before the first step; empty where they were not measured
        self.batches: Any = None  # of the validation then
        self.last: dict[str, float] = {}  # errors of the last validation
        self.step = 0  # steps before the last validation

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the errors."""
        names = [f"val/{name}" for name in getattr(pl_module, "errors", ())]
        errors = {name: float(value) for name, value in trainer.callback_metrics.items() if name in names}
        if not trainer.sanity_checking:
            self.last, self.step = errors, trainer.global_step
            self.start = self.start if self.batches == trainer.num_val_batches else {}
        elif trainer.global_step == 0 and trainer.num_sanity_val_steps == float("inf"):
            self.start, self.batches = errors, trainer.num_sanity_val_batches

    def summary(self) -> str:
        """Return whether the last errors are below those at the start, and all of them."""
        start = {name: value for name, value in self.start.items() if name in self.last}
        if not start:
            return "other errors were measured at the start"
        better = sum(self.last[name] < value for name, value in start.items())
        verdict = "better" if better else "not better"
        verdict += f" in {better} of {len(start)} errors" if 0 < better < len(start) else ""
        pairs = [f"{name} {self.last[name]:.3f}, at the start {value:.3f}" for name, value in start.items()]
        return f"{verdict} than at the start: {'; '.join(pairs)}"

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training needs."""
        return {"start": self.start, "batches": self.batches}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the errors at the start of the training that is resumed."""
        self.start, self.batches = state_dict["start"], state_dict.get("batches")


def _print_above_bar(text: str) -> None:
    with tqdm.external_write_mode():
        rank_zero_info(text)


def _duration(seconds: float) -> str:
    """Return a time to one or two digits."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


class ExportWeights(Callback):
    """Write the trained module to ``weights.safetensors`` in the trainer's default root directory when training ends.

    What cannot be saved is refused before the training, and a learned normaliser that cannot be loaded again and used.
    The file names the stores of the training data and ``synthetic scenes``.
    """

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Save the module to a temporary folder and load it again; a ValueError where it does not come back."""
        if not isinstance(pl_module, EstimatorTask):
            raise TypeError(f"expected an EstimatorTask, got {type(pl_module).__name__}")
        if stage != "fit":
            return
        trained = pl_module.trained
        with explained("the trained weights could not be saved", TypeError, ValueError), TemporaryDirectory() as folder:
            trained.save_pretrained(path := Path(folder) / "weights.safetensors")
            if isinstance(trained, LearnedNormalizer):
                parts = [trained.transform, *map(type, trained.modules())]
                loaded = LearnedNormalizer.from_pretrained(path, {part.__module__ for part in parts})
        if isinstance(trained, LearnedNormalizer):
            _try_out(loaded, pl_module.loss, getattr(_training_data(trainer), "num_heldout", 8))

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the module; a ValueError in the place of untrained weights."""
        if trainer.global_step == 0:
            raise ValueError("the training ended before its first step: no weights were written")
        if trainer.is_global_zero and isinstance(pl_module, EstimatorTask):
            path = Path(trainer.default_root_dir) / "weights.safetensors"
            path.parent.mkdir(parents=True, exist_ok=True)
            pl_module.trained.trained_on = tuple(dict.fromkeys(_names_of(_training_data(trainer))))
            pl_module.trained.save_pretrained(path)
            print(f"wrote {path}")


def _try_out(normalizer: LearnedNormalizer, loss: Any, num_heldout: int) -> None:
    """Raise a ValueError in one line where an own network or loss fails on an example, or sends no gradient."""
    points1, points2 = 500 * torch.rand(2, 2, 8, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    try:
        F_mat = EightPoint(normalizer)(points1, points2)
        heldout = points1[:, :1].expand(-1, num_heldout, -1), points2[:, :1].expand(-1, num_heldout, -1)
        value = F_mat if isinstance(loss, SetLoss) else loss(points1, points2, F_mat, *heldout)
        if not isinstance(value, Tensor):
            raise TypeError(f"the loss must return a tensor, got {type(value).__name__}")
        if not num_heldout and bool(value.isnan().any()):
            raise ValueError("the loss is NaN: does it need held-out points, num_heldout of the data?")
    except Exception as error:  # code that is not this package's can raise anything
        text = " ".join(str(error).split())
        hint = ": register its tensors as buffers" if " meta " in text else ""
        raise ValueError(f"network or loss failed on float64 points: {type(error).__name__}: {text}{hint}") from error
    if not F_mat.requires_grad or not value.requires_grad:
        raise ValueError(f"the {'loss' if F_mat.requires_grad else 'network'} sends no gradient: it cannot be trained")


def _training_data(trainer: pl.Trainer) -> Any:
    return getattr(getattr(trainer, "datamodule", None), "train", None)


def _names_of(source: Any) -> list[str]:
    """Return the names of the data of a source; nothing where they are not known."""
    if isinstance(source, RandomSets):
        return [name for part in source.sources for name in _names_of(part)]
    if isinstance(source, StoreSamples | StoreSets):
        return [short_name(path) for path in source.paths]
    return ["synthetic scenes"] if isinstance(source, SyntheticSamples | SyntheticSets) else []


class WritePredictions(Callback):
    """Write the tensors that ``predict`` returns to ``predictions.safetensors`` in the default root directory."""

    def on_predict_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Concatenate the batches of all processes and write them whole or not at all."""
        found: list[Any] = trainer.predict_loop.predictions
        batches = [{key: value.cpu() for key, value in batch.items()} for batch in found]
        batches = _gathered(batches) if trainer.world_size > 1 else batches
        if not trainer.is_global_zero:
            return
        path = Path(trainer.default_root_dir) / "predictions.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as beside:
            save_file({key: torch.cat([batch[key] for batch in batches]) for key in batches[0]}, beside)
        print(f"wrote {path}")


def _gathered(batches: list[dict[str, Tensor]]) -> list[dict[str, Tensor]]:
    """Return the batches of all processes, sets in order: of each batch, process r has every n-th from r on."""
    shares: list[Any] = [None] * distributed.get_world_size()
    distributed.all_gather_object(shares, batches)
    whole = []
    for parts in zip(*shares, strict=True):
        order = torch.cat([torch.arange(len(part["pair"])) * len(parts) + r for r, part in enumerate(parts)]).argsort()
        whole.append({key: torch.cat([part[key] for part in parts])[order] for key in parts[0]})
    return whole

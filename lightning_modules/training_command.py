"""The training commands: LightningCLI with the project's task and datamodule, and a look at the checkpoint first."""

import logging
import signal
import sys
import warnings
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from jsonargparse import ArgumentError
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning_fabric.utilities.exceptions import MisconfigurationException
from pytorch_lightning.callbacks import ModelCheckpoint, ProgressBar, Timer, TQDMProgressBar
from pytorch_lightning.cli import LightningCLI
from pytorch_lightning.utilities.exceptions import SIGTERMException
from torch import Tensor

from kornia_learnnorm.files import atomic_write, exclusive, full_disk_names
from kornia_learnnorm.optional import working_folder_importable
from lightning_modules.callbacks import AgainstStart, Checkpoints, ExpectedTime, ExportWeights, WritePredictions
from lightning_modules.config_files import config_names, names_task, with_config_paths
from lightning_modules.datamodule import CorrespondenceDataModule
from lightning_modules.task import EstimatorTask

# Of what Lightning prints about devices, seeds and checkpoints, only warnings concern who trains.
LOGGERS = (
    "lightning_fabric.utilities.seed",
    "pytorch_lightning.trainer.connectors.checkpoint_connector",
    "pytorch_lightning.utilities.rank_zero",
)
UNWANTED_WARNINGS = (
    "LightningCLI.s args parameter.*",  # the options come from the command line all the same
    ".*treespec, LeafSpec.*",  # Lightning's own call of torch
    ".*smaller than the logging interval.*",  # the interval counts the steps of all epochs
    "Checkpoint directory .* exists and is not empty.*",  # it is that of the run that goes on
)


class WholeCheckpoints(TorchCheckpointIO):
    """Replaces checkpoints by whole ones alone; Lightning copies over the old one where /tmp is on another disk."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write the checkpoint beside the old one, which it then replaces."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as beside:
            super().save_checkpoint(checkpoint, beside, storage_options)


class TrainingCLI(LightningCLI):
    """LightningCLI of one command that refuses a missing or foreign checkpoint, and always writes the weights."""

    def __init__(self, command: str, **kwargs: Any) -> None:
        self.command = command
        super().__init__(**kwargs)

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]  # it is static
        """Return the command, and the arguments of the trainer's method that are no options."""
        return {self.command: LightningCLI.subcommands()[self.command]}

    def instantiate_classes(self) -> None:
        """Make task, data and trainer; what refuses its arguments is a ValueError."""
        try:
            super().instantiate_classes()
        except TypeError as error:
            raise ValueError(str(error)) from error

    def instantiate_trainer(self, **kwargs: Any) -> pl.Trainer:
        """Make the trainer, with what the configuration lacks: checkpoints, weights, predictions, progress."""
        config = self.config_init[self.subcommand]["trainer"]
        given = config["callbacks"] or []
        callbacks = [*given] if isinstance(given, list) else [given]
        bar = TQDMProgressBar(refresh_rate=1 if sys.stdout.isatty() else 100)
        for default, kind, wanted in (
            (Checkpoints(), ModelCheckpoint, config["enable_checkpointing"] is not False),
            (ExportWeights(), ExportWeights, True),
            (WritePredictions(), WritePredictions, True),
            (AgainstStart(), AgainstStart, True),
            (bar, ProgressBar, config["enable_progress_bar"] is not False),
        ):
            if wanted and not any(isinstance(callback, kind) for callback in callbacks):
                callbacks.append(default)
        trainer = super().instantiate_trainer(callbacks=callbacks, **kwargs)
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            trainer.strategy.checkpoint_io = WholeCheckpoints()
        if self.subcommand == "fit":
            names = "max_steps", "max_epochs", "limit_train_batches"
            zero = [name for name in names if getattr(trainer, name) == 0]
            if any(isinstance(callback, Timer) and not callback.time_remaining() for callback in trainer.callbacks):  # type: ignore[attr-defined]
                zero.append("max_time")
            if zero:
                raise ValueError(f"trainer.{zero[0]} is 0: at least one step of training expected")
        return trainer

    def _parse_ckpt_path(self) -> None:
        """Take no configuration from a checkpoint: it could name any class to be made."""

    def _run_subcommand(self, subcommand: str) -> None:
        """Run a subcommand; only one training at a time writes a folder, and none replaces another."""
        with ExitStack() as stack:
            if subcommand == "fit" and self.trainer.is_global_zero:
                folder = Path(self.trainer.default_root_dir)
                if folder.exists() and not folder.is_dir():
                    raise FileExistsError(f"{folder} is a file: expected a folder for the run, or a new name")
                folder.mkdir(parents=True, exist_ok=True)
                stack.enter_context(exclusive(folder))
                stack.enter_context(full_disk_names(folder))
                last = folder / "checkpoints" / "last.ckpt"
                if last.exists() and self.config[subcommand].get("ckpt_path") is None:
                    advice = f"go on with it by --ckpt_path {last}, or choose another --trainer.default_root_dir"
                    raise FileExistsError(f"{folder} holds a run already: {advice}")
            super()._run_subcommand(subcommand)

    def before_fit(self) -> None:
        """Check the checkpoint; only ``fit`` needs none, without one it begins a new run."""
        self.config_init[self.subcommand]["weights_only"] = True  # nothing that a checkpoint names is run
        path = self.config[self.subcommand].get("ckpt_path")
        if path is None:
            if self.subcommand != "fit":
                raise ValueError("give the checkpoint by --ckpt_path; without one the network would be untrained")
            return
        if not Path(path).is_file():
            raise FileNotFoundError(f"no checkpoint at {path}")
        expected = {key: value.shape for key, value in self.model.state_dict().items()}
        if {key: value.shape for key, value in _state_dict(path).items()} != expected:
            advice = "repeat the options of its run, or use the config.yaml that the run left in lightning_logs"
            raise ValueError(f"{path} holds another network than the one configured: {advice}")

    before_validate = before_test = before_predict = before_fit

    def after_fit(self) -> None:
        """Print whether the validation's errors are below those at the start, if they were measured there."""
        (found,) = (callback for callback in self.trainer.callbacks if isinstance(callback, AgainstStart))  # type: ignore[attr-defined]
        if not found.start:
            return
        if found.step < self.trainer.global_step:
            self.trainer.validate(self.model, datamodule=self.datamodule, verbose=False)
        if self.trainer.is_global_zero:
            print(found.summary())


def _state_dict(path: str) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint, which must not unfold to more than the file's own size."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > Path(path).stat().st_size:
            raise ValueError(f"it would unfold to {size} bytes")
        state = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
        if not all(isinstance(value, Tensor) for value in state.values()):
            raise TypeError("it holds something else than tensors")
    except Exception as error:  # a broken or forged file can raise anything
        raise ValueError(f"{path} is not a checkpoint of a training run, or not a whole one") from error
    return dict(state)


def _short_message(error: BaseException) -> str:
    """Return the options that an error of jsonargparse concerns, and the first one-line message among its causes."""
    options: dict[str, None] = {}
    while "\n" in str(error).strip() and error.__cause__ is not None:
        if isinstance(error, ArgumentError):
            options[str(error).splitlines()[0]] = None
        error = error.__cause__
    return " ".join([*options, str(error)])


def run(args: list[str]) -> dict[str, float]:
    """Run ``learnnorm fit``, ``validate``, ``test`` or ``predict`` and return the metrics that it logged last.

    Wrong arguments are a ValueError, Ctrl-C is a KeyboardInterrupt, SIGTERM a SystemExit with the code 143.
    """
    command, *options = with_config_paths(args)
    for message in UNWANTED_WARNINGS:
        warnings.filterwarnings("ignore", message=message)
    here = Path(__file__).parent
    for name in LOGGERS:
        logging.getLogger(name).addFilter(lambda log: log.levelno > logging.INFO or Path(log.pathname).parent == here)
    if options and not options[0].startswith("-"):
        raise ValueError(f"an option expected, got {options[0]!r}; a configuration is given by --config {options[0]}")
    if not any(option.startswith(("--config", "-c", "--model", "--help")) for option in options):
        names = ", ".join(name for name in config_names() if "/" not in name)
        example = f"learnnorm {command} --config crossview-synthetic{' --ckpt_path FILE' * (command != 'fit')}"
        raise ValueError(f"no configuration: give one by --config, a file or one of {names}, for example {example}")
    raises = {"exit_on_error": False}  # an exception instead of a usage of fifty lines
    try:
        with working_folder_importable():
            cli = TrainingCLI(
                command,
                model_class=EstimatorTask,
                subclass_mode_model=names_task(options),
                datamodule_class=CorrespondenceDataModule,
                args=[command, *options],
                auto_configure_optimizers=False,
                trainer_defaults={"callbacks": [ExpectedTime()], "num_sanity_val_steps": -1},
                parser_kwargs={"prog": "learnnorm", **raises, command: raises},
                save_config_kwargs={"overwrite": True},
            )
    except ArgumentError as error:
        raise ValueError(f"{_short_message(error)}; learnnorm {command} --help-all lists the options") from error
    except (MisconfigurationException, ValueError) as error:  # of a class that was configured: its data, for example
        raise ValueError(_short_message(error)) from error
    except SIGTERMException as error:  # a SystemExit without a code, which would end the program with 0
        raise SystemExit(128 + signal.SIGTERM) from error
    except SystemExit as error:  # Lightning exits so when it was interrupted
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise
    return {name: value.item() for name, value in cli.trainer.callback_metrics.items()}

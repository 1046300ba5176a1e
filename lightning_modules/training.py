"""The training commands: LightningCLI with the project's task and datamodule, and a look at the checkpoint first."""

from __future__ import annotations

import logging
import re
import signal
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from jsonargparse import ArgumentError
from lightning_fabric.utilities.exceptions import MisconfigurationException
from pytorch_lightning.callbacks import Callback, ModelCheckpoint, ProgressBar, Timer
from pytorch_lightning.cli import ArgsType, LightningArgumentParser, LightningCLI
from pytorch_lightning.utilities import rank_zero_only
from pytorch_lightning.utilities.exceptions import SIGTERMException
from torch import Tensor

from kornia_learnnorm.files import exclusive
from lightning_modules.callbacks import Checkpoints, ExpectedTime, ExportWeights, StepProgress
from lightning_modules.config_files import config_names, read_config, with_config_paths
from lightning_modules.datamodule import CorrespondenceDataModule
from lightning_modules.estimator_task import EstimatorTask
from lightning_modules.task import NormalizerTask

__all__ = ["TrainingCLI", "is_first_process", "run"]

# What Lightning prints of devices, of which a line of ours names the one that is used, its advertisements, the seed,
# which the configuration has, and how it saves a checkpoint.
UNWANTED_MESSAGE = re.compile(
    r"(GPU|TPU|HPU) available: |LOCAL_RANK: |\W*Tip: For seamless|(\[rank: \d+\] )?Seed set to |`weights_only` was not"
)
LOGGERS = (
    "lightning_fabric.utilities.seed",
    "pytorch_lightning.trainer.connectors.checkpoint_connector",
    "pytorch_lightning.utilities.rank_zero",
)
UNWANTED_WARNINGS = (
    ".*treespec, LeafSpec.*",  # Lightning's own call of torch
    ".*smaller than the logging interval.*",  # the interval counts the steps of all epochs
    "Checkpoint directory .* exists and is not empty.*",  # it is that of the run that goes on
)


class TrainingCLI(LightningCLI):
    """LightningCLI that refuses a missing or foreign checkpoint before anything runs, and always writes the weights.

    Args:
        command: the command that is run; the options of the others are not made.
        kwargs: arguments of LightningCLI.
    """

    def __init__(self, command: str, **kwargs: Any) -> None:
        self.command = command
        super().__init__(**kwargs)

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]  # it is static
        """Return the command, and the arguments of the trainer's method that are no options."""
        return {self.command: LightningCLI.subcommands()[self.command]}

    def parse_arguments(self, parser: LightningArgumentParser, args: ArgsType) -> None:
        """Parse the arguments; a configuration that ships with the package can be given by its name."""
        if isinstance(args, list):
            self.config = parser.parse_args(with_config_paths(args))
        else:
            super().parse_arguments(parser, args)

    def instantiate_trainer(self, **kwargs: Any) -> pl.Trainer:
        """Make the trainer, with what the configuration lacks: checkpoints, the export of the weights, progress."""
        config = self.config_init[self.subcommand]["trainer"]
        callbacks = config["callbacks"] or []
        callbacks = [*callbacks] if isinstance(callbacks, list) else [callbacks]
        if config["enable_checkpointing"] is not False and not _has(callbacks, ModelCheckpoint):
            callbacks.append(Checkpoints())
        if isinstance(self.model, NormalizerTask | EstimatorTask) and not _has(callbacks, ExportWeights):
            callbacks.append(ExportWeights())
        if config["enable_progress_bar"] is not False and not _has(callbacks, ProgressBar):
            callbacks.append(StepProgress())
        trainer = super().instantiate_trainer(callbacks=callbacks, **kwargs)
        if self.subcommand == "fit":
            _check_has_steps(trainer)
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
                last = folder / "checkpoints" / "last.ckpt"
                if last.exists() and self.config[subcommand].get("ckpt_path") is None:
                    raise FileExistsError(
                        f"{folder} holds a run already: go on with it by --ckpt_path {last}, or choose another folder"
                        " by --trainer.default_root_dir"
                    )
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
        state = _state_dict(path)
        expected = {key: value.shape for key, value in self.model.state_dict().items()}
        if {key: value.shape for key, value in state.items()} != expected:
            raise ValueError(
                f"{path} holds another network than the one configured: repeat the options of its run, or use the"
                " config.yaml that the run left in lightning_logs"
            )

    before_validate = before_test = before_predict = before_fit


def _has(callbacks: list[Callback], kind: type[Callback]) -> bool:
    """Return whether there is a callback of a class."""
    return any(isinstance(callback, kind) for callback in callbacks)


def _check_has_steps(trainer: pl.Trainer) -> None:
    """Raise ValueError if a trainer is set to no steps: its weights would be untrained."""
    names = "max_steps", "max_epochs", "limit_train_batches"
    zero = [name for name in names if getattr(trainer, name) == 0]
    if any(isinstance(callback, Timer) and not callback.time_remaining() for callback in trainer.callbacks):  # type: ignore[attr-defined]
        zero.append("max_time")
    if zero:
        raise ValueError(f"trainer.{zero[0]} is 0: at least one step of training expected")


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


def is_first_process() -> bool:
    """Return whether this process is the only one or, of several that train together, the one that prints."""
    return bool(rank_zero_only.rank == 0)  # type: ignore[attr-defined]


def _leave_out_messages() -> None:
    """Leave out the messages and warnings of Lightning that concern nobody who trains."""
    for message in UNWANTED_WARNINGS:
        warnings.filterwarnings("ignore", message=message)
    for name in LOGGERS:
        logging.getLogger(name).addFilter(_is_wanted)


def _is_wanted(record: logging.LogRecord) -> bool:
    """Return whether a message of Lightning concerns who trains."""
    return not UNWANTED_MESSAGE.match(record.getMessage())


def _config_files(args: Sequence[str]) -> list[str]:
    """Return the paths of the configurations among the arguments."""
    files = [value for key, value in pairwise(args) if key in ("-c", "--config")]
    return files + [arg.partition("=")[2] for arg in args if arg.startswith("--config=")]


def _names_its_classes(config: dict[str, Any]) -> bool:
    """Return whether a configuration names the classes of its task and datamodule."""
    model = config.get("model")
    return isinstance(model, dict) and "class_path" in model


def _which_configurations(command: str, message: str, files: Sequence[str]) -> str:
    """Return what to give to a training command without a configuration, or with a part of one."""
    if files:
        missing = message.rpartition(": ")[2].replace(f"{command}.", "")
        return (
            f"{', '.join(files)} has no {missing}: give a whole configuration before it, for example learnnorm"
            f" {command} --config crossview --config {files[0]}"
        )
    names = ", ".join(name for name in config_names() if "/" not in name)
    checkpoint = "" if command == "fit" else " --ckpt_path runs/crossview-synthetic/checkpoints/last.ckpt"
    return (
        f"no configuration: give one by --config, a file or one of {names} (learnnorm config lists all); for example"
        f" learnnorm {command} --config crossview-synthetic{checkpoint}, which needs no data"
    )


def _short_message(message: str) -> str:
    """Return what is wrong with the arguments, of all that jsonargparse says about it, on one line."""
    unknown = re.search(r"(?:Option|does not accept option|unrecognized arguments:) '?([\w.-]+)", message)
    if unknown:
        classes = re.findall(r"Problem with given class_path '([\w.]+)'", message[: unknown.end()])
        of = f" of {classes[-1]}" if classes else ""
        return f"unknown option {unknown[1]}{of}"
    return _with_option(_first_error(message), message)


def _first_error(message: str) -> str:
    """Return, on one line, the error of the first type that jsonargparse tried: it is the one that was meant."""
    while tried := re.search(r"Does not validate against.*?Errors:\n( *)- (.*?)\n(?:\1-|(?!\1))", message, re.DOTALL):
        message = tried[2]
    return " ".join(message.split())


def _with_option(text: str, message: str) -> str:
    """Return an error of a type after the option that has it, and before the value that was given."""
    given = re.search(r"Given value: (.*?)(?:\. Got value: .*)?$", message, re.MULTILINE)
    if not given or not text.startswith("Expected a "):
        return text
    return ": ".join([*re.findall(r'Parser key "([\w.]+)"', message), f"{text}, got {given[1]}"])


def run(args: list[str]) -> dict[str, float]:
    """Run ``learnnorm fit``, ``validate``, ``test`` or ``predict`` and return the metrics that it logged last.

    Raises:
        ValueError: if the arguments or a configuration are wrong.
        KeyboardInterrupt: if the run was interrupted.
        SystemExit: with the code 143, as of a program that the signal SIGTERM ends, if that signal ended the run.

    """
    words = with_config_paths(args)
    command = words[0]
    _leave_out_messages()
    if words[1:] and not words[1].startswith("-"):
        raise ValueError(f"an option expected, got {words[1]!r}; a configuration is given by --config {words[1]}")
    configs = [read_config(path) for path in _config_files(words)]
    named = any(map(_names_its_classes, configs))
    raises = {"exit_on_error": False}  # an exception instead of a usage of fifty lines
    try:
        cli = TrainingCLI(
            command,
            model_class=pl.LightningModule if named else NormalizerTask,
            datamodule_class=pl.LightningDataModule if named else CorrespondenceDataModule,
            subclass_mode_model=named,
            subclass_mode_data=named,
            args=args,
            auto_configure_optimizers=False,
            trainer_defaults={"callbacks": [ExpectedTime()]},
            parser_kwargs={"prog": "learnnorm", **raises, command: raises},
            save_config_kwargs={"overwrite": True},
        )
    except ArgumentError as error:
        if "are required" in str(error):
            raise ValueError(_which_configurations(command, str(error), _config_files(words))) from error
        raise ValueError(f"{_short_message(str(error))}; learnnorm {command} --help-all lists the options") from error
    except ValueError as error:  # of a class that was configured: its data, for example
        raise ValueError(_first_error(str(error))) from error
    except MisconfigurationException as error:  # such as a test of an estimator, whose task has none
        raise ValueError(str(error)) from error
    except SIGTERMException as error:  # a SystemExit without a code, which would end the program with 0
        raise SystemExit(128 + signal.SIGTERM) from error
    except SystemExit as error:  # Lightning exits so when it was interrupted
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise
    return {name: value.item() for name, value in cli.trainer.callback_metrics.items()}

"""The training commands: LightningCLI with the project's task and datamodule, and a look at the checkpoint first."""

from __future__ import annotations

import pickle
import sys
import warnings
from itertools import pairwise
from pathlib import Path

import torch
from pytorch_lightning.cli import LightningCLI

from lightning_modules.datamodule import CorrespondenceDataModule
from lightning_modules.task import NormalizerTask

__all__ = ["TrainingCLI", "run"]


class TrainingCLI(LightningCLI):
    """LightningCLI that refuses a missing or foreign checkpoint before anything runs."""

    def before_fit(self) -> None:
        """Check the checkpoint to resume from, where one is given."""
        self._check_checkpoint(required=False)

    def before_validate(self) -> None:
        """Check the checkpoint."""
        self._check_checkpoint(required=True)

    def before_test(self) -> None:
        """Check the checkpoint."""
        self._check_checkpoint(required=True)

    def before_predict(self) -> None:
        """Check the checkpoint."""
        self._check_checkpoint(required=True)

    def _check_checkpoint(self, required: bool) -> None:
        path = self.config[self.subcommand].get("ckpt_path")
        if path is None:
            if required:
                raise ValueError("give the checkpoint by --ckpt_path; without one the network would be untrained")
            return
        if not Path(path).is_file():
            raise FileNotFoundError(f"no checkpoint at {path}")
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
        except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not a checkpoint of a training run") from error
        expected = {key: value.shape for key, value in self.model.state_dict().items()}
        if {key: value.shape for key, value in state.items()} != expected:
            raise ValueError(
                f"{path} holds another network than the one configured: repeat the options of its run, or use the"
                " config.yaml that the run left in lightning_logs"
            )


def run(args: list[str] | None) -> None:
    """Run ``learnnorm fit``, ``validate``, ``test`` or ``predict``.

    Args:
        args: command line without the program's name; ``sys.argv`` when not given.

    Raises:
        ValueError: if the configuration or the checkpoint is wrong.
        OSError: if a file is missing or cannot be written.

    """
    warnings.filterwarnings("ignore", message=".*treespec, LeafSpec.*")  # Lightning's own call of torch
    try:
        TrainingCLI(
            NormalizerTask,
            CorrespondenceDataModule,
            args=args,
            auto_configure_optimizers=False,
            parser_kwargs={"prog": "learnnorm"},
            save_config_kwargs={"overwrite": True},
        )
    # The parser has a look at the checkpoint too, before the hooks run.
    except (pickle.UnpicklingError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "PytorchStreamReader" not in str(error):
            raise
        words = [part for word in (sys.argv if args is None else args) for part in word.split("=", 1)]
        given = [second for first, second in pairwise(words) if first == "--ckpt_path"]
        path = given[-1] if given else "the file given by --ckpt_path"
        raise ValueError(f"{path} is not a checkpoint of a training run, or not a whole one") from error

"""The command ``learnnorm``: training by LightningCLI, and the commands that need no training."""

from __future__ import annotations

import argparse
import importlib
import sys
import warnings
from collections.abc import Sequence

__all__ = ["main"]

TRAINING = {
    "fit": "train a normaliser",
    "validate": "validate a checkpoint",
    "test": "test a checkpoint",
    "predict": "write the predictions of a checkpoint",
}
TOOLS = {
    "estimate": ("kornia_learnnorm.evaluation.estimate", "the fundamental matrix of two images"),
    "evaluate": ("kornia_learnnorm.evaluation.evaluate", "better rates and errors on stores of correspondences"),
    "synthesize": ("kornia_learnnorm.data.synthesize", "a synthetic store and a rendered image pair"),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        args: command line without the program's name; ``sys.argv`` when not given.

    Returns:
        the exit code, 0, or 2 after an error, of which one line is printed.

    """
    given, args = args, list(sys.argv[1:] if args is None else args)
    if args and args[0] in TRAINING:
        return _train(args[0], None if given is None else args)
    parser = argparse.ArgumentParser(prog="learnnorm", description="Learned normalisation of the eight-point algorithm")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in TRAINING.items():
        commands.add_parser(name, help=text, add_help=False)
    for name, (_, text) in TOOLS.items():
        command = commands.add_parser(name, help=text, description=text)
        if args[:1] == [name]:
            importlib.import_module(TOOLS[name][0]).add_arguments(command)
    parsed = parser.parse_args(args)
    try:
        return int(importlib.import_module(TOOLS[parsed.command][0]).run(parsed))
    except (ValueError, OSError, ImportError) as error:
        return _fail(parsed.command, error)


def _train(command: str, args: list[str] | None) -> int:
    try:
        from pytorch_lightning.cli import LightningCLI

        from lightning_modules.datamodule import CorrespondenceDataModule
        from lightning_modules.task import NormalizerTask
    except ImportError as error:
        return _fail(command, ImportError(f"{error}: pip install 'kornia-learnnorm[train]'"))
    warnings.filterwarnings("ignore", message=".*treespec, LeafSpec.*")  # Lightning's own call of torch
    try:
        LightningCLI(
            NormalizerTask,
            CorrespondenceDataModule,
            args=args,
            auto_configure_optimizers=False,
            parser_kwargs={"prog": "learnnorm"},
            save_config_kwargs={"overwrite": True},
        )
    except (ValueError, FileNotFoundError) as error:
        return _fail(command, error)
    return 0


def _fail(command: str, error: Exception) -> int:
    print(f"learnnorm {command}: error: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())

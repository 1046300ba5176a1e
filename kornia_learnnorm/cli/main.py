"""The command ``learnnorm``: training by LightningCLI, and the commands that need no training."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence

import kornia_learnnorm

__all__ = ["main"]

TRAINING = {
    "fit": "train a normaliser",
    "validate": "validate a checkpoint",
    "test": "test a checkpoint",
    "predict": "write the predictions of a checkpoint",
}
TOOLS = {
    "estimate": ("kornia_learnnorm.cli.estimate", "the fundamental matrix of two images"),
    "evaluate": ("kornia_learnnorm.cli.evaluate", "better rates and errors on stores of correspondences"),
    "diagnose": ("kornia_learnnorm.cli.diagnose", "condition number, rank-2 error and other diagnostics"),
    "compare": ("kornia_learnnorm.cli.compare", "trained weights side by side, with confidence intervals"),
    "robust": ("kornia_learnnorm.cli.robust", "robust estimators and minimal solvers on stores"),
    "report": ("kornia_learnnorm.cli.report", "tables and figures of what evaluate --out and robust wrote"),
    "match": ("kornia_learnnorm.cli.match", "a store of correspondences from folders of images"),
    "convert": ("kornia_learnnorm.cli.convert", "a store from or to the files of hloc"),
    "synthesize": ("kornia_learnnorm.cli.synthesize", "a synthetic store and a rendered image pair"),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        args: command line without the program's name; ``sys.argv`` when not given.

    Returns:
        the exit code, 0, or 2 after an error, of which one line is printed, or 130 when interrupted.

    """
    words = list(sys.argv[1:] if args is None else args)
    try:
        if words and words[0] in TRAINING:
            return _train(words[0], None if args is None else words)
        return _run_tool(words)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _run_tool(args: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="learnnorm", description="Learned normalisation of the eight-point algorithm")
    parser.add_argument("--version", action="version", version=f"%(prog)s {kornia_learnnorm.__version__}")
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
        training = importlib.import_module("lightning_modules.training")
    except ImportError as error:
        return _fail(command, ImportError(f"{error}: pip install 'kornia-learnnorm[train]'"))
    try:
        training.run(args)
    except (ValueError, OSError) as error:
        return _fail(command, error)
    return 0


def _fail(command: str, error: Exception) -> int:
    # jsonargparse lists what each type that it tried had to say: the first is the one that was meant.
    first = re.search(r"Does not validate against.*?Errors:\s*- (.*?)\n", str(error), flags=re.DOTALL)
    text = first[1] if first else str(error)
    print(f"learnnorm {command}: error: {' '.join(text.split())}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())

"""The command ``learnnorm``: training by LightningCLI, and the commands that need no training."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence

import kornia_learnnorm
from kornia_learnnorm.optional import import_extra

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
    "compare": ("kornia_learnnorm.cli.compare", "methods side by side over several stores, with confidence intervals"),
    "robust": ("kornia_learnnorm.cli.robust", "robust estimators and minimal solvers on stores"),
    "report": ("kornia_learnnorm.cli.report", "tables and figures of what evaluate --out and robust wrote"),
    "match": ("kornia_learnnorm.cli.match", "a store of correspondences from folders of images"),
    "convert": ("kornia_learnnorm.cli.convert", "a store from or to the files of hloc"),
    "synthesize": ("kornia_learnnorm.cli.synthesize", "a synthetic store and a rendered image pair"),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run a command, from ``sys.argv`` if None, and return its exit code.

    It is 0; 2 after an error, whose message is printed as one line; 130 when interrupted.
    """
    words = list(sys.argv[1:] if args is None else args)
    try:
        if words and words[0] in TRAINING:
            training = import_extra("lightning_modules.training", "train", "training")
            training.run(None if args is None else words)
            return 0
        return _run_tool(words)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError, ImportError) as error:
        print(f"learnnorm {words[0]}: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _run_tool(words: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="learnnorm", description="Learned normalisation of the eight-point algorithm")
    parser.add_argument("--version", action="version", version=f"%(prog)s {kornia_learnnorm.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in TRAINING.items():
        commands.add_parser(name, help=text, add_help=False)
    for name, (module, text) in TOOLS.items():
        command = commands.add_parser(name, help=text, description=text)
        if words[:1] == [name]:
            tool = importlib.import_module(module)
            tool.add_arguments(command)
            command.set_defaults(run=tool.run)
    parsed = parser.parse_args(words)
    return int(parsed.run(parsed))


def _one_line(error: Exception) -> str:
    """Return the message of an error on one line."""
    # jsonargparse lists what each type that it tried had to say: the first is the one that was meant.
    first = re.search(r"Does not validate against.*?Errors:\s*- (.*?)\n", str(error), flags=re.DOTALL)
    return " ".join((first[1] if first else str(error)).split())


if __name__ == "__main__":
    sys.exit(main())

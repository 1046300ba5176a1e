"""The command ``learnnorm``: training by LightningCLI, and the commands that need no training."""

import argparse
import importlib
import math
import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Sequence
from contextlib import redirect_stdout
from typing import Any

import kornia_learnnorm
from kornia_learnnorm.optional import import_extra

EXAMPLES = """\
learnnorm estimate left.png right.png --out pair.png
learnnorm fit --config crossview-synthetic"""
REPEAT = "Options that were changed for fit have to be repeated."
# What a command does, in one line and in more.
TRAINING = {
    "fit": (
        "train a normaliser or an estimator",
        "Writes checkpoints/last.ckpt, weights.safetensors and lightning_logs, with the\n"
        "configuration and the curves, to trainer.default_root_dir.",
    ),
    "validate": ("validate a checkpoint", f"Prints the metrics on data.val of the configuration.\n{REPEAT}"),
    "test": (
        "test a checkpoint",
        f"Prints the metrics on data.test of the configuration; estimators have no test.\n{REPEAT}",
    ),
    "predict": (
        "write the predictions of a checkpoint",
        "Writes predictions.safetensors, with the transforms, matrices and residuals of\n"
        f"the samples of data.test, to trainer.default_root_dir.\n{REPEAT}",
    ),
}
MEASURED = {"validate": "data.val", "test": "data.test"}  # commands that print metrics, and of which data
TRAINING_EXAMPLES = """\
learnnorm fit --config crossview-synthetic --trainer.default_root_dir runs/own
learnnorm fit --config crossview --config own.yaml --trainer.max_steps 500"""
CHECKPOINT_EXAMPLES = """\
learnnorm {0} --config crossview --ckpt_path run/checkpoints/last.ckpt
learnnorm {0} --config crossview --config own.yaml --ckpt_path last.ckpt"""
TOOLS = {
    "estimate": ("kornia_learnnorm.cli.estimate", "the fundamental matrix or homography of two images"),
    "demo": ("kornia_learnnorm.cli.demo", "a browser page to try two of your images"),
    "evaluate": ("kornia_learnnorm.cli.evaluate", "better rates and errors on stores of correspondences"),
    "robust": ("kornia_learnnorm.cli.robust", "robust estimators on stores"),
    "report": ("kornia_learnnorm.cli.report", "tables and figures of a run of evaluate --out or robust"),
    "match": ("kornia_learnnorm.cli.match", "a store of correspondences from folders of images"),
    "export-colmap": ("kornia_learnnorm.cli.export_colmap", "a COLMAP database from a folder of images"),
    "synthesize": ("kornia_learnnorm.cli.synthesize", "a synthetic store and a rendered image pair"),
    "export": ("kornia_learnnorm.cli.export", "a layer as a program that runs without this package"),
    "config": ("kornia_learnnorm.cli.config", "print a configuration for training"),
}
COMPLETION = "print the completion of commands and options for a shell"
COMPLETION_EXAMPLES = """\
learnnorm completion bash \\
  > ~/.local/share/bash-completion/completions/learnnorm
learnnorm completion fish > ~/.config/fish/completions/learnnorm.fish"""
# Arguments that are completed with names of files and of folders, by what the help calls them.
FILES = ("CAMERA", "FILE", "IMG", "LIST", "NAME_OR_PATH", "PATH", "STORE", "STORE.h5")
FOLDERS = ("FOLDER", "ROOT", "RUN")


def main(args: Sequence[str] | None = None) -> int:
    """Run a command, from ``sys.argv`` if None, and return its exit code.

    It is 0; 2 after an error, whose message is printed as one line; 130 when interrupted; 141, the code for SIGPIPE,
    when the reader of the output, such as ``head``, has closed it.
    """
    words = list(sys.argv[1:] if args is None else args)
    try:
        try:
            if not words or words[0] not in TRAINING:
                return _run_tool(words)
            if {"-h", "--help"} & {*words}:
                return _run_tool([words[0], "--help"])
            return _run_training(words)
        finally:
            sys.stdout.flush()  # what is not written yet fails here instead of when Python ends
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # takes what is still in the buffer
        return 141
    except (ValueError, OSError, ImportError) as error:
        text = str(error)
        if isinstance(error, OSError) and error.strerror and error.filename:  # in words, not as Python shows it
            text = f"{error.filename2 or error.filename}: {error.strerror}"  # the second is the target of a move
        print(f"learnnorm {words[0]}: error: {' '.join(text.split())}", file=sys.stderr)
        return 2


def make_parser(names: Collection[str] = (*TRAINING, *TOOLS)) -> argparse.ArgumentParser:
    """Return the parser of the command line; only the modules of the named commands are imported, for their arguments.

    Of the training options, only the most common are listed in the help; LightningCLI parses these and all others.
    """
    parser = argparse.ArgumentParser(prog="learnnorm", formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.description, parser.epilog = "F, E and H from matches with outliers", _examples(EXAMPLES)
    parser.add_argument("--version", action="version", version=f"%(prog)s {kornia_learnnorm.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (text, about) in TRAINING.items():
        command = commands.add_parser(name, help=text, description=f"{text}\n\n{about}", formatter_class=HelpFormatter)
        if name in names:
            _add_training_arguments(command, name)
            command.epilog = _examples(TRAINING_EXAMPLES if name == "fit" else CHECKPOINT_EXAMPLES.format(name))
    for name, (module, text) in TOOLS.items():
        command = commands.add_parser(name, help=text, description=text, formatter_class=HelpFormatter)
        if name in names:
            tool = importlib.import_module(module)
            tool.add_arguments(command)
            command.epilog = _examples(tool.EXAMPLES)
            command.set_defaults(run=tool.run, error=command.error)
    command = commands.add_parser("completion", help=COMPLETION, description=COMPLETION, formatter_class=HelpFormatter)
    command.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="bash, zsh or fish")
    command.epilog = _examples(COMPLETION_EXAMPLES)
    command.set_defaults(run=_print_completion, error=command.error)
    return parser


def _examples(lines: str) -> str:
    return "examples:\n" + textwrap.indent(lines, "  ")


def _add_training_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    parser.add_argument("--help-all", action="store_true", help="list all options: the entries of a configuration")
    text = "configuration: a name that learnnorm config lists, or a file; can be repeated, later entries win"
    parser.add_argument("--config", metavar="NAME_OR_FILE", action="append", required=True, help=text)
    text = "checkpoint of the run to continue" if name == "fit" else "checkpoint of the run"
    parser.add_argument("--ckpt_path", metavar="FILE", required=name != "fit", help=text)
    parser.add_argument("--trainer.default_root_dir", metavar="FOLDER", help="folder to write to")
    if name == "fit":
        parser.add_argument("--trainer.max_steps", metavar="N", help="steps of the training")
    parser.add_argument("--trainer.accelerator", metavar="NAME", help="device: auto, cpu, gpu")
    parser.add_argument("--data.batch_size", metavar="N", help="sets in a batch")
    if name == "fit":
        parser.add_argument("--print_config", action="store_true", help="print the whole configuration and exit")
    if name in MEASURED:
        from kornia_learnnorm.cli.evaluate import add_json_argument

        add_json_argument(parser)


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Format the help of a command for one screen: only required arguments in the usage, examples as they stand."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32, width=min(shutil.get_terminal_size().columns, 120) - 2)

    def add_usage(
        self, usage: str | None, actions: Iterable[argparse.Action], groups: Iterable[Any], prefix: str | None = None
    ) -> None:
        """Show optional arguments as [options]: they are listed below."""
        required = [group for group in groups if group.required]
        members = {id(action) for group in required for action in group._group_actions}  # noqa: SLF001
        shown = [a for a in actions if a.required or id(a) in members or (not a.option_strings and a.nargs == "?")]
        rest = argparse.Action([], "options", metavar="[options]")
        super().add_usage(usage, [*shown, rest], required, prefix)


def _print_completion(args: argparse.Namespace) -> int:
    shtab = import_extra("shtab", "completion", "completion in the shell")
    from lightning_modules.config_files import config_names

    parser = make_parser()
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))  # noqa: SLF001
    for name, command in commands.choices.items():
        for action in command._actions:  # noqa: SLF001
            if name in TRAINING and action.dest == "config":
                action.choices = config_names()
            if not action.choices and action.metavar in (*FILES, *FOLDERS):
                action.complete = shtab.FILE if action.metavar in FILES else shtab.DIRECTORY
    print(shtab.complete(parser, args.shell))
    return 0


def _run_tool(words: list[str]) -> int:
    parsed, unknown = make_parser(words[:1]).parse_known_args(words)
    if unknown:  # parse_args would print the usage of learnnorm instead of the command's
        hint = f"learnnorm {parsed.command} --help lists the options"
        parsed.error(f"unrecognized arguments: {shlex.join(unknown)}; {hint}")
    parsed.command_line = shlex.join(["learnnorm", *words])
    return int(parsed.run(parsed))


def _run_training(words: list[str]) -> int:
    """Run a training command; ``--json`` writes the metrics that it prints."""
    training = import_extra("lightning_modules.training_command", "train", "training")
    words = ["--help" if word == "--help-all" else word for word in words]
    if words[0] not in MEASURED:
        training.run(words)
        return 0
    from pytorch_lightning.utilities import rank_zero_only

    from kornia_learnnorm.cli.evaluate import add_json_argument, json_tables
    from kornia_learnnorm.evaluation.tables import Number, Table

    usage = f"learnnorm {words[0]} --config NAME_OR_FILE --ckpt_path FILE [options]"
    parser = argparse.ArgumentParser(f"learnnorm {words[0]}", usage, add_help=False, allow_abbrev=False)
    add_json_argument(parser)
    args, options = parser.parse_known_args(words)
    args.command_line = shlex.join(["learnnorm", *words])
    if rank_zero_only.rank != 0:  # type: ignore[attr-defined]  # the first process prints
        args.json = None
    with json_tables(args, [word.rpartition("=")[2] for word in options]) as tables:
        with redirect_stdout(sys.stderr if args.json == "-" else sys.stdout):
            metrics = training.run(options)
        rows = [[name, "" if math.isnan(value) else Number(value, "")] for name, value in metrics.items()]
        tables.append(Table(words[0], f"metrics on {MEASURED[words[0]]}", ["metric", "value"], rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())

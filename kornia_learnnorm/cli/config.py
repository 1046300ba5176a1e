"""Print a training configuration, to edit: ``learnnorm config``."""

import argparse

from lightning_modules.config_files import config_names, find_config

EXAMPLES = """\
learnnorm config crossview > full.yaml
learnnorm fit --config full.yaml --trainer.default_root_dir runs/own"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm config`` to a parser."""
    parser.add_argument("name", metavar="NAME", nargs="?", help="configuration to print; without it, list the names")


def run(args: argparse.Namespace) -> int:
    """Print a configuration, or the names of all configurations."""
    text = "\n".join(config_names()) if args.name is None else find_config(args.name).read_text(encoding="utf-8")
    print(text.rstrip())
    return 0

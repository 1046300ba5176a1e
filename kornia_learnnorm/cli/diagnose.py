"""What each normalisation does inside the eight-point algorithm: ``learnnorm diagnose``."""

from __future__ import annotations

import argparse

from kornia_learnnorm.cli.evaluate import add_run_arguments, json_tables, print_table, run_arguments
from kornia_learnnorm.evaluation.runs.record import temporary_run
from kornia_learnnorm.evaluation.tables import DIAGNOSTICS, Table, diagnostic_rows
from kornia_learnnorm.protocol import RATIO

__all__ = ["EXAMPLES", "add_arguments", "run"]

EXAMPLES = """\
learnnorm diagnose store.h5 --sizes 8 20 100
learnnorm diagnose store.h5 --methods Hartley crossview --max-residual inf"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm diagnose`` to a parser."""
    add_run_arguments(parser)
    parser.add_argument(
        "--sizes", metavar="N", type=int, nargs="+", default=[8], help="correspondences in a sample (default: 8)"
    )


def run(args: argparse.Namespace) -> int:
    """Print a table of medians per store and sample size."""
    with json_tables(args, [*args.stores, *(args.weights or ())]) as tables:
        for size in args.sizes:
            for cell in temporary_run(*run_arguments(args, size), protocols=["filtered"]).cells:
                about = f"medians over {len(cell.pair)} of {cell.drawn} samples of {size}, ratio below {RATIO:g}"
                about += f", un-normalised residual below {args.max_residual:g} px"
                rows = diagnostic_rows(cell.predictions)
                tables.append(Table(f"{cell.store}, samples of {size}", about, [*DIAGNOSTICS], rows))
                print_table(args, f"{cell.store}: {about}", tables[-1])
    return 0

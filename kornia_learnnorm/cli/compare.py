"""Methods side by side over several stores, with confidence intervals: ``learnnorm compare``."""

from __future__ import annotations

import argparse

import torch

from kornia_learnnorm.cli.evaluate import add_run_arguments, json_tables, print_table, run_arguments
from kornia_learnnorm.evaluation.report.formatting import rate_text
from kornia_learnnorm.evaluation.runs.record import temporary_run
from kornia_learnnorm.evaluation.runs.run import Cell
from kornia_learnnorm.evaluation.tables import Table

__all__ = ["EXAMPLES", "add_arguments", "run"]

EXAMPLES = """\
learnnorm compare one.h5 two.h5@0:9
learnnorm compare store.h5 --weights runs/own/weights.safetensors"""

# Error and baseline of each table.
COMPARISONS = {
    "better than Hartley %": ("own", "Hartley"),
    "better than whitening %": ("own", "whitening"),
    "ground truth: better than Hartley %": ("truth", "Hartley"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm compare`` to a parser."""
    add_run_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print a table per comparison, with a row per method and a column per store."""
    with json_tables(args, [*args.stores, *(args.weights or ())]) as tables:
        cells = temporary_run(*run_arguments(args, size=8), protocols=["filtered"]).cells
        header = ["method", *map(_column, cells)]
        for title, (quantity, baseline) in COMPARISONS.items():
            rows = [[name, *(_rate(cell, name, baseline, quantity) for cell in cells)] for name in cells[0].predictions]
            tables.append(Table(title, "", header, rows))
            print_table(args, title, tables[-1])
    return 0


def _column(cell: Cell) -> str:
    pairs = len(torch.unique(cell.pair))
    return f"{cell.store}: {len(cell.pair)} of {cell.drawn} samples, {pairs} pair{'s' * (pairs > 1)}"


def _rate(cell: Cell, name: str, baseline: str, quantity: str) -> str:
    if name == baseline or baseline not in cell.predictions:
        return "-"
    return rate_text(cell, name, baseline, quantity) or "-"

"""Methods side by side over several stores, with confidence intervals: ``learnnorm compare``."""

from __future__ import annotations

import argparse

import torch

from kornia_learnnorm.cli.evaluate import add_run_arguments, json_tables, print_table, run_arguments
from kornia_learnnorm.evaluation.report.formatting import MIN_BOOTSTRAP_PAIRS, known_parts, rate_text
from kornia_learnnorm.evaluation.runs.record import temporary_run
from kornia_learnnorm.evaluation.runs.run import Cell
from kornia_learnnorm.evaluation.tables import Table

__all__ = ["EXAMPLES", "add_arguments", "run"]

EXAMPLES = """\
learnnorm compare one.h5 two.h5@0:9
learnnorm compare store.h5 --weights runs/own/weights.safetensors"""

INTERVALS = f"in brackets: 95 % bootstrap interval over image pairs; fewer than {MIN_BOOTSTRAP_PAIRS} pairs have none"
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
    """Print a table per comparison, with a row per method and a column per store, without those that have no number."""
    with json_tables(args, [*args.stores, *(args.weights or ())]) as tables:
        stores, methods, options = run_arguments(args, size=8)
        if len(methods) < 2 or not {"Hartley", "whitening"} & {*methods}:
            raise ValueError(f"expected Hartley or whitening and methods to compare with it, got {' '.join(methods)}")
        cells = temporary_run(stores, methods, options, protocols=["filtered"]).cells
        header = ["method", *map(_column, cells)]
        for title, (quantity, baseline) in COMPARISONS.items():
            rows = [
                [name, *(_rate(cell, name, baseline, quantity) for cell in cells)]
                for name in cells[0].predictions
                if name != baseline
            ]
            if table := known_parts(Table(title, INTERVALS, header, rows)):
                tables.append(table)
                print_table(args, title, table)
        if args.json != "-":
            print(f"\n{INTERVALS}")
    return 0


def _column(cell: Cell) -> str:
    pairs = len(torch.unique(cell.pair))
    return f"{cell.store}: {len(cell.pair)} of {cell.drawn} samples, {pairs} pair{'s' * (pairs != 1)}"


def _rate(cell: Cell, name: str, baseline: str, quantity: str) -> str:
    return rate_text(cell, name, baseline, quantity) if baseline in cell.predictions else ""

"""Trained weights side by side over several stores, with confidence intervals: ``learnnorm compare``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kornia_learnnorm.cli.evaluate import beside_closed_forms, evaluation_samples
from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.predict import Normalizer, Residuals, evaluate_normalizers
from kornia_learnnorm.evaluation.tables import format_table, names_of
from kornia_learnnorm.metrics.better_rate import better_rate, comparable
from kornia_learnnorm.metrics.bootstrap import bootstrap_interval
from kornia_learnnorm.normalizers.learned import LearnedNormalizer

__all__ = ["add_arguments", "compare", "run"]

COMPARISONS = {
    "better than Hartley %": ("own", "Hartley"),
    "better than whitening %": ("own", "whitening"),
    "ground truth: better than Hartley %": ("ground_truth", "Hartley"),
}


def compare(
    stores: Mapping[str, CorrespondenceStore],
    learned: Mapping[str, Normalizer],
    max_residual: float = 60.0,
    seed: int = 0,
) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Evaluate normalisers on the filtered samples of several stores.

    Args:
        stores: correspondences of image pairs by name.
        learned: normalisers by name; the closed forms and the searched optimum stand beside them.
        max_residual: samples whose un-normalised residual is not below this are left out, pixels.
        seed: seed of the shuffle.

    Returns:
        header and rows of a table for each comparison: a row per normaliser, a column per store, in each cell the rate
        and its 95 % bootstrap interval over image pairs.

    Raises:
        ValueError: if no pair of a store fills a sample, no sample passes the filter, or a normaliser has the name of a
            closed form.

    """
    normalizers = beside_closed_forms(learned)
    header, columns = ["method"], []
    for name, store in stores.items():
        samples, drawn = evaluation_samples(store, RATIO, max_residual, seed)
        pairs = len(torch.unique(samples.pair))
        header.append(f"{name}: {len(samples.pair)} of {drawn} samples, {pairs} pair{'s' * (pairs > 1)}")
        columns.append((samples.pair, evaluate_normalizers(samples, store, normalizers)))
    return {
        title: (header, [[method, *_cells(method, columns, field, baseline)] for method in normalizers])
        for title, (field, baseline) in COMPARISONS.items()
    }


def _cells(method: str, columns: Sequence[tuple[Tensor, dict[str, Residuals]]], field: str, baseline: str) -> list[str]:
    if method == baseline:
        return ["-"] * len(columns)
    return [
        _cell(getattr(residuals[method], field), getattr(residuals[baseline], field), pair)
        for pair, residuals in columns
    ]


def _cell(residual: Tensor, baseline: Tensor, pair: Tensor) -> str:
    """A better rate and its interval, over the samples that can be compared."""
    valid = comparable(residual, baseline)
    if not bool(valid.any()):
        return "-"
    rate = f"{100 * better_rate(residual, baseline).rate:.1f}"
    if len(torch.unique(pair[valid])) < 2:
        return rate
    low, high = bootstrap_interval((residual < baseline)[valid].double(), pair[valid])
    return f"{rate} [{100 * low:.1f}, {100 * high:.1f}]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm compare`` to a parser."""
    parser.add_argument(
        "stores", metavar="STORE", nargs="+", help="stores of correspondences (.h5); FILE.h5@3:10 for some pairs"
    )
    parser.add_argument(
        "--weights",
        metavar="NAME_OR_PATH",
        nargs="+",
        required=True,
        help="weights to compare, RUN/weights.safetensors",
    )


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm compare``: print a table per comparison, with a row per normaliser and a column per store.

    Raises:
        FileNotFoundError: if a store or weights are missing.
        ValueError: if a store or weights cannot be read, or two have the same name.

    """
    stores = dict(zip(names_of(args.stores), map(read_store, args.stores), strict=True))
    learned = dict(zip(names_of(args.weights), map(LearnedNormalizer.from_pretrained, args.weights), strict=True))
    for title, (header, rows) in compare(stores, learned).items():
        print(f"\n{title}\n\n{format_table(header, rows)}", flush=True)
    return 0

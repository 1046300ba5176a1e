"""What each normalisation does inside the eight-point algorithm: ``learnnorm diagnose``."""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from kornia_learnnorm.cli.evaluate import beside_closed_forms
from kornia_learnnorm.data.samples import RATIO, draw_samples
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.diagnostics import Diagnostics, diagnose
from kornia_learnnorm.evaluation.predict import Normalizer
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.normalizers.learned import LearnedNormalizer

__all__ = ["add_arguments", "diagnose_store", "run"]

HEADER = ("method", "condition number", "rho", "distance 1", "distance 2", "error due to rank 2 %")


def diagnose_store(
    store: CorrespondenceStore, weights: list[str], size: int, seed: int = 0
) -> tuple[int, list[list[str]]]:
    """Take the medians of the diagnostics over all samples of a seeded shuffle.

    Args:
        store: correspondences of image pairs; those that pass the ratio test are used.
        weights: names or paths for :meth:`~kornia_learnnorm.LearnedNormalizer.from_pretrained`.
        size: correspondences in a sample.
        seed: seed of the shuffle.

    Returns:
        the number of samples, and the rows of the table: condition number, singularity ratio, mean normalised
        distances of both views, share of the error that the rank-2 projection adds.

    Raises:
        ValueError: if ``size`` is below 8 or no pair fills a sample.

    """
    samples = draw_samples(store, torch.Generator().manual_seed(seed), size, RATIO)
    normalizers = beside_closed_forms({f"learned: {name}": LearnedNormalizer.from_pretrained(name) for name in weights})
    x1, x2 = samples.points1.double(), samples.points2.double()
    rows = []
    for name, normalizer in normalizers.items():
        *numbers, share = (values.nanquantile(0.5).item() for values in _diagnose(x1, x2, normalizer))
        rows.append([name, *(f"{number:.4g}" for number in numbers), f"{100 * share:z.0f}"])
    return len(samples.pair), rows


@torch.no_grad()
def _diagnose(x1: Tensor, x2: Tensor, normalizer: Normalizer, batch_size: int = 4096) -> Diagnostics:
    parts = [
        diagnose(*batch, normalizer)
        for batch in zip(torch.split(x1, batch_size), torch.split(x2, batch_size), strict=True)
    ]
    return Diagnostics(*map(torch.cat, zip(*parts, strict=True)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm diagnose`` to a parser."""
    parser.add_argument("store", metavar="STORE", help="store of correspondences (.h5); FILE.h5@3:10 for some pairs")
    parser.add_argument(
        "--weights",
        metavar="NAME_OR_PATH",
        nargs="+",
        default=["paper", "crossview"],
        help="weights to diagnose (default: %(default)s)",
    )
    parser.add_argument(
        "--sizes", metavar="N", type=int, nargs="+", default=[8], help="correspondences in a sample (default: 8)"
    )


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm diagnose``: print a table of medians per sample size.

    Raises:
        FileNotFoundError: if the store or weights are missing.
        ValueError: if the store or weights cannot be read, or a size is below 8 or above what every pair has.

    """
    store = read_store(args.store)
    for name in args.weights:
        LearnedNormalizer.from_pretrained(name)
    print(f"\n{args.store}: {store.dataset or 'no description'}, medians over samples, ratio below {RATIO:g}")
    for size in args.sizes:
        number, rows = diagnose_store(store, args.weights, size)
        print(f"\n{number} samples of {size}\n\n{format_table(HEADER, rows)}", flush=True)
    return 0

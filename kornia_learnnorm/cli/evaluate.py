"""Better rates and errors of the normalisers on stores of correspondences: ``learnnorm evaluate``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from kornia_learnnorm.data.samples import RATIO, Samples, draw_samples, plain_residual
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.methods import DEFAULT_METHODS
from kornia_learnnorm.evaluation.predict import Normalizer, evaluate_normalizers
from kornia_learnnorm.evaluation.runs.record import record_run
from kornia_learnnorm.evaluation.runs.run import MAX_RESIDUAL
from kornia_learnnorm.evaluation.search import SearchedNormalizer
from kornia_learnnorm.evaluation.tables import HEADER, format_table, method_rows, names_of
from kornia_learnnorm.normalizers.closed_form import Hartley, Identity, Whitening
from kornia_learnnorm.normalizers.learned import LearnedNormalizer
from kornia_learnnorm.normalizers.reweighted import ReweightedWhitening

__all__ = ["add_arguments", "beside_closed_forms", "evaluate_store", "evaluation_samples", "run"]

MAX_SAMPLES = 16000
DEFAULT_WEIGHTS = ("paper", "crossview", "crossview-synthetic")


def evaluate_store(
    store: CorrespondenceStore,
    weights: Sequence[str],
    max_ratio: float | None,
    max_residual: float = MAX_RESIDUAL,
    seed: int = 0,
) -> tuple[str, list[list[str]]]:
    """Evaluate the closed forms, trained weights and the searched optimum on all samples of a seeded shuffle.

    Args:
        store: correspondences of image pairs.
        weights: names or paths for :meth:`~kornia_learnnorm.LearnedNormalizer.from_pretrained`.
        max_ratio: 0.8 for the filtered samples, None for the unfiltered ones.
        max_residual: samples whose un-normalised residual is not below this are left out, pixels; infinite keeps all.
        seed: seed of the shuffle.

    Returns:
        a line that says what was evaluated, and the rows of the table.

    Raises:
        ValueError: if no pair fills a sample or no sample passes the filter.

    """
    samples, drawn = evaluation_samples(store, max_ratio, max_residual, seed)
    learned = {f"learned: {name}": LearnedNormalizer.from_pretrained(name) for name in weights}
    residuals = evaluate_normalizers(samples, store, beside_closed_forms(learned))
    infinite = int(torch.stack([r.own for r in residuals.values()]).isinf().any(0).sum())
    kind = "unfiltered matches" if max_ratio is None else f"matches with ratio below {max_ratio:g}"
    about = f"{kind}: {len(samples.pair)} of {drawn} samples, un-normalised residual below {max_residual:g} px"
    if infinite:
        about += f"; {infinite} with a point on an epipole, not in the means"
    return about, method_rows(residuals)


def evaluation_samples(
    store: CorrespondenceStore, max_ratio: float | None, max_residual: float, seed: int
) -> tuple[Samples, int]:
    """Draw the samples of a seeded shuffle that pass the residual filter, and say how many there were before it.

    Raises:
        ValueError: if no pair fills a sample or no sample passes the filter.

    """
    samples = draw_samples(store, torch.Generator().manual_seed(seed), max_ratio=max_ratio)
    kept = plain_residual(samples.points1, samples.points2) < max_residual
    if not bool(kept.any()):
        raise ValueError(f"none of {len(kept)} samples has an un-normalised residual below {max_residual:g} px")
    return samples.select(kept), len(kept)


def beside_closed_forms(learned: Mapping[str, Normalizer]) -> dict[str, Normalizer]:
    """Put learned normalisers between the closed forms and the searched optimum, their limit.

    Raises:
        ValueError: if one has the name of a closed form.

    """
    closed_forms: dict[str, Normalizer] = {
        "none": Identity(),
        "Hartley": Hartley(),
        "whitening": Whitening(),
        "reweighted whitening": ReweightedWhitening(),
    }
    limit: dict[str, Normalizer] = {"searched optimum": SearchedNormalizer()}
    if taken := learned.keys() & {*closed_forms, *limit}:
        raise ValueError(f"a row of every table is called {', '.join(sorted(taken))} already: rename the weights")
    return {**closed_forms, **learned, **limit}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm evaluate`` to a parser."""
    parser.add_argument(
        "stores", metavar="STORE", nargs="+", help="stores of correspondences (.h5); FILE.h5@3:10 for some pairs"
    )
    parser.add_argument(
        "--weights",
        metavar="NAME_OR_PATH",
        nargs="+",
        help=f"weights in the printed tables (default: those that ship: {' '.join(DEFAULT_WEIGHTS)})",
    )
    parser.add_argument(
        "--max-residual",
        type=float,
        metavar="PX",
        help="leave samples out of the printed tables from this mean symmetric epipolar distance under the"
        f" un-normalised eight-point algorithm on (default: {MAX_RESIDUAL:g}, as for --out; inf: none)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the shuffle (default: %(default)s)")
    run = parser.add_argument_group("a run of predictions, for learnnorm report")
    run.add_argument("--out", metavar="RUN", help="folder to write predictions to, instead of printing tables")
    run.add_argument(
        "--methods",
        metavar="NAME",
        nargs="+",
        help="normalisers or weights, with +LM or +optimal or without; module:Name for your own"
        f" (default: {' '.join(DEFAULT_METHODS)})",
    )
    run.add_argument(
        "--max-samples",
        metavar="N",
        type=int,
        help=f"at most so many samples of each store and protocol, at random (default: {MAX_SAMPLES}; 0: all)",
    )


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm evaluate``: write predictions, or print two tables per store, for filtered and other matches.

    Raises:
        FileNotFoundError: if a store or weights are missing.
        ValueError: if a store or weights cannot be read.

    """
    if args.out is not None:
        return _record(args)
    if args.methods or args.max_samples is not None:
        raise ValueError("--methods and --max-samples are for a run of predictions: give --out too")
    weights = DEFAULT_WEIGHTS if args.weights is None else args.weights
    max_residual = MAX_RESIDUAL if args.max_residual is None else args.max_residual
    stores = {path: read_store(path) for path in args.stores}
    for name in weights:
        LearnedNormalizer.from_pretrained(name)
    for path, store in stores.items():
        print(f"\n{path}: {store.dataset or 'no description'}, {len(store)} pairs")
        for max_ratio in (RATIO, None):
            about, rows = evaluate_store(store, weights, max_ratio, max_residual, args.seed)
            print(f"\n{about}\n\n{format_table(HEADER, rows)}", flush=True)
    return 0


def _record(args: argparse.Namespace) -> int:
    """Write predictions."""
    if not args.out:
        raise ValueError("--out is empty: expected a folder")
    if args.weights is not None or args.max_residual is not None:
        raise ValueError(
            "--weights and --max-residual are for the printed tables: with --out, weights are among --methods and the"
            f" limit is {MAX_RESIDUAL:g} px"
        )
    if args.max_samples is not None and args.max_samples < 0:
        raise ValueError(f"--max-samples must be 0, for all, or more, got {args.max_samples}")
    folder, stores = Path(args.out), dict(zip(names_of(args.stores), args.stores, strict=True))
    most = MAX_SAMPLES if args.max_samples is None else args.max_samples
    no_example = record_run(folder, stores, args.methods or list(DEFAULT_METHODS), args.seed, most or None)
    if no_example:
        print(f"without Figures 10 and 11: {no_example}", file=sys.stderr)
    print(f"wrote {folder}; learnnorm report {folder} makes tables and figures of it")
    return 0

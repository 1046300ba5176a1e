"""Better rates and errors of methods on stores of correspondences: ``learnnorm evaluate``."""

import argparse
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

from kornia_learnnorm.evaluation.methods import KEPT_METHODS, SHIPPED, base_name, default_methods, short_name_of
from kornia_learnnorm.evaluation.report.method_tables import HEADER, method_rows, was_trained_on
from kornia_learnnorm.evaluation.runs.prediction_run import Run, SampleOptions, read_run, record_run, temporary_run
from kornia_learnnorm.evaluation.tables import Table, format_table, names_of, tables_as_json
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.pretrained import own_weights
from kornia_learnnorm.protocol import RATIO

EXAMPLES = """\
learnnorm evaluate store.h5 --methods Hartley crossview Hartley+LM --size 16
learnnorm evaluate store.h5 --out run && learnnorm report run"""

LEGEND = "mean, median: symmetric epipolar distance of a sample's own points, the fit; searched: the limit of them all"
TRUTH = "truth: of the ground-truth inliers of its pair, the accuracy; a better fit need not be more accurate"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm evaluate`` to a parser."""
    add = parser.add_argument
    add("stores", metavar="STORE", nargs="+", help="stores of correspondences (.h5); FILE.h5@3:10 for some pairs")
    text = "normalisers or weights, with +LM or +optimal or without; module:Name for your own (default: none, Hartley,"
    text += f" whitening, reweighted, {', '.join(SHIPPED)}, searched)"
    add("--methods", metavar="NAME", nargs="+", help=text)
    add("--weights", metavar="NAME_OR_PATH", nargs="+", help="weights to evaluate in addition to the methods")
    add("--seed", type=int, default=0, help="seed of the shuffle (default: %(default)s)")
    text = "leave out samples whose mean symmetric epipolar distance under the un-normalised eight-point algorithm is"
    text += " this or larger (default: %(default)g; inf: none)"
    add("--max-residual", type=float, metavar="PX", default=SampleOptions.max_residual, help=text)
    text = "largest number of random samples per store and protocol (default: %(default)s; 0: all)"
    add("--max-samples", metavar="N", type=int, default=SampleOptions.max_samples, help=text)
    add("--size", metavar="N", type=int, default=8, help="correspondences in a sample (default: %(default)s)")
    text = "folder to keep the predictions in, with everything that learnnorm report shows; the default methods are"
    add("--out", metavar="RUN", help=f"{text} then also {', '.join(KEPT_METHODS)}")
    add_json_argument(parser)


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--json`` to the parser of a command that prints tables."""
    parser.add_argument("--json", metavar="FILE", help="write the tables to this file as JSON; - for standard output")


@contextmanager
def json_tables(args: argparse.Namespace, inputs: Sequence[str] = ()) -> Iterator[list[Table]]:
    """Yield a list for the tables of a command, written as ``--json`` asks at the end; never over an input file."""
    tables: list[Table] = []
    if args.json in (None, "-"):
        yield tables
        if args.json:
            print(tables_as_json(args.command_line, tables))
        return
    taken = {Path(part).resolve() for name in inputs for part in (name, name.rpartition("@")[0])}
    if not args.json or Path(args.json).resolve() in taken:
        raise ValueError(f"--json {args.json}: expected a new file or -")
    with atomic_write(args.json) as beside:
        yield tables
        beside.write_text(tables_as_json(args.command_line, tables) + "\n", encoding="utf-8")
    print(f"\nwrote {args.json}")


def run(args: argparse.Namespace) -> int:
    """Make a run of predictions and print two tables per store, filtered and unfiltered."""
    if args.max_samples < 0:
        raise ValueError(f"--max-samples must be 0, for all, or more, got {args.max_samples}")
    if not args.max_residual >= 0:
        raise ValueError(f"--max-residual must be 0 or more, inf for all, got {args.max_residual:g}")
    stores = {name: path for path, name in names_of(args.stores).items()}
    weights = args.weights or ()
    methods = (*args.methods, *weights) if args.methods else default_methods(weights, kept=args.out is not None)
    for path in weights:
        if (name := short_name_of(path)) in SHIPPED and path != name:
            print(f"{name} is {path} here, not the weights of this name that ship", file=sys.stderr)
    options = SampleOptions(args.size, args.seed, args.max_samples or None, args.max_residual)
    with json_tables(args, [*args.stores, *(own_weights(base_name(name))[1] for name in methods)]) as tables:
        if args.out is None:
            _print_tables(args, temporary_run(stores, methods, options), tables)
            return 0
        if not args.out:
            raise ValueError("--out is empty: expected a folder")
        record_run(args.out, stores, methods, options, command=args.command_line)
        recorded = read_run(args.out)
        _print_tables(args, recorded, tables)
    if further := [name for name in recorded.about["methods"] if name not in map(short_name_of, methods)]:
        print(f"{args.out} also holds, from before: {', '.join(further)}", file=sys.stderr)
    done = f"\nwrote {args.out}; learnnorm report {shlex.quote(args.out)} makes tables and figures of it"
    print(done, file=sys.stderr if args.json == "-" else sys.stdout)
    return 0


def _print_tables(args: argparse.Namespace, run: Run, tables: list[Table]) -> None:
    """Print the tables of a run, without columns that have no number, and append them to a list."""
    limit, trained_on = run.about["max_residual"], run.about["trained_on"]
    show = print if args.json != "-" else lambda *_, **__: None
    errors = [(cell.store, found["truth"]) for cell in run.cells for found in cell.predictions.values()]
    with_truth = {store for store, truth in errors if not bool(truth.isnan().all())}
    for store, about in run.about["stores"].items():
        show(f"\n{store}: {about}{'' if store in with_truth else '; without ground truth'}")
        if known := [name for name in run.about["methods"] if was_trained_on(store, trained_on[name])]:
            show(f"trained on pairs of this store: {', '.join(known)}")
        for cell in run.cells:
            if cell.store != store or not cell.predictions:
                continue
            kind = f"matches with ratio below {RATIO:g}" if cell.protocol == "filtered" else "unfiltered matches"
            text = f"{kind}: {len(cell.pair)} of {cell.drawn} samples, un-normalised residual below {limit:g} px"
            own = torch.stack([errors["own"] for errors in cell.predictions.values()])
            if infinite := int(own.isinf().any(0).sum()):
                text += f"; {infinite} with a point on an epipole, not in the means"
            table = Table(cell.title, text, HEADER, method_rows(cell.predictions)).known_parts()
            if table is not None:
                tables.append(table)
                show(f"\n{text}\n\n{format_table(table.header, table.rows)}", flush=True)
    show(f"\n{LEGEND}")
    if with_truth:
        show(TRUTH)

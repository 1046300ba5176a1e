"""The command ``learnnorm robust``: robust estimators on stores."""

import argparse
import shlex
import sys
from pathlib import Path

from kornia_learnnorm.evaluation.robust.robust_estimators import DEFAULT_ESTIMATORS
from kornia_learnnorm.evaluation.robust.robust_run import DEFAULT_OPTIONS, record_robust
from kornia_learnnorm.evaluation.tables import names_of

EXAMPLES = """\
learnnorm robust store.h5 --out run && learnnorm report run
learnnorm robust store.h5 --out run --estimators RANSAC poselib"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm robust`` to a parser."""
    text = "stores of correspondences (.h5); FILE.h5@3:10 for some pairs"
    parser.add_argument("stores", metavar="STORE", nargs="+", help=text)
    parser.add_argument("--out", metavar="RUN", type=Path, required=True, help="folder to write to")
    text = "robust estimators; learned:WEIGHTS, guided:WEIGHTS and RANSAC:METHOD for your own; RANSAC-calibrated,"
    text += " poselib-calibrated and opencv-usac-magsac-calibrated use the cameras of the store"
    text += f" (default: {' '.join(DEFAULT_ESTIMATORS)})"
    parser.add_argument("--estimators", metavar="NAME", nargs="+", default=[*DEFAULT_ESTIMATORS], help=text)
    counts = {
        "pairs": "pairs of each store, evenly spaced; 0: all",
        "seeds": "runs on each pair",
        "slow_seeds": "runs of the estimators that can take a second: all except opencv-* and learned:*",
        "seed": "the first seed",
    }
    for name, text in counts.items():
        option, default = f"--{name.replace('_', '-')}", DEFAULT_OPTIONS[name]
        parser.add_argument(option, metavar="N", type=int, default=default, help=f"{text} (default: %(default)s)")
    parser.add_argument("--redo", metavar="NAME", nargs="+", default=[], help="estimators to run again, after a change")


def run(args: argparse.Namespace) -> int:
    """Record a run of robust estimators."""
    stores = {name: path for path, name in names_of(args.stores).items()}
    options = {name: getattr(args, name) for name in DEFAULT_OPTIONS}
    if missing := record_robust(args.out, stores, args.estimators, options, args.redo, args.command_line):
        print(f"left out, since not installed: {', '.join(missing)}", file=sys.stderr)
    print(f"wrote {args.out}; learnnorm report {shlex.quote(str(args.out))} makes its tables and pictures")
    return 0

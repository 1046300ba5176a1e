"""The command ``learnnorm report``: tables and pictures of a run. No model is run."""

import argparse
import sys
from pathlib import Path

from kornia_learnnorm.cli.evaluate import add_json_argument, json_tables
from kornia_learnnorm.evaluation.report.pages import print_tables, write_report

EXAMPLES = """\
learnnorm evaluate store.h5 --out run && learnnorm report run
learnnorm robust store.h5 --out run && learnnorm report run"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm report`` to a parser."""
    parser.add_argument("folder", metavar="RUN", type=Path, help="folder that learnnorm evaluate or robust --out wrote")
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Write ``report.md``, ``report.html`` and the pictures; print the summary and the tables that fit."""
    with json_tables(args, [str(args.folder / name) for name in ("run.json", "report.md", "report.html")]) as tables:
        summary, made, missing = write_report(args.folder)
        tables += made
        if args.json != "-":
            for text in summary:
                print(text.replace("**", "").replace("`", ""), end="\n\n")
            print_tables(tables, args.folder / "report.html")
    if missing:
        print(f"not there yet, so left out: {'; '.join(missing)}", file=sys.stderr)
    wrote = f"wrote {args.folder / 'report.md'} and {args.folder / 'report.html'}"
    print(wrote, file=sys.stderr if args.json == "-" else sys.stdout)
    return 0

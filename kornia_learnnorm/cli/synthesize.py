"""Write a synthetic store and a rendered image pair: ``learnnorm synthesize``."""

import argparse
from pathlib import Path

from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.render import render_pair, write_pair
from kornia_learnnorm.data.synthetic.scenes import SCENES, synthetic_store

EXAMPLES = """\
learnnorm synthesize folder
learnnorm synthesize folder --pairs 5 --scenes orbit --points 200"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm synthesize`` to a parser."""
    add = parser.add_argument
    add("folder", metavar="FOLDER", type=Path, help="folder to write to; created if missing")
    add("--pairs", type=int, default=20, help="pairs of each scene (default: %(default)s)")
    add("--scenes", metavar="KIND", nargs="+", default=[*SCENES], help=f"which (default: {', '.join(SCENES)})")
    add("--points", type=int, default=800, help="correspondences of a pair (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of scenes and images (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Write ``synthetic.h5`` and a rendered image pair."""
    if args.folder.exists() and not args.folder.is_dir():
        raise ValueError(f"{args.folder} is a file: expected a folder, or a new name")
    store = synthetic_store(args.pairs, args.points, args.seed, scenes=args.scenes)
    args.folder.mkdir(parents=True, exist_ok=True)
    write_store(args.folder / "synthetic.h5", store)
    write_pair(args.folder, render_pair(args.seed))
    print(f"wrote {args.folder / 'synthetic.h5'} ({len(store)} pairs), image1.png, image2.png and ground_truth.json")
    return 0

"""Match folders of images into a store of correspondences: ``learnnorm match``."""

import argparse
import sys
from itertools import groupby
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.datasets.frames import resize_frames
from kornia_learnnorm.data.datasets.pairing import choose_pairs
from kornia_learnnorm.data.datasets.reading import DATASETS, missing_ground_truth, read_dataset
from kornia_learnnorm.data.matching import features, matchers, workers
from kornia_learnnorm.data.matching.frame_matching import MatchOptions, collect_matches
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.store_writer import check_target

EXAMPLES = """\
learnnorm match folder PHOTOS --out photos.h5
learnnorm match kitti ROOT --sequences 00 03 --out kitti.h5 --jobs 2"""

MAX_LISTED = 10  # skipped pairs, or sequences, that are printed
ENDINGS = (".h5", ".hdf5")
READER_OPTIONS = ("sequences", "split", "camera", "max_difference", "model")  # arguments that a reader takes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm match`` to a parser."""
    parser.add_argument("reader", metavar="DATASET", choices=[*DATASETS], help=f"one of {', '.join(DATASETS)}")
    parser.add_argument("root", metavar="ROOT", type=Path, help="folder of the dataset")
    parser.add_argument("--out", metavar="STORE.h5", type=Path, required=True, help="the store to write")
    frames = parser.add_argument_group("frames")
    frames.add_argument("--sequences", metavar="NAME", nargs="+", help="kitti, tum: only these sequences")
    frames.add_argument("--split", metavar="NAME", help="kitti, cambridge: train, test; tum: train, val")
    frames.add_argument("--camera", help="kitti: image_0 to image_3 (default: image_0)")
    frames.add_argument("--model", metavar="FOLDER", type=Path, help="colmap: folder of cameras, images and points")
    frames.add_argument("--max-difference", metavar="S", type=float, help="tum: seconds to a pose (default: 0.02)")
    frames.add_argument("--resize", metavar=("WIDTH", "HEIGHT"), nargs=2, type=int, help="resize images and cameras")
    pairs = parser.add_argument_group("pairs").add_mutually_exclusive_group()
    # The default as text: argparse would not see "--gap 1" beside --exhaustive if the values were the same object.
    pairs.add_argument("--gap", type=int, default="1", help="frames apart (default: %(default)s)")
    pairs.add_argument("--pairs", metavar="FILE", type=Path, help="two names a line, as hloc lists them")
    pairs.add_argument("--min-points", metavar="N", type=int, help="colmap: pairs that share at least N points")
    pairs.add_argument("--exhaustive", dest="gap", action="store_const", const=None, help="all pairs of frames")
    match = parser.add_argument_group("matching")
    add_matching_arguments(match)
    _add_number(match, "max_matches", "kept per pair that fail, and that pass, the ratio test; 0: all")
    _add_number(match, "seed", "seed of the order of matches")


def add_feature_arguments(parser: argparse._ActionsContainer) -> None:
    """Add the arguments that say which features are matched and how."""
    for option, names in (("detector", features.DETECTORS), ("matcher", matchers.MATCHERS)):
        default = getattr(MatchOptions, option)
        text = " ".join(f"{name} (default)" if name == default else name for name in names)
        parser.add_argument(f"--{option}", metavar="NAME", choices=names, default=default, help=text)


def add_matching_arguments(match: argparse._ArgumentGroup) -> None:
    """Add the arguments that say which features are matched, how, and where it is computed."""
    add_feature_arguments(match)
    _add_number(match, "num_features", "features kept per image")
    where = match.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=int, default=-1, help="processes here; -1 for all cores (default: %(default)s)")
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of Dask's workers: tcp://host:8786")


def _add_number(match: argparse._ArgumentGroup, option: str, text: str) -> None:
    default, name = getattr(MatchOptions, option), f"--{option.replace('_', '-')}"
    match.add_argument(name, metavar="N", type=int, default=default, help=f"{text} (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Write a store; a run that was stopped continues where it was."""
    options = MatchOptions(args.detector, args.num_features, args.matcher, args.max_matches or None, args.seed)
    if args.out.suffix not in ENDINGS:
        raise ValueError(f"--out {args.out}: expected the name of a store, which ends in {' or '.join(ENDINGS)}")
    check_target(args.out)
    workers.check_jobs(args.jobs)
    given = {name: getattr(args, name) for name in READER_OPTIONS if getattr(args, name) is not None}
    frames = read_dataset(args.reader, args.root, **given)
    if args.resize:
        frames = resize_frames(frames, tuple(args.resize))
    pairs, pairing = choose_pairs(frames, args.gap, args.pairs, args.model, args.min_points)
    posed = sum(bool(np.isfinite(frame.pose).all()) for frame in frames)
    print(f"{len(frames)} frames, {posed} with a pose; {len(pairs)} pairs", file=sys.stderr)
    for missing in missing_ground_truth(args.reader, args.root, frames):
        print(missing, file=sys.stderr)
    sequences = sorted({frame.sequence for frame in frames})
    names = sequences if args.reader in ("kitti", "tum") else [args.root.resolve().name]  # of "." and ".." too
    resized = f", resized to {args.resize[0]}x{args.resize[1]}" if args.resize else ""
    about = {"dataset": f"{DATASETS[args.reader][0]} {', '.join(names)}{resized}", "pairs": pairing}
    wrote = "" if args.out.exists() else "wrote "
    print_skipped(collect_matches(pairs, args.out, options, about, args.jobs, args.dask))
    store = read_store(args.out)
    known = int(np.isfinite(store.F).all((1, 2)).sum())
    print(f"{wrote}{args.out}: {len(store)} pairs, {known} with ground truth, {store.offsets[-1]} matches")
    folders = [name.rpartition("/")[0] for name, _ in store.names]
    parts = [(name, [*places]) for name, places in groupby(range(len(store)), folders.__getitem__)]
    if 1 < len(parts) <= MAX_LISTED:
        print("sequences: " + ", ".join(f"{name or '.'} @{rows[0]}:{rows[-1] + 1}" for name, rows in parts))
    return 0


def print_skipped(skipped: dict[str, str]) -> None:
    """Print, to standard error, which pairs could not be matched and why."""
    for pair, reason in list(skipped.items())[:MAX_LISTED]:
        print(f"skipped {pair}: {reason}", file=sys.stderr)
    if len(skipped) > MAX_LISTED:
        print(f"skipped {len(skipped)} pairs in all; the store lists them", file=sys.stderr)

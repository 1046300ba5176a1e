"""From folders of images to a store of correspondences: ``learnnorm match``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.datasets.cambridge import read_cambridge
from kornia_learnnorm.data.datasets.colmap import covisible_pairs, read_colmap
from kornia_learnnorm.data.datasets.frames import Frame, FramePair, listed_pairs, pair_frames, resize_frames
from kornia_learnnorm.data.datasets.ground_truth import missing_ground_truth
from kornia_learnnorm.data.datasets.sequences import read_folder, read_kitti, read_tum, split_sequences
from kornia_learnnorm.data.matching.collect import MatchOptions, collect_matches
from kornia_learnnorm.data.matching.features import DETECTORS
from kornia_learnnorm.data.matching.matchers import MATCHERS
from kornia_learnnorm.data.matching.workers import check_jobs
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.writer import check_target

__all__ = ["add_arguments", "run"]

READERS = {
    "kitti": "KITTI odometry",
    "tum": "TUM RGB-D",
    "cambridge": "Cambridge Landmarks",
    "folder": "images of",
    "colmap": "COLMAP model",
}
LISTED = 10  # skipped pairs that are printed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm match`` to a parser."""
    options = MatchOptions()
    parser.add_argument("reader", metavar="READER", choices=READERS, help=f"what lies there: {', '.join(READERS)}")
    parser.add_argument("root", metavar="ROOT", type=Path, help="its folder")
    parser.add_argument("--out", metavar="STORE.h5", type=Path, required=True, help="the store to write")
    frames = parser.add_argument_group("frames")
    frames.add_argument("--sequences", metavar="NAME", nargs="+", help="kitti, tum: these only")
    frames.add_argument(
        "--split", metavar="NAME", help="kitti, cambridge: train or test; tum: train or val (Fan et al.)"
    )
    frames.add_argument("--camera", help="kitti: image_0 to image_3 (default: image_0)")
    frames.add_argument(
        "--model", metavar="FOLDER", type=Path, help="colmap: cameras, images and points; ROOT has images"
    )
    frames.add_argument(
        "--max-difference",
        metavar="S",
        type=float,
        help="tum: of image to pose, seconds (default: 0.02)",
    )
    frames.add_argument(
        "--resize", metavar=("WIDTH", "HEIGHT"), nargs=2, type=int, help="resize all images, cameras too"
    )
    pairs = parser.add_argument_group("pairs").add_mutually_exclusive_group()
    pairs.add_argument("--gap", type=int, default=1, help="frames apart (default: %(default)s)")
    pairs.add_argument("--pairs", metavar="FILE", type=Path, help="two names a line, as hloc lists them")
    pairs.add_argument("--min-points", metavar="N", type=int, help="colmap: pairs that see at least N points in common")
    match = parser.add_argument_group("matching")
    match.add_argument("--detector", choices=DETECTORS, default=options.detector, help="(default: %(default)s)")
    match.add_argument("--num-features", type=int, default=options.num_features, help="(default: %(default)s)")
    match.add_argument("--matcher", choices=MATCHERS, default=options.matcher, help="(default: %(default)s)")
    match.add_argument(
        "--max-matches",
        type=int,
        default=options.max_matches,
        help="of a pair, that pass the ratio test, and as many that do not; 0 keeps all (default: %(default)s)",
    )
    match.add_argument("--seed", type=int, default=options.seed, help="of the order of matches (default: %(default)s)")
    where = parser.add_argument_group("where").add_mutually_exclusive_group()
    where.add_argument("--jobs", type=int, default=-1, help="processes here; -1 for all cores (default: %(default)s)")
    where.add_argument("--dask", metavar="ADDRESS", help="Dask scheduler, as tcp://host:8786; its workers match")


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm match``: write a store; run again, it goes on where it was stopped.

    Raises:
        ValueError: if an argument does not fit the reader or is out of range, or nothing can be matched.
        OSError: if something is missing or cannot be written.
        ImportError: if a package for this is not installed.

    """
    options = MatchOptions(args.detector, args.num_features, args.matcher, args.max_matches or None, args.seed)
    _check(args)
    frames = _read(args)
    if args.resize:
        frames = resize_frames(frames, tuple(args.resize))
    pairs = _pair(args, frames)
    posed = sum(bool(np.isfinite(frame.pose).all()) for frame in frames)
    print(f"{len(frames)} frames, {posed} with a pose; {len(pairs)} pairs", file=sys.stderr)
    for missing in missing_ground_truth(args.reader, args.root, frames):
        print(missing, file=sys.stderr)
    if not pairs:
        raise ValueError(f"no pairs of frames to match ({_pairing(args)}) among {len(frames)} frames at {args.root}")
    names = sorted({frame.sequence for frame in frames}) if args.reader in ("kitti", "tum") else [args.root.name]
    about = {"dataset": f"{READERS[args.reader]} {', '.join(names)}{_resized(args)}", "pairs": _pairing(args)}
    wrote = "" if args.out.exists() else "wrote "
    skipped = collect_matches(pairs, args.out, options, about, args.jobs, args.dask)
    for pair, reason in list(skipped.items())[:LISTED]:
        print(f"skipped {pair}: {reason}", file=sys.stderr)
    if len(skipped) > LISTED:
        print(f"skipped {len(skipped)} pairs in all; the store lists them", file=sys.stderr)
    store = read_store(args.out)
    known = int(np.isfinite(store.F).all((1, 2)).sum())
    print(f"{wrote}{args.out}: {len(store)} pairs, {known} with ground truth, {store.offsets[-1]} matches")
    return 0


def _check(args: argparse.Namespace) -> None:
    for name, readers in {
        "sequences": ("kitti", "tum"),
        "split": ("kitti", "tum", "cambridge"),
        "camera": ("kitti",),
        "max_difference": ("tum",),
        "model": ("colmap",),
        "min_points": ("colmap",),
    }.items():
        if getattr(args, name) is not None and args.reader not in readers:
            raise ValueError(f"--{name.replace('_', '-')} is for {' and '.join(readers)}, got {args.reader}")
    if args.sequences and args.split:
        raise ValueError("--sequences and --split exclude each other")
    if args.reader == "colmap" and args.model is None:
        raise ValueError("colmap needs --model, the folder of cameras, images and points")
    check_target(args.out)
    check_jobs(args.jobs)
    if not args.root.is_dir():
        raise FileNotFoundError(f"no folder at {args.root}")


def _read(args: argparse.Namespace) -> list[Frame]:
    sequences = args.sequences
    if args.split and args.reader != "cambridge":
        sequences = split_sequences(args.reader, args.split, args.root)
    if args.reader == "kitti":
        return read_kitti(args.root, sequences, args.camera or "image_0")
    if args.reader == "tum":
        return read_tum(args.root, sequences, 0.02 if args.max_difference is None else args.max_difference)
    if args.reader == "cambridge":
        return read_cambridge(args.root, args.split)
    if args.reader == "colmap":
        return read_colmap(args.model, args.root)
    return read_folder(args.root)


def _pair(args: argparse.Namespace, frames: Sequence[Frame]) -> list[FramePair]:
    if args.pairs:
        return list(listed_pairs(frames, args.pairs))
    if args.min_points is not None:
        return list(covisible_pairs(args.model, frames, args.min_points))
    return list(pair_frames(frames, args.gap))


def _pairing(args: argparse.Namespace) -> str:
    if args.pairs:
        return f"listed in {args.pairs.name}"
    if args.min_points is not None:
        return f"sharing at least {args.min_points} points"
    return "consecutive frames" if args.gap == 1 else f"frames {args.gap} apart"


def _resized(args: argparse.Namespace) -> str:
    return f", resized to {args.resize[0]}x{args.resize[1]}" if args.resize else ""

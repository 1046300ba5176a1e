"""Write a COLMAP database from a folder of images or their matches: ``learnnorm export-colmap``."""

import argparse
import shlex
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.cli.match import add_matching_arguments, print_skipped
from kornia_learnnorm.data import cameras, hloc
from kornia_learnnorm.data.datasets.pairing import choose_pairs
from kornia_learnnorm.data.datasets.reading import read_dataset
from kornia_learnnorm.data.matching import frame_matching, workers
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.two_view.colmap_database import THRESHOLD, check_database, check_images, export_colmap
from kornia_learnnorm.two_view.input_checks import check_settings

EXAMPLES = """\
learnnorm export-colmap PHOTOS --out photos.db --single-camera
learnnorm export-colmap PHOTOS --out photos.db --matches photos.h5"""
MATCHES = ".h5"  # suffix of the store of matches beside the database
RECONSTRUCT = "import pycolmap; pycolmap.incremental_mapping({!r}, {!r}, 'sparse'{})"
KEEP_CAMERA = ", pycolmap.IncrementalPipelineOptions(ba_refine_focal_length=False)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm export-colmap`` to a parser."""
    parser.add_argument("root", metavar="ROOT", type=Path, help="folder of the images, with its subfolders")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="the database to write")
    pairs = parser.add_argument_group("pairs (default: all)").add_mutually_exclusive_group()
    pairs.add_argument("--overlap", metavar="N", type=int, help="only images up to N apart, by name")
    pairs.add_argument("--pairs", metavar="FILE", type=Path, help="two names a line, as hloc lists them")
    text = "use a store of learnnorm match, or hloc's features and matches, instead of matching"
    pairs.add_argument("--matches", metavar="STORE", type=Path, nargs="+", default=[], help=text)
    add = parser.add_argument_group("cameras").add_argument
    add("--K", metavar="CAMERA", help="camera of all images: fx,fy,cx,cy or a file (default: EXIF)")
    add("--single-camera", action="store_true", help="all images share one camera")
    add = parser.add_argument_group("estimation").add_argument
    add("--weights", metavar="NAME_OR_PATH", help="estimate with a learned layer instead of RANSAC")
    text = "threshold of RANSAC; inliers are within twice this (default: %(default)s)"
    add("--threshold", metavar="PX", type=float, default=THRESHOLD, help=text)
    add("--seed", metavar="N", type=int, default=0, help="seed of RANSAC (default: %(default)s)")
    add_matching_arguments(parser.add_argument_group("matching"))


def run(args: argparse.Namespace) -> int:
    """Match the images where no matches are given, into a store beside the database, and write the database."""
    check_database(args.out)
    workers.check_jobs(args.jobs)
    K = None if args.K is None else cameras.read_camera(args.K)
    layer = None if args.weights is None else LearnedEightPoint.from_pretrained(args.weights)
    check_settings(args.threshold, args.seed, layer)
    if args.out.suffix == MATCHES:
        raise ValueError(f"--out {args.out}: this is where the matches go, expected a name such as photos.db")
    estimation = {"layer": layer, "threshold": args.threshold, "seed": args.seed, "jobs": args.jobs}
    store, turned = _matches(args, K), len(args.matches) != 2
    counts = export_colmap(store, args.root, args.out, K, args.single_camera, turned=turned, **estimation)
    for doubt in counts.doubts:
        print(f"warning: {doubt.text.replace('K1', 'K')}", file=sys.stderr)
    verified = f"{counts.verified} of {counts.pairs} pairs verified"
    inliers = f"{counts.inliers} of {counts.matches} matches are their inliers"
    print(f"wrote {args.out}: {counts.images} images; {verified}, {inliers}")
    if counts.unverified:
        print(f"no verified pair: {', '.join(counts.unverified)}", file=sys.stderr)
    code = RECONSTRUCT.format(str(args.out), str(args.root), "" if K is None else KEEP_CAMERA)
    print(f"to reconstruct: python -c {shlex.quote(code)}", file=sys.stderr)
    return 0


def _matches(args: argparse.Namespace, K: NDArray[np.float64] | None) -> CorrespondenceStore:
    if len(args.matches) > 2:
        raise ValueError(f"--matches: a store, or hloc's features and matches expected, got {len(args.matches)} files")
    if args.matches:
        return read_store(*args.matches) if len(args.matches) == 1 else hloc.read_hloc(*args.matches)
    frames = read_dataset("folder", args.root)
    pairs, pairing = choose_pairs(frames, args.overlap, args.pairs, overlap=True)
    check_images(args.root, [frame.name for frame in frames], K, args.single_camera)
    print(f"{len(frames)} images; {len(pairs)} pairs ({pairing})", file=sys.stderr)
    store = args.out.with_suffix(MATCHES)
    options = frame_matching.MatchOptions(args.detector, args.num_features, args.matcher, max_matches=None)
    about = {"dataset": str(args.root), "pairs": pairing}
    print_skipped(frame_matching.collect_matches(pairs, store, options, about, args.jobs, args.dask))
    return read_store(store)

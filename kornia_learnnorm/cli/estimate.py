"""The command ``learnnorm estimate``: the fundamental matrix of two image files, or of many pairs."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from kornia_learnnorm.data.images import image_size, read_colour, read_mask
from kornia_learnnorm.data.matching.features import DETECTORS
from kornia_learnnorm.data.matching.matchers import MATCHERS
from kornia_learnnorm.data.matching.workers import check_jobs
from kornia_learnnorm.evaluation.many_pairs import PairOptions, estimate_pairs, read_pair_list
from kornia_learnnorm.evaluation.pair import estimate_pair
from kornia_learnnorm.evaluation.pair_estimate import NoReliableMatrixError
from kornia_learnnorm.files import atomic_write, write_text

__all__ = ["add_arguments", "run"]

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".pdf", ".svg")
UNRELIABLE = 3  # exit code where there is no matrix, or reasons to doubt it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm estimate`` to a parser."""
    options = PairOptions()
    parser.epilog = "Exit codes: 0 solved; 2 wrong use or an unreadable image; 3 no matrix, or one with warnings."
    parser.add_argument("images", metavar="IMG", type=Path, nargs="*", help="files of image 1 and image 2")
    parser.add_argument(
        "--out", metavar="PATH", type=Path, help="picture of matches and epipolar lines; with --pairs, a folder"
    )
    parser.add_argument("--json", metavar="FILE", help="write everything to this file; - for standard output")
    estimation = parser.add_argument_group("estimation")
    estimation.add_argument(
        "--estimator",
        choices=("ransac", "learned"),
        default="ransac",
        help="RANSAC, or the learned layer in one pass (default: %(default)s)",
    )
    estimation.add_argument("--weights", metavar="NAME_OR_PATH", help="weights of the learned layer (default: robust)")
    estimation.add_argument(
        "--threshold",
        type=float,
        default=options.threshold,
        help="symmetric epipolar distance of an inlier, and RANSAC's threshold, px (default: %(default)s)",
    )
    estimation.add_argument("--seed", type=int, default=options.seed, help="(default: %(default)s)")
    estimation.add_argument(
        "--K",
        metavar="CAMERA",
        nargs="+",
        default=[],
        help="one camera or two: fx,fy,cx,cy, a file of 4 or 9 numbers, or exif; adds E, R and t",
    )
    matching = parser.add_argument_group("matching")
    matching.add_argument("--detector", choices=DETECTORS, default=options.detector, help="(default: %(default)s)")
    matching.add_argument("--matcher", choices=MATCHERS, default=options.matcher, help="(default: %(default)s)")
    matching.add_argument("--ratio", type=float, default=options.ratio, help="ratio test (default: %(default)s)")
    matching.add_argument(
        "--max-size", type=int, default=options.max_size, help="match images reduced to it, px (default: %(default)s)"
    )
    matching.add_argument(
        "--mask",
        metavar="FILE",
        type=Path,
        nargs="+",
        default=[],
        help="one mask or two: features count where it is white",
    )
    many = parser.add_argument_group("many pairs")
    many.add_argument("--pairs", metavar="LIST", type=Path, help="two files a line; one JSON line a pair in --out")
    many.add_argument("--jobs", type=int, default=-1, help="processes; -1 for all cores (default: %(default)s)")
    many.add_argument("--dask", metavar="ADDRESS", help="Dask scheduler, as tcp://host:8786; its workers estimate")


def run(args: argparse.Namespace) -> int:
    """Print the fundamental matrix; write the picture and the JSON file if asked to, both or neither."""
    _check_options(args)
    weights = (args.weights or "robust") if args.estimator == "learned" else None
    names = ("ratio", "threshold", "seed", "max_size", "detector", "matcher")
    options = PairOptions(weights, K=tuple(args.K), **{name: getattr(args, name) for name in names})
    if args.pairs is not None:
        good, warned = estimate_pairs(read_pair_list(args.pairs), args.out, options, args.jobs, args.dask)
        print(f"wrote {args.out}: {good} pairs solved, {warned} with warnings")
        return UNRELIABLE if warned else 0
    image1, image2 = args.images
    try:
        return _run_pair(args, image1, image2, options)
    except NoReliableMatrixError as error:
        print(f"no reliable matrix ({error.code}): {error}", file=sys.stderr)
        return UNRELIABLE


def _run_pair(args: argparse.Namespace, image1: Path, image2: Path, options: PairOptions) -> int:
    to_stdout = args.json == "-"
    json_path = None if args.json is None or to_stdout else Path(args.json)
    with ExitStack() as stack:
        picture = None if args.out is None else stack.enter_context(atomic_write(args.out))
        report = None if json_path is None else stack.enter_context(atomic_write(json_path))
        if picture is not None:
            from kornia_learnnorm.evaluation.drawing import draw_pair, import_matplotlib

            import_matplotlib()
        masks: list[Any] = [
            read_mask(path, image_size(image)) for path, image in zip(_both(args.mask), args.images, strict=False)
        ]
        mask1, mask2 = masks or (None, None)
        estimate = estimate_pair(image1, image2, **options.arguments(image1, image2), mask1=mask1, mask2=mask2)
        if picture is not None:
            first, second = (read_colour(image, options.max_size) for image in args.images)
            draw_pair(first, second, estimate, picture)
        content = json.dumps(estimate.as_dict(), allow_nan=False) + "\n"
        if report is not None:
            write_text(report, content)
    print(content if to_stdout else estimate.summary(), end="" if to_stdout else "\n")
    for path in (args.out, json_path):
        if path is not None and not to_stdout:
            print(f"wrote    {path}")
    for warning in estimate.warnings if to_stdout else ():
        print(f"warning ({warning.code}): {warning.text}", file=sys.stderr)
    return UNRELIABLE if estimate.warnings else 0


def _both(values: list[Path]) -> list[Path]:
    """Return one value for each image."""
    return values * 2 if len(values) == 1 else values


def _check_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that do not go together and for files that must not be written."""
    if args.weights is not None and args.estimator != "learned":
        raise ValueError(f"--weights {args.weights}: only --estimator learned has weights")
    for name, values in (("K", args.K), ("mask", args.mask)):
        if len(values) > 2:
            got = f"got {len(values)}; give the images before it"
            raise ValueError(f"--{name}: one value for both images or one for each expected, {got}")
    if args.pairs is not None:
        if args.images or args.json is not None or args.mask:
            raise ValueError("--pairs: neither images, --json nor --mask go with it")
        if args.out is None:
            raise ValueError("--pairs: --out FOLDER is needed for the results")
        check_jobs(args.jobs)
        return
    if args.jobs != -1 or args.dask is not None:
        raise ValueError("--jobs and --dask go with --pairs")
    if len(args.images) != 2:
        raise ValueError(f"two image files expected, got {len(args.images)}; --pairs LIST for many")
    if args.out is not None and args.out.suffix.lower() not in PICTURE_SUFFIXES:
        raise ValueError(f"--out {args.out}: expected a name that ends in one of {' '.join(PICTURE_SUFFIXES)}")
    taken = [path.resolve() for path in (*args.images, *args.mask)]
    json_path = None if args.json in (None, "-") else Path(args.json)
    for option, path in (("--out", args.out), ("--json", json_path)):
        if path is not None and path.resolve() in taken:
            raise ValueError(f"{option} {path}: would overwrite another file of this command")
        taken += [] if path is None else [path.resolve()]

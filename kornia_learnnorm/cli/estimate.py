"""The command ``learnnorm estimate``: the fundamental matrix of two image files, as text, picture and JSON file."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from kornia_learnnorm.data.images import read_image
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.evaluation.pair import estimate_pair, write_json
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

__all__ = ["add_arguments", "run"]

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".pdf", ".svg")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm estimate`` to a parser."""
    parser.add_argument("image1", metavar="IMG1", type=Path, help="file of image 1")
    parser.add_argument("image2", metavar="IMG2", type=Path, help="file of image 2")
    parser.add_argument("--out", metavar="PICTURE", type=Path, help="draw matches and epipolar lines to this file")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write F, counts and errors to this file")
    parser.add_argument("--ratio", type=float, default=RATIO, help="ratio test of the matches (default: %(default)s)")
    parser.add_argument(
        "--threshold",
        type=float,
        default=INLIER_THRESHOLD,
        help="symmetric epipolar distance of an inlier, and RANSAC's threshold, px (default: %(default)s)",
    )
    parser.add_argument(
        "--estimator",
        choices=("ransac", "learned"),
        default="ransac",
        help="RANSAC, or the learned layer in one pass (default: %(default)s)",
    )
    parser.add_argument(
        "--weights", metavar="NAME_OR_PATH", help="weights of the learned layer (default: the package's)"
    )


def run(args: argparse.Namespace) -> int:
    """Print the fundamental matrix; write the picture and the JSON file if asked to, both or neither."""
    _check_options(args)
    with ExitStack() as stack:
        picture = None if args.out is None else stack.enter_context(atomic_write(args.out))
        report = None if args.json is None else stack.enter_context(atomic_write(args.json))
        if picture is not None:
            from kornia_learnnorm.evaluation.drawing import draw_pair, import_matplotlib

            import_matplotlib()
        layer = None
        if args.estimator == "learned":
            layer = LearnedEightPoint.from_pretrained(*([args.weights] if args.weights else []))
        estimate = estimate_pair(args.image1, args.image2, layer, args.ratio, args.threshold)
        if picture is not None:
            draw_pair(read_image(args.image1), read_image(args.image2), estimate, picture)
        if report is not None:
            write_json(report, estimate)
    print(estimate.summary())
    for path in (args.out, args.json):
        if path is not None:
            print(f"wrote    {path}")
    return 0


def _check_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that do not go together and for files that must not be written."""
    if args.weights is not None and args.estimator != "learned":
        raise ValueError(f"--weights {args.weights}: only --estimator learned has weights")
    if args.out is not None and args.out.suffix.lower() not in PICTURE_SUFFIXES:
        raise ValueError(f"--out {args.out}: expected a name that ends in one of {' '.join(PICTURE_SUFFIXES)}")
    taken = [args.image1.resolve(), args.image2.resolve()]
    for option, path in (("--out", args.out), ("--json", args.json)):
        if path is not None and path.resolve() in taken:
            raise ValueError(f"{option} {path}: would overwrite another file of this command")
        taken += [] if path is None else [path.resolve()]

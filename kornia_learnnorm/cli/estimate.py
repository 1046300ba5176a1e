"""The command ``learnnorm estimate``: the fundamental matrix or homography of two image files, or of many pairs."""

import argparse
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from kornia_learnnorm.cli.match import add_feature_arguments
from kornia_learnnorm.data.images import image_size, read_colour, read_mask
from kornia_learnnorm.data.matching.workers import check_jobs
from kornia_learnnorm.files import atomic_write, write_text
from kornia_learnnorm.two_view import many_pairs
from kornia_learnnorm.two_view.estimate_pair import estimate_pair
from kornia_learnnorm.two_view.input_checks import MODELS
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".pdf", ".svg")
EXAMPLES = """\
learnnorm estimate left.png right.png --K 700,700,320,240 --out pair.png
learnnorm estimate --pairs pairs.txt --out results --estimator learned
"""
MAX_FAILURES = 5  # failed pairs that are named
NO_MATRIX, DOUBTFUL = 3, 4  # exit codes where there is no matrix, or reasons to doubt it
EXIT_CODES = "exit codes: 0 solved, 2 wrong use or input, 3 no matrix, 4 with warnings"
HINT = "more accurate, but slower: --detector aliked --matcher lightglue, whose weights are downloaded once (50 MB)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm estimate`` to a parser."""
    options = many_pairs.PairOptions()
    parser.usage = "%(prog)s IMG1 IMG2 [options]\n       %(prog)s --pairs LIST --out FOLDER [options]"
    parser.description = f"{parser.description}\n{EXIT_CODES}"
    parser.add_argument("images", metavar="IMG", type=Path, nargs="*", help=argparse.SUPPRESS)  # in the usage
    parser.add_argument("--out", metavar="PATH", type=Path, help="picture of the matches; with --pairs, a folder")
    parser.add_argument("--json", metavar="FILE", help="write the result to this file; -: standard output")
    parser.add_argument("--matches", action="store_true", help="include the matches in the JSON")
    parser.add_argument("--strict", action="store_true", help="exit with 3 where there are warnings")
    add = parser.add_argument_group("estimation").add_argument
    names, default = ("ransac", "learned"), "(default: %(default)s)"
    add("--model", metavar="NAME", choices=MODELS, default=options.model, help=f"{', '.join(MODELS)} {default}")
    add("--estimator", metavar="NAME", choices=names, default=names[0], help=f"{', '.join(names)} {default}")
    add("--weights", metavar="NAME_OR_PATH", help="weights for learned (default: robust-synthetic)")
    distance = f"largest distance of inliers {default}"
    add("--threshold", metavar="PX", type=float, default=options.threshold, help=distance)
    add("--seed", metavar="N", type=int, default=options.seed, help=default)
    add("--K", metavar="CAMERA", nargs="+", default=[], help="1 or 2: fx,fy,cx,cy, a file or exif; gives R, t")
    group = parser.add_argument_group("matching")
    add_feature_arguments(group)
    add = group.add_argument
    add("--ratio", type=float, default=options.ratio, help=f"ratio test of nearest neighbours {default}")
    add("--max-size", metavar="PX", type=int, default=options.max_size, help=f"longer side of the images {default}")
    passes = f"passes of MatchRefiner, 2 for XFeat {default}"
    add("--refine", metavar="PASSES", type=int, default=options.refine, help=passes)
    add("--mask", metavar="FILE", type=Path, nargs="+", default=[], help="1 or 2 images: use features where white")
    many = parser.add_argument_group("many pairs")
    many.add_argument("--pairs", metavar="LIST", type=Path, help="list of two files a line, or a folder; needs --out")
    add = many.add_mutually_exclusive_group().add_argument
    # The default as text: argparse would not see "--gap 1" beside --exhaustive if the values were the same object.
    add("--gap", metavar="N", type=int, default="1", help=f"for a folder: pair images N apart {default}")
    add("--exhaustive", dest="gap", action="store_const", const=None, help="for a folder: all pairs")
    add = many.add_mutually_exclusive_group().add_argument
    add("--jobs", type=int, default=-1, help=f"processes; -1: all cores {default}")
    add("--dask", metavar="ADDRESS", help="scheduler of Dask's workers: tcp://host:8786")


def run(args: argparse.Namespace) -> int:
    """Print the matrix; write the picture and the JSON file if asked to, both or neither."""
    _check_options(args)
    doubtful = NO_MATRIX if args.strict else DOUBTFUL
    weights = (args.weights or "robust-synthetic") if args.estimator == "learned" else None
    names = ("ratio", "threshold", "seed", "max_size", "detector", "matcher", "model", "matches", "refine")
    options = many_pairs.PairOptions(weights, K=tuple(args.K), **{name: getattr(args, name) for name in names})
    if args.pairs is not None:
        listed = not args.pairs.is_dir()
        pairs = many_pairs.read_pair_list(args.pairs) if listed else many_pairs.pairs_of_folder(args.pairs, args.gap)
        found = many_pairs.estimate_pairs(pairs, args.out, options, args.jobs, args.dask)
        _print_pairs(found, args.out)
        _print_hint(args)
        if any(line["model"] is None for line in found):
            return NO_MATRIX
        return doubtful if any(line["warnings"] for line in found) else 0
    (image1, image2), json_path = args.images, _json_path(args)
    try:
        estimate = _estimate(args, options)
    except NoReliableMatrixError as error:
        failure = _to_json(many_pairs.describe_failure(error.code, str(error), image1, image2, options))
        if json_path is not None:
            write_text(json_path, failure)
            print(f"wrote    {json_path}")
        elif args.json == "-":
            print(failure, end="")
        print(f"no reliable matrix ({error.code}): {error}", file=sys.stderr)
        return NO_MATRIX
    if args.json == "-":
        print(_to_json(estimate.as_dict(args.matches)), end="")
        for warning in estimate.warnings:
            print(f"warning ({warning.code}): {warning.text}", file=sys.stderr)
    else:
        print("\n".join([estimate.summary(), *(f"wrote    {path}" for path in (args.out, json_path) if path)]))
        _print_hint(args)
    return doubtful if estimate.warnings else 0


def _estimate(args: argparse.Namespace, options: many_pairs.PairOptions) -> PairEstimate:
    """Write the picture and the JSON file of one pair, both or neither, and return its estimate."""
    with ExitStack() as stack:
        picture, report = (path and stack.enter_context(atomic_write(path)) for path in (args.out, _json_path(args)))
        if picture:
            from kornia_learnnorm.two_view.drawing import draw_pair, import_matplotlib

            import_matplotlib()
        masks = args.mask * 2 if len(args.mask) == 1 else args.mask
        given: list[Any] = [read_mask(mask, image_size(image)) for mask, image in zip(masks, args.images, strict=False)]
        (image1, image2), (mask1, mask2) = args.images, given or (None, None)
        estimate = estimate_pair(image1, image2, **options.arguments(image1, image2), mask1=mask1, mask2=mask2)
        if picture:
            first, second = (read_colour(image, options.max_size) for image in args.images)
            draw_pair(first, second, estimate, picture)
        if report:
            write_text(report, _to_json(estimate.as_dict(args.matches)))
    return estimate


def _print_hint(args: argparse.Namespace) -> None:
    if args.detector == many_pairs.PairOptions.detector:
        print(f"matched SIFT features; {HINT}", file=sys.stderr)


def _print_pairs(found: list[dict[str, Any]], folder: Path) -> None:
    """Print how many pairs have a matrix; to standard error, the first pairs without one and why."""
    failed = [line for line in found if line["model"] is None]
    warned = sum(bool(line["warnings"]) for line in found) - len(failed)
    text = f"wrote {folder}: {len(found) - len(failed)} of {len(found)} pairs solved"
    text += f", {len(failed)} failed" if failed else ""
    print(text + (f"; {warned} solved with warnings" if warned else ""))
    for line in failed[:MAX_FAILURES]:
        reasons = "; ".join(f"{warning['text']} ({warning['code']})" for warning in line["warnings"])
        names = [line[name]["file"] for name in ("image1", "image2")]
        named = "" if reasons.startswith(" and ".join(names)) else f"{' '.join(names)}: "
        print(f"failed: {named}{reasons}", file=sys.stderr)
    if len(failed) > MAX_FAILURES:
        print(f"and {len(failed) - MAX_FAILURES} more: lines of pairs.jsonl whose model is null", file=sys.stderr)


def _json_path(args: argparse.Namespace) -> Path | None:
    return None if args.json in (None, "-") else Path(args.json)


def _to_json(content: dict[str, Any]) -> str:
    return json.dumps(content, allow_nan=False) + "\n"


def _check_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that do not go together and for files that must not be written."""
    if args.weights is not None and args.estimator != "learned":
        raise ValueError(f"--weights {args.weights}: only --estimator learned has weights")
    if args.estimator == "learned" and args.model == "homography":
        raise ValueError("--estimator learned: only for fundamental matrices, leave it out with --model homography")
    for name, values in (("K", args.K), ("mask", args.mask)):
        if len(values) > 2:
            got = f"got {len(values)}; give the images before it"
            raise ValueError(f"--{name}: one value for both images or one for each expected, {got}")
    if args.matches and args.json is None and args.pairs is None:
        raise ValueError("--matches: only for --json or --pairs, which were not given")
    if args.pairs is not None:
        _check_many(args)
        return
    defaults = {"jobs": -1, "dask": None, "gap or --exhaustive": 1}
    if many := [f"--{name}" for name, default in defaults.items() if getattr(args, name.split()[0]) != default]:
        raise ValueError(f"{' and '.join(many)}: only for --pairs LIST, which was not given")
    if len(args.images) != 2:
        raise ValueError(f"two image files expected, got {len(args.images)}; --pairs LIST for many")
    if args.out is not None and args.out.suffix.lower() not in PICTURE_SUFFIXES:
        raise ValueError(f"--out {args.out}: expected a name that ends in one of {' '.join(PICTURE_SUFFIXES)}")
    inputs = *args.images, *args.mask, *args.K, *([] if args.weights is None else [args.weights])
    taken = [Path(path).resolve() for path in inputs]
    for option, path in (("--out", args.out), ("--json", _json_path(args))):
        if path is not None and path.resolve() in taken:
            raise ValueError(f"{option} {path}: would overwrite another file of this command")
        taken += [] if path is None else [path.resolve()]


def _check_many(args: argparse.Namespace) -> None:
    given = {"image files": args.images, "--json": args.json, "--mask": args.mask}
    if wrong := [name for name, value in given.items() if value]:
        raise ValueError(f"--pairs {args.pairs}: cannot be combined with {' and '.join(wrong)}")
    if args.gap != 1 and not args.pairs.is_dir():
        raise ValueError(f"--pairs {args.pairs}: --gap and --exhaustive are for a folder of images")
    if args.out is None:
        raise ValueError("--pairs: --out FOLDER is needed for the results")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out {args.out}: a folder expected with --pairs, got a file")
    check_jobs(args.jobs)

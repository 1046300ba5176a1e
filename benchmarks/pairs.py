"""Measure how often the estimate of an image pair is right, wrong without a warning, or refused, on difficult pairs.

The pairs are rendered, so their truth is exact: kinds of `render_kind`, and `outliers`, which are correspondences of
synthetic scenes with 0.5 px noise among 10 to 90 % random matches. A pair is determined if at least 5 % of its exact
correspondences lie more than 1 px from the best homography. A fundamental matrix is right if its rotation and its
direction of translation, taken from F, the true cameras and its inliers, are both within 10 degrees of the truth; where
the camera only turns, it is wrong. A homography is right if it moves 95 % of the exact correspondences to within 2 px
and, with --cameras, its pose is within 10 degrees. Errors in pixels are medians over the exact correspondences, of the
symmetric epipolar distance or the distance from where H moves a point; the predicted ones are compared with them over
the answers without a warning. `F` counts the pairs of which F is chosen, `GRIC: F` those of which GRIC alone would not
choose the homography (P. Torr, A. Fitzgibbon, A. Zisserman, The problem of degeneracy in structure and motion recovery
from uncalibrated image sequences, IJCV 1999). Prints progress to stderr.

    python benchmarks/pairs.py [--pairs 200] [--kinds KIND ...] [--seed 0] [--estimator ransac|learned]
        [--weights NAME] [--model auto|fundamental|homography] [--cameras] [--outliers SHARE ...] [--size 640 480]
        [--cache FOLDER] [--json FILE] [--csv FILE]

With --outliers, random matches are mixed into those of the images, with scores like theirs: the first pair of a kind
gets the first of these shares of outliers, the second the second, and so on, in turn.
"""

import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from kornia.metrics import angle_error_mat
from rendered import KINDS, render_kind
from shared import make_parser, write_csv, write_json
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld, orbit
from kornia_learnnorm.data.synthetic.render import RenderedPair
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view.estimate_matches import estimate_matches
from kornia_learnnorm.two_view.estimate_pair import estimate_pair, match_two_images
from kornia_learnnorm.two_view.input_checks import MODELS
from kornia_learnnorm.two_view.parallax import parallax
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

OUTLIERS = "outliers"
MATCHES = 1000  # of a pair of the kind `outliers`
NOISE = 0.5  # pixels, standard deviation per coordinate of these matches
MAX_POSE_ERROR = 10.0  # degrees; an answer with a larger one is wrong
PARALLAX = 1.0  # pixels from the best homography
MIN_PARALLAX = 0.05  # share of the exact correspondences beyond it in a pair that determines F
MAX_TRANSFER = 2.0  # pixels, of the other correspondences under a homography that is right


class Case(NamedTuple):
    """What the estimator reads of a pair, images or matches with the image size, and the truth."""

    kind: str
    seed: int
    read: tuple[Any, Any]
    size: tuple[int, int] | None  # of the images that the matches come from
    points1: Tensor  # exact correspondences, (M, 2), float64
    points2: Tensor
    K: Tensor
    R: Tensor
    t: Tensor


def rendered(kind: str, seed: int, size: tuple[int, int], cache: Path | None) -> Case:
    """Return a rendered pair, from the cache if it is there."""
    path = cache and cache / f"{kind}_{seed}_{size[0]}x{size[1]}.npz"
    if path and path.exists():
        with np.load(path) as arrays:
            pair = RenderedPair(**arrays)
    else:
        pair = render_kind(kind, seed, *size)
        if path:
            with atomic_write(path) as beside, beside.open("wb") as file:
                np.savez_compressed(file, **pair._asdict())
    truth = (torch.from_numpy(value) for value in (pair.points1, pair.points2, pair.K, pair.R, pair.t))
    return Case(kind, seed, (pair.image1, pair.image2), None, *truth)


def contaminated(seed: int) -> Case:
    """Return noisy correspondences of a scene among random matches: 10 % for seed 0, 20 % for seed 1, up to 90 %."""
    generator = torch.Generator().manual_seed(seed)
    scene = (handheld, orbit)[seed % 2](1, 2 * MATCHES, generator, noise=0.0)
    shown = scene.inliers[0]
    exact, size = torch.cat([scene.points1[0], scene.points2[0]], -1)[shown], scene.image_size[0]
    true = exact[torch.randperm(len(exact), generator=generator)[: round(MATCHES * (0.9 - 0.1 * (seed % 9)))]]
    true = true + NOISE * torch.randn(true.shape, generator=generator, dtype=torch.float64)
    false = torch.rand((MATCHES - len(true), 4), generator=generator, dtype=torch.float64) * (size - 1).repeat(2)
    matches = torch.cat([true, false])[torch.randperm(MATCHES, generator=generator)]
    width, height = size.int().tolist()
    truth = (exact[:, :2], exact[:, 2:], scene.K1[0], scene.R[0], scene.t[0])
    return Case(OUTLIERS, seed, (matches[:, :2], matches[:, 2:]), (width, height), *truth)


def mixed(case: Case, share: float) -> Case:
    """Return the matches of a pair of images with a share of random ones among them, whose scores are like theirs."""
    pair, generator = match_two_images(*case.read), torch.Generator().manual_seed(case.seed)
    true = torch.cat([pair.points1, pair.points2, pair.scores[:, None]], 1)[pair.mutual]
    number = round(len(true) * share / (1 - share))
    places = torch.rand((number, 4), generator=generator).double() * torch.tensor([*pair.size1, *pair.size2])
    scores = true[torch.randint(len(true), (number, 1), generator=generator)[:, 0], 4:]
    points1, points2, scores = torch.cat([true, torch.cat([places, scores], 1)]).split([2, 2, 1], 1)
    return case._replace(read=(points1, points2, scores[:, 0]), size=pair.size1)


def is_determined(points1: Tensor, points2: Tensor) -> bool:
    """Return whether exact correspondences determine F: enough of them lie off the best homography."""
    _, mask = cv2.findHomography(points1.numpy(), points2.numpy(), cv2.RANSAC, PARALLAX)
    return bool(mask is None or 1 - mask.mean() >= MIN_PARALLAX)


def error_of_pose(case: Case, found: PairEstimate) -> float:
    """Return the larger error of rotation and translation, degrees; infinite where one is not defined.

    Of a homography, NaN without cameras, and infinite where it takes a plane for a rotation or the other way round.
    """
    if found.model == "fundamental":
        K = case.K[None]
        points1, points2, F_mat = (value.double()[None] for value in (found.points1, found.points2, found.F_mat))
        R, t = relative_pose(F_mat, K, K, points1, points2, found.inliers[None])
        return pose_error(R[0], t[0], case.R, case.t).nan_to_num(nan=math.inf).item()
    if found.R is None:
        return math.nan
    if found.t is None:
        return math.inf if case.t.any() else angle_error_mat(found.R, case.R).item()
    return pose_error(found.R, found.t, case.R, case.t).nan_to_num(nan=math.inf).item()


def score(case: Case, solve: Callable[[Case], PairEstimate]) -> dict[str, Any]:
    """Return what came of a pair: refused or not, the codes of its warnings, its errors and its time.

    An exception that is no refusal is a fault of the estimator; it is recorded, and the other pairs go on.
    """
    record: dict[str, Any] = {"kind": case.kind, "seed": case.seed, "refused": None, "crashed": None, "warnings": []}
    record |= {"model": None, "gric": None}
    record["determined"] = is_determined(case.points1, case.points2)
    start, found = time.perf_counter(), None
    try:
        found = solve(case)
    except NoReliableMatrixError as error:
        record["refused"] = str(error.code)
    except Exception as error:
        record["crashed"] = repr(error)
        print(f"{case.kind} {case.seed}: {error!r}", file=sys.stderr)
    record["seconds"] = time.perf_counter() - start
    if found is None:
        return record
    record["warnings"] = [str(warning.code) for warning in found.warnings]
    record["matches"], record["inliers"] = len(found.points1), int(found.inliers.sum())
    record["model"], record["gric"] = found.model, found.choice.by_gric
    distance = parallax if found.model == "homography" else kln.symmetric_epipolar_distance
    errors = distance(case.points1, case.points2, found.matrix.double())  # of the exact correspondences
    record["pose_error"], record["true_error"] = error_of_pose(case, found), errors.median().item()
    record["predicted_error"] = float(found.predicted_error)
    record["right"] = not record["pose_error"] > MAX_POSE_ERROR
    if found.model == "homography":
        record["right"] &= bool((errors > MAX_TRANSFER).double().mean() < MIN_PARALLAX)
    return record


def outcome(record: dict[str, Any]) -> str:
    """Return `refused`, `crashed`, `right`, `wrong`, `right, flagged` or `wrong, flagged`."""
    for name in ("refused", "crashed"):
        if record[name] is not None:
            return name
    name = "right" if record["right"] else "wrong"
    return f"{name}, flagged" if record["warnings"] else name


def described(record: dict[str, Any]) -> str:
    """Return the outcome with the codes of the warnings or of the refusal."""
    codes = ", ".join(record["warnings"]) or record["refused"]
    return outcome(record) + (f" ({codes})" if codes else "")


COUNTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "pairs": lambda record: outcome(record) != "",
    "determined": lambda record: record["determined"],
    "F": lambda record: record["model"] == "fundamental",
    "GRIC: F": lambda record: record["model"] is not None and record["gric"] != "homography",
    "right": lambda record: outcome(record).startswith("right"),
    "wrong": lambda record: outcome(record).startswith("wrong"),
    "refused": lambda record: outcome(record) == "refused",
    "crashed": lambda record: outcome(record) == "crashed",
    "warned": lambda record: bool(record["warnings"]),
    "silently wrong": lambda record: outcome(record) == "wrong",
    "right, flagged": lambda record: outcome(record) == "right, flagged",
    "determined: refused": lambda record: record["determined"] and outcome(record) == "refused",
}


def by_kind(records: Iterable[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the records of each kind, and of all of them."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault(record["kind"], []).append(record)
    return {**groups, "all": [record for group in groups.values() for record in group]}


def count_rows(records: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return how many pairs of each kind came to what, a row each."""
    return [
        [kind, *(str(sum(map(counts, group))) for counts in COUNTS.values())]
        for kind, group in by_kind(records).items()
    ]


def calibration_table(records: Sequence[dict[str, Any]]) -> str:
    """Return true and predicted errors of the answers without a warning: medians and quantiles of the ratio."""
    rows = []
    for kind, group in by_kind(records).items():
        pairs = [
            (record["predicted_error"], record["true_error"])
            for record in group
            if outcome(record) in ("right", "wrong") and math.isfinite(record["predicted_error"])
        ]
        if not pairs:
            rows.append([kind, "0", *["-"] * 5])
            continue
        predicted, true = np.array(pairs).T
        quantiles = np.quantile(predicted / true, [0.1, 0.5, 0.9])
        numbers = [np.median(true), np.median(predicted), *quantiles]
        rows.append([kind, str(len(pairs)), *(f"{number:.3g}" for number in numbers)])
    ratios = [f"predicted / true: {share} %" for share in (10, 50, 90)]
    return format_table(["kind", "answers", "true: median px", "predicted: median px", *ratios], rows)


def failures(records: Iterable[dict[str, Any]]) -> list[str]:
    """Return a line for each answer that is wrong without a warning."""
    return [
        f"{r['kind']} {r['seed']}: {r['model']}, pose error {r['pose_error']:.1f} degrees, "
        f"true error {r['true_error']:.2f} px, predicted {r['predicted_error']:.2f} px, "
        f"{r['inliers']} of {r['matches']} matches are inliers"
        for r in records
        if outcome(r) == "wrong"
    ]


def main(args: Sequence[str] | None = None) -> None:
    """Make the pairs, estimate them, print the tables and write the numbers."""
    files = {"json": "write a record of every pair to this file", "csv": "write the table of counts to this file"}
    parser = make_parser(__doc__, **files)
    parser.add_argument("--pairs", type=int, default=200, help="pairs, shared out evenly among the kinds")
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS, OUTLIERS], default=[*KINDS, OUTLIERS])
    parser.add_argument("--seed", type=int, default=0, help="first seed of each kind")
    parser.add_argument("--estimator", choices=["ransac", "learned"], default="ransac")
    parser.add_argument("--weights", default="robust-synthetic", help="name or file of the learned estimator's weights")
    parser.add_argument("--model", choices=MODELS, default="auto")
    parser.add_argument("--outliers", type=float, nargs="+", help="shares of random matches, in turn")
    parser.add_argument("--cameras", action="store_true", help="give the true cameras to the estimator")
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480], help="width and height of the images, pixels")
    parser.add_argument("--cache", type=Path, help="folder that keeps the rendered pairs; empty it for a new renderer")
    options = parser.parse_args(args)
    layer = kln.LearnedEightPoint.from_pretrained(options.weights) if options.estimator == "learned" else None
    if options.cache:
        options.cache.mkdir(parents=True, exist_ok=True)

    def solve(case: Case) -> PairEstimate:
        given: dict[str, Any] = {"layer": layer, "model": options.model}
        given |= {"K1": case.K, "K2": case.K} if options.cameras else {}
        if case.size is None:
            return estimate_pair(*case.read, **given)
        return estimate_matches(*case.read, size1=case.size, size2=case.size, **given)

    records = []
    for index in range(options.pairs):
        kind, seed = options.kinds[index % len(options.kinds)], options.seed + index // len(options.kinds)
        case = contaminated(seed) if kind == OUTLIERS else rendered(kind, seed, tuple(options.size), options.cache)
        if options.outliers and case.size is None:
            case = mixed(case, options.outliers[(seed - options.seed) % len(options.outliers)])
        records.append(score(case, solve))
        print(f"{index + 1}/{options.pairs} {kind} {seed}: {described(records[-1])}", file=sys.stderr, flush=True)
    header, counts = ["kind", *COUNTS], count_rows(records)
    table = format_table(header, counts)
    print(f"\n{len(records)} pairs, {options.estimator}\n\n{table}\n\n{calibration_table(records)}")
    if wrong := failures(records):
        print("\nWrong without a warning:\n\n" + "\n".join(f"- {line}" for line in wrong))
    print(f"{np.mean([record['seconds'] for record in records]):.2f} s per estimate", file=sys.stderr)
    write_csv(options.csv, [header, *counts])
    write_json(options.json, records)


if __name__ == "__main__":
    main()

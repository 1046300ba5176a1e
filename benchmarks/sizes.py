"""Measure how the number of matches decides which estimator of F is the most accurate, and what it costs.

A set is N random matches of one image pair, filtered by the ratio test or not. Its error is the median symmetric
epipolar distance of 64 ground-truth inliers of the pair, most of which are not in the set. The tables have the medians
over the sets, in pixels, and the time per set of batches of 32 sets, in milliseconds; estimators of other packages and
RANSAC take one set at a time. Prints progress to stderr; writes the numbers where asked to.
The inliers of a pair without ground truth are those of OpenCV's MAGSAC on all its matches that pass the ratio test.

    python benchmarks/sizes.py STORE.h5 [STORE.h5 ...] [--sizes 8 16 32 64 128 512] [--sets 128] [--seed 0]
        [--methods NAME ...] [--json FILE]

A method learned:WEIGHTS is a learned estimator by the name or file of its weights. With +bfloat16 after it, its
networks compute in bfloat16. With +scores last, it also reads the score of each match, as RANSAC+scores does.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from shared import make_parser, write_json
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.store import CorrespondenceStore, passes_ratio_test, read_store
from kornia_learnnorm.evaluation.robust.peers import find_peer
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.files import short_name
from kornia_learnnorm.layer_export import load_layer
from kornia_learnnorm.protocol import INLIER_THRESHOLD, PROTOCOLS, RATIO

BATCH = 32  # sets solved at once, as in training
NUM_TRUE = 64  # ground-truth inliers that measure a set
MIN_TRUE = 32  # ground-truth inliers of a pair that is used
LEARNED, HALF, SCORES = "learned:", "+bfloat16", "+scores"
FAILED = 999.0  # pixels; the error of a set without a matrix

Solver = Callable[[Tensor, Tensor, Tensor], Tensor]  # points1, points2 (S, N, 2) and scores (S, N) to F (S, 3, 3)


def batched(solve: Solver, points1: Tensor, points2: Tensor, scores: Tensor) -> Tensor:
    """Return the matrices of sets (S, N, 2), solved in batches."""
    parts = zip(points1.split(BATCH), points2.split(BATCH), scores.split(BATCH), strict=True)
    with torch.no_grad():
        return torch.cat([solve(*part) for part in parts])


def one_by_one(solve: Callable[..., Tensor | None], points1: Tensor, points2: Tensor, scores: Tensor) -> Tensor:
    """Return the matrices of sets (S, N, 2), solved one at a time; zero for a failure."""
    found = []
    for pair in zip(points1, points2, scores, strict=True):
        F_mat = solve(*pair)
        found.append(torch.zeros(3, 3).double() if F_mat is None else F_mat)
    return torch.stack(found)


def hartley_lm(points1: Tensor, points2: Tensor, _: Tensor) -> Tensor:
    """Return Hartley's matrices after robust refinement at 2 px."""
    F_mat = kln.find_fundamental(points1, points2)
    return kln.refine_fundamental(points1, points2, F_mat, loss=kln.GemanMcClure(2.0)).F_mat


def peer_matrix(name: str, points1: Tensor, points2: Tensor) -> Tensor | None:
    """Return the matrix of another package; the images count as large as their points need."""
    sizes = np.array([p.amax(0).ceil().int().tolist() for p in (points1, points2)], np.int32)
    try:
        F_mat = find_peer(name)(points1.numpy(), points2.numpy(), sizes, 0, INLIER_THRESHOLD)
    except cv2.error:  # too few matches are left to sample from
        F_mat = None
    return None if F_mat is None or np.shape(F_mat) != (3, 3) else torch.tensor(np.array(F_mat, float))


LAYERS: dict[str, Callable[[], kln.EightPoint]] = {
    "Hartley": kln.EightPoint,
    "whitening": lambda: kln.EightPoint(kln.Whitening()),
    "reweighted": lambda: kln.EightPoint(kln.ReweightedWhitening()),
    **{name: partial(load_layer, name) for name in ("paper", "crossview", "crossview-synthetic", "crossview-sets")},
    "Hartley+optimal": lambda: kln.EightPoint(rank2="optimal"),
}
PEERS = ("opencv-usac-magsac", "poselib", "kornia")
ROBUST = (*PEERS, "RANSAC", "RANSAC" + SCORES)  # need more than eight matches
METHODS = (*LAYERS, "Hartley+LM", *ROBUST)
SHIPPED = ["learned:robust", "learned:robust-synthetic"]


def find_method(name: str) -> Solver:
    """Return a method by its name, of ``METHODS`` or learned:WEIGHTS."""
    if name in LAYERS:
        layer = LAYERS[name]()
        return partial(batched, lambda x1, x2, _: layer(x1, x2))
    if name == "Hartley+LM":
        return partial(batched, hartley_lm)
    if name in PEERS:
        return partial(one_by_one, lambda x1, x2, _: peer_matrix(name, x1, x2))
    without, with_scores = name.removesuffix(SCORES), name.endswith(SCORES)
    if without == "RANSAC":
        estimate = kln.RANSAC(seed=0)
        return partial(one_by_one, lambda x1, x2, scores: estimate(x1, x2, scores if with_scores else None)[0])
    learned = kln.LearnedEightPoint.from_pretrained(without.removeprefix(LEARNED).removesuffix(HALF))
    if without.endswith(HALF):
        learned.networks.bfloat16()
    return partial(batched, lambda x1, x2, scores: learned(x1, x2, scores=scores if with_scores else None))


def shown(name: str) -> str:
    """Return how tables call a method; files of weights go by their short names."""
    weights = name.removeprefix(LEARNED).removesuffix(SCORES).removesuffix(HALF)
    return name.replace(weights, short_name(weights)) if name.startswith(LEARNED) else name


def true_matrix(store: CorrespondenceStore, pair: int) -> Tensor | None:
    """Return the matrix whose inliers measure a pair: the ground truth, or MAGSAC's where there is none."""
    if np.isfinite(store.F[pair]).all():
        return torch.from_numpy(store.F[pair])
    points1, points2, _ = store.matches(pair, RATIO)
    return peer_matrix("opencv-usac-magsac", torch.from_numpy(points1).double(), torch.from_numpy(points2).double())


def draw_sets(store: CorrespondenceStore, protocol: str, size: int, number: int, seed: int) -> Tensor | None:
    """Return sets and the true inliers that measure them, (S, N + 64, 5); None where too few pairs have enough.

    The last column is the score of a match.
    """
    generator, pairs = np.random.default_rng(seed), []
    for i in range(len(store)):
        rows = store.rows(i)
        points = np.hstack([store.points1[rows], store.points2[rows]]).astype(float)
        F_mat = true_matrix(store, i)
        if F_mat is None:
            continue
        distance = kln.symmetric_epipolar_distance(*torch.from_numpy(points).split(2, -1), F_mat).numpy()
        points = np.hstack([points, store.score[rows, None].astype(float)])
        true = np.flatnonzero((distance < INLIER_THRESHOLD) & passes_ratio_test(store.ratio[rows], RATIO))
        passing = np.flatnonzero(passes_ratio_test(store.ratio[rows], PROTOCOLS[protocol]))
        if len(true) >= MIN_TRUE and len(passing) >= size:
            pairs.append((points, passing, true))
    if not pairs:
        return None
    sets = []
    for _ in range(number):
        points, passing, true = pairs[generator.integers(len(pairs))]
        rows = np.concatenate([generator.choice(passing, size, replace=False), generator.choice(true, NUM_TRUE)])
        sets.append(points[rows])
    return torch.from_numpy(np.stack(sets))


def measure(name: str, sets: Tensor, size: int) -> tuple[float, float]:
    """Return the median error of a method, pixels, and its time per set, milliseconds."""
    solve, (points, true) = find_method(name), sets.split([size, NUM_TRUE], 1)
    points1, points2, scores = points[..., :2], points[..., 2:4], points[..., 4]
    solve(points1[:2], points2[:2], scores[:2])
    start = time.perf_counter()
    F_mat = solve(points1, points2, scores)
    seconds = time.perf_counter() - start
    error = kln.symmetric_epipolar_distance(true[..., :2], true[..., 2:4], F_mat).median(-1).values
    failed = (F_mat == 0).flatten(1).all(1) | ~error.isfinite()
    return torch.where(failed, FAILED, error).median().item(), 1e3 * seconds / len(points)


def table(results: dict[str, dict[str, list[float]]], sizes: list[int], column: int, title: str, digits: int) -> str:
    """Return the errors (column 0) or times (column 1) of the methods by size."""
    rows = [
        [name, *(f"{found[str(size)][column]:.{digits}f}" if str(size) in found else "-" for size in sizes)]
        for name, found in results.items()
    ]
    return format_table([title, *(f"N = {size}" for size in sizes)], rows)


def main() -> None:
    """Measure, print the tables, write the numbers."""
    parser = make_parser(__doc__, json="write the numbers to this file")
    parser.add_argument("stores", nargs="+", help="stores of correspondences with ground truth")
    parser.add_argument("--sizes", type=int, nargs="+", default=[8, 16, 32, 64, 128, 512], help="matches in a set")
    parser.add_argument("--sets", type=int, default=128, help="sets of each size")
    parser.add_argument("--seed", type=int, default=0)
    methods = [*METHODS, *SHIPPED, *(name + SCORES for name in SHIPPED)]
    parser.add_argument("--methods", nargs="+", default=methods, help="of these: %(default)s")
    parser.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    args = parser.parse_args()
    if unknown := [name for name in args.methods if name not in METHODS and not name.startswith(LEARNED)]:
        parser.error(f"--methods {' '.join(unknown)}: expected some of {', '.join(METHODS)} or learned:WEIGHTS")
    if args.json and not Path(args.json).parent.is_dir():
        parser.error(f"cannot write {args.json}: the folder {Path(args.json).parent} does not exist")
    everything: dict[str, dict] = {}
    missing: dict[str, ImportError] = {}
    for path in args.stores:
        store = read_store(path)
        for protocol in args.protocols:
            results: dict[str, dict[str, list[float]]] = {shown(name): {} for name in args.methods}
            for size in args.sizes:
                sets = draw_sets(store, protocol, size, args.sets, args.seed)
                for name in args.methods:
                    if sets is None or (size == 8 and name in ROBUST):
                        continue
                    try:
                        results[shown(name)][str(size)] = list(measure(name, sets, size))
                    except ImportError as error:
                        missing[name] = error
                print(f"{Path(path).stem}, {protocol}: {size} matches", file=sys.stderr)
            results = {name: found for name, found in results.items() if found}
            everything[f"{Path(path).stem}, {protocol}"] = results
            print(f"\n{Path(path).stem}, {protocol} matches, {args.sets} sets\n")
            print(table(results, args.sizes, 0, "median error, px", 3))
            print("\n" + table(results, args.sizes, 1, "ms per set", 2), flush=True)
    for name, error in missing.items():
        print(f"without {name}: {error}", file=sys.stderr)
    write_json(args.json, everything)


if __name__ == "__main__":
    main()

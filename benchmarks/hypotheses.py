"""Measure which hypothesis MSAC picks among k minimal samples, by minimal solver and without refinement.

All solvers get the same minimal samples of each of some evenly spaced image pairs; the seven-point solver gets the
first seven points of each, and of its candidates the one of highest score counts. The error of a hypothesis is the mean
symmetric epipolar distance of the pair's ground-truth inliers, at most 60 px. The table has the mean over disjoint
groups of k samples and over image pairs, pixels; pairs with fewer than 16 ground-truth inliers are left out.

    python benchmarks/hypotheses.py STORE.h5 [STORE.h5 ...] [--pairs 12] [--samples 10000] [--numbers 1 10 100 1000]
        [--solvers NAME ...]

A solver is seven-point, which is Kornia's, or a method of learnnorm evaluate.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar.fundamental import run_7point
from shared import make_parser
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.methods import find_method
from kornia_learnnorm.evaluation.robust.robust_run import even_pairs, shuffled_pair
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.protocol import INLIER_THRESHOLD, MAX_RESIDUAL, PROTOCOLS
from kornia_learnnorm.ransac.samplers import draw_distinct

SOLVERS = ["Hartley", "whitening", "reweighted", "crossview", "Hartley+optimal", "seven-point"]
MIN_INLIERS = 16  # ground-truth inliers; pairs with fewer are not measured
BATCH = 250  # minimal samples solved and scored together

Solver = Callable[[Tensor, Tensor], Tensor]  # points (K, 8, 2) float64 in pixels to candidates (K, C, 3, 3)


def find_solver(name: str) -> Solver:
    """Return a minimal solver by its name."""
    if name == "seven-point":
        return lambda x1, x2: run_7point(x1[:, :7], x2[:, :7])
    method = find_method(name)
    return lambda x1, x2: method.estimate(x1, x2)[:, None]


def measure(solver: Solver, x1: Tensor, x2: Tensor, rows: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors, pixels, and MSAC scores of the hypotheses from minimal samples (K, 8)."""
    F_mat = solver(x1[rows], x2[rows])
    h1, h2 = (convert_points_to_homogeneous(x).mT for x in (x1, x2))
    line2, line1 = F_mat @ h1, F_mat.mT @ h2
    # As the formulas have it: a point that is almost on an epipole counts like any other.
    residual = (h2 * line2).sum(-2).abs()
    normal1, normal2 = (line[..., :2, :].square().sum(-2) for line in (line1, line2))
    sampson = residual.square() / (normal1 + normal2)
    score = (1 - sampson / INLIER_THRESHOLD**2).clamp(min=0).nan_to_num(nan=0.0).sum(-1)
    distance = (residual * (normal1.rsqrt() + normal2.rsqrt()))[..., inliers]
    error = distance.nan_to_num(nan=torch.inf).mean(-1).clamp(max=MAX_RESIDUAL)
    best = score.argmax(-1, keepdim=True)
    return error.gather(-1, best)[:, 0], score.gather(-1, best)[:, 0]


def picked(errors: Tensor, scores: Tensor, number: int) -> float:
    """Return the mean error of the hypotheses of highest score in disjoint groups of ``number`` samples."""
    groups = len(errors) // number
    errors, scores = (x[: groups * number].view(groups, number) for x in (errors, scores))
    return errors.gather(-1, scores.argmax(-1, keepdim=True)).mean().item()


@torch.no_grad()
def errors_of(path: str, protocol: str, name: str, pairs: int, samples: int, numbers: list[int]) -> list[float]:
    """Return the error of the picked hypothesis for each number of samples, mean over the pairs of a store."""
    store, solver, found = read_store(path), find_solver(name), []
    for index in even_pairs(len(store), pairs):
        pair = shuffled_pair(store, index, protocol, 0)
        x1, x2 = pair.points1, pair.points2
        inliers = kln.symmetric_epipolar_distance(x1, x2, pair.F_mat) < INLIER_THRESHOLD
        if int(inliers.sum()) < MIN_INLIERS:
            continue
        rows = draw_distinct(torch.full((samples,), len(x1)), Fundamental.min_points, torch.Generator().manual_seed(0))
        parts = [measure(solver, x1, x2, part, inliers) for part in rows.split(BATCH)]
        errors, scores = (torch.cat(part).float().double() for part in zip(*parts, strict=True))
        found.append([picked(errors, scores, number) for number in numbers])
    if not found:
        raise ValueError(f"{path}: no pair has {MIN_INLIERS} ground-truth inliers among its {protocol} matches")
    return torch.tensor(found).mean(0).tolist()


def main() -> None:
    """Measure and print a table per store."""
    parser = make_parser(__doc__)
    parser.add_argument("stores", nargs="+", help="stores of correspondences with ground truth")
    parser.add_argument("--pairs", type=int, default=12, help="image pairs of each store; 0: all")
    parser.add_argument("--samples", type=int, default=10_000, help="minimal samples of each pair")
    parser.add_argument("--numbers", metavar="K", type=int, nargs="+", default=[1, 10, 100, 1000])
    parser.add_argument("--solvers", metavar="NAME", nargs="+", default=SOLVERS)
    args = parser.parse_args()
    if not 1 <= max(args.numbers) <= args.samples:
        parser.error(f"--numbers must be from 1 to --samples {args.samples}, got {max(args.numbers)}")
    for path in args.stores:
        rows = []
        for name in args.solvers:
            options = (name, args.pairs, args.samples, args.numbers)
            found = [error for protocol in PROTOCOLS for error in errors_of(path, protocol, *options)]
            rows.append([f"`{name}`", *(f"{error:.3f}" for error in found)])
        header = [f"{protocol}: k = {number}" for protocol in PROTOCOLS for number in args.numbers]
        print(f"\n{Path(path).stem}\n\n{format_table(['solver', *header], rows)}", flush=True)


if __name__ == "__main__":
    main()

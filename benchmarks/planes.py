"""Compare estimators of homographies on synthetic planes and rotations with exact truth.

Sets of N matches have noise of 0.3-1.5 px in both images and a share of outliers, three in five anywhere in image 2,
the others at the partner of another match. The corner error is the mean distance, pixels, of the corners of image 1,
mapped by the estimate and by the truth; failures count. Table: median, AUC up to 1, 3 and 5 px, %, and mean time, ms,
of one thread; learned matrices are estimated 32 sets at once. Thresholds are 2 px.

    python benchmarks/planes.py [--sizes 16 64 256 512] [--outliers 0.1 0.5 0.8] [--sets 32] [--csv FILE]

What is not installed is left out.
"""

import importlib
import time
from collections.abc import Callable

import cv2
import torch
from kornia.geometry import ransac as kornia_ransac
from kornia.geometry.homography import find_homography_dlt, find_homography_dlt_iterated
from shared import auc_cells, make_parser, write_csv
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic.draws import normal, uniform
from kornia_learnnorm.data.synthetic.random_matches import random_planes
from kornia_learnnorm.evaluation.tables import format_table

THRESHOLD = 2.0  # pixels
THRESHOLDS = (1, 3, 5)  # of the AUC, pixels
MAX_ERROR = 1e3  # pixels, of a failure
BATCH = 32  # sets that the learned layer solves at once
HEADER = ["estimator", "median", "AUC 1", "3", "5", "ms"]


def draw(number: int, size: int, outliers: float, seed: int = 0) -> tuple[Tensor, ...]:
    """Return matches (B, N, 2) x 2, true homographies (B, 3, 3) and the corners of image 1, (B, 4, 2)."""
    generator = torch.Generator().manual_seed(seed)
    exact = random_planes(number, 1, 2 * size + 96, generator)  # the second half is anywhere in image 1
    H_mat = kln.find_homography(exact.exact1, exact.exact2)
    low, high = exact.exact1.amin(1), exact.exact1.amax(1)
    corners = torch.stack(
        [low, torch.stack([high[:, 0], low[:, 1]], 1), high, torch.stack([low[:, 0], high[:, 1]], 1)], 1
    )
    points1, points2 = exact.exact1[:, :size], exact.exact2[:, :size]
    scale = uniform((number, 1, 1), 0.3, 1.5, generator)
    points1, points2 = (points + scale * normal(tuple(points.shape), generator) for points in (points1, points2))
    kind = uniform((number, size, 1), 0.0, 1.0, generator)
    anywhere = uniform((number, size, 2), 0.0, 1.0, generator) * high[:, None]
    wrong = torch.where(kind < 0.6, anywhere, points2[:, torch.randperm(size, generator=generator)])
    points2 = torch.where(uniform((number, size, 1), 0.0, 1.0, generator) < outliers, wrong, points2)
    return points1, points2, H_mat, corners


def corner_error(H_mat: Tensor | None, true: Tensor, corners: Tensor) -> float:
    """Return the mean distance of corners (4, 2) mapped by two homographies (3, 3)."""
    if H_mat is None or H_mat.shape != (3, 3) or not H_mat.any():
        return MAX_ERROR
    x = torch.cat([corners, torch.ones_like(corners[:, :1])], 1)
    mapped = [x @ M.double().mT for M in (H_mat, true)]
    error = (mapped[0][:, :2] / mapped[0][:, 2:] - mapped[1][:, :2] / mapped[1][:, 2:]).norm(dim=1).mean()
    return min(error.nan_to_num(MAX_ERROR).item(), MAX_ERROR)


def find_estimators() -> dict[str, Callable[[Tensor, Tensor], Tensor | None]]:
    """Return functions of matches (N, 2) x 2 by their names; print what is not installed."""

    def opencv(method: int) -> Callable[[Tensor, Tensor], Tensor | None]:
        def estimate(points1: Tensor, points2: Tensor) -> Tensor | None:
            H_mat = cv2.findHomography(points1.numpy(), points2.numpy(), method, THRESHOLD)[0]
            return None if H_mat is None else torch.from_numpy(H_mat)

        return estimate

    def one(find: Callable[..., Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda points1, points2: find(points1[None], points2[None])[0]

    def iterated(points1: Tensor, points2: Tensor) -> Tensor:
        return find_homography_dlt_iterated(points1, points2, torch.ones(points1.shape[:2]))

    kornia = kornia_ransac.RANSAC("homography", inl_th=THRESHOLD, seed=0)
    own = kln.RANSAC(model="homography", inl_th=THRESHOLD, seed=0)
    found = {
        "kln.find_homography": one(kln.find_homography),
        "kornia-dlt": one(find_homography_dlt),
        "kornia-dlt-iterated": one(iterated),
        "kornia": lambda points1, points2: kornia(points1.float(), points2.float())[0],
        "opencv-ransac": opencv(cv2.RANSAC),
        "opencv-usac-magsac": opencv(cv2.USAC_MAGSAC),
        "RANSAC": lambda points1, points2: own(points1, points2)[0],
    }
    try:
        poselib = importlib.import_module("poselib")
        options = {"max_reproj_error": THRESHOLD, "seed": 0}
        found["poselib"] = lambda points1, points2: torch.from_numpy(
            poselib.estimate_homography(points1.numpy(), points2.numpy(), options, {})[0]
        )
    except ImportError as error:
        print(f"left out: {error}")
    return found


def measure(size: int, outliers: float, number: int, estimators: dict, layer: kln.LearnedHomography) -> list[list[str]]:
    """Return the rows of one table."""
    points1, points2, true, corners = draw(number, size, outliers)
    solved: dict[str, list[Tensor | None]] = {}
    seconds: dict[str, float] = {}
    for name, estimate in estimators.items():
        estimate(points1[0], points2[0])  # the first call loads and compiles
        start, solved[name] = time.perf_counter(), []
        for pair in zip(points1, points2, strict=True):
            try:
                solved[name].append(estimate(*pair))
            except cv2.error:
                solved[name].append(None)
        seconds[name] = time.perf_counter() - start
    name, start = "learned:robust-homography", time.perf_counter()
    with torch.no_grad():
        parts = [layer(*pair) for pair in zip(points1.split(BATCH), points2.split(BATCH), strict=True)]
    solved[name], seconds[name] = [*torch.cat(parts)], time.perf_counter() - start
    rows = []
    for name, matrices in solved.items():
        error = torch.tensor([corner_error(*row) for row in zip(matrices, true, corners, strict=True)]).double()
        cells = [f"{error.median().item():.2f}", *auc_cells(error, THRESHOLDS)]
        rows.append([name, *cells, f"{1000 * seconds[name] / number:.1f}"])
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__, csv="write all tables to this file")
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 64, 256, 512])
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.1, 0.5, 0.8])
    parser.add_argument("--sets", type=int, default=32)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    estimators, layer, rows = find_estimators(), kln.LearnedHomography.from_pretrained(), []
    for outliers in args.outliers:
        for size in args.sizes:
            found = measure(size, outliers, args.sets, estimators, layer)
            print(f"N = {size}, {outliers:.0%} outliers\n\n{format_table(HEADER, found)}\n", flush=True)
            rows += [[f"{outliers:.0%}", str(size), *row] for row in found]
    write_csv(args.csv, [["outliers", "N", *HEADER], *rows])


if __name__ == "__main__":
    main()

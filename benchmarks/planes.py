"""Compare estimators of homographies on synthetic planes and rotations with exact truth, and on photographs of planes.

Sets of N matches have noise of 0.3-1.5 px in both images and a share of outliers, three in five anywhere in image 2,
the others at the partner of another match. The corner error is the mean distance, pixels, of the corners of image 1,
mapped by the estimate and by the truth; failures count. Table: median, AUC up to 1, 3 and 5 px, %, and mean time, ms,
of one thread; learned matrices are estimated 32 sets at once. Thresholds are 2 px.

With a store of matches of photographs, those that pass the ratio test at 0.8 count, of the pairs of which one
homography explains at least half of the inliers of a fundamental matrix, both by OpenCV's USAC_MAGSAC. A random half of
a pair's matches gives the homography; the error is the transfer distance of the other half, outliers too. Each half
gives one, twice.

    python benchmarks/planes.py [--sizes 16 64 256 512] [--outliers 0.1 0.5 0.8] [--sets 512] [--rotated 0] [--csv FILE]
    python benchmarks/planes.py --photographs $LEARNNORM_DATA/correspondences/photos.h5 [--csv FILE]

With --rotated 180 image 2 is upside down. What is not installed is left out.
"""

import importlib
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from kornia.geometry import ransac as kornia_ransac
from kornia.geometry.conversions import convert_affinematrix_to_homography
from kornia.geometry.homography import find_homography_dlt, find_homography_dlt_iterated
from kornia.geometry.transform import get_rotation_matrix2d
from shared import auc_cells, make_parser, write_csv
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.synthetic.draws import normal, uniform
from kornia_learnnorm.data.synthetic.random_matches import random_planes
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.geometry.transforms import transform_points

THRESHOLD = 2.0  # pixels
THRESHOLDS = (1, 3, 5)  # of the AUC, pixels
MAX_ERROR = 1e3  # pixels, of a failure
BATCH = 32  # sets that the learned layer solves at once
HEADER = ["estimator", "median", "AUC 1", "3", "5", "ms"]
MAX_RATIO = 0.8  # of the distances of the nearest and the second-nearest descriptor
MIN_ON_PLANE, MIN_PLANE_SHARE = 50, 0.5  # inliers of the homography of a pair of a plane, and of those of F
LEARNED = "learned:robust-homography"


def draw(number: int, size: int, outliers: float, degrees: float = 0.0, seed: int = 0) -> tuple[Tensor, ...]:
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
    A = get_rotation_matrix2d(corners.mean(1), torch.full((number,), degrees).double(), torch.ones(number, 2).double())
    A = convert_affinematrix_to_homography(A)
    return points1, transform_points(points2, A), A @ H_mat, corners


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
    try:
        superansac = importlib.import_module("pysuperansac")
        settings = superansac.RANSACSettings()
        settings.inlier_threshold = THRESHOLD

        def robust(points1: Tensor, points2: Tensor) -> Tensor:
            joined, sizes = torch.cat([points1, points2], 1), [*points1.amax(0).tolist(), *points2.amax(0).tolist()]
            return torch.from_numpy(superansac.estimateHomography(joined.numpy(), sizes, config=settings)[0])

        found["pysuperansac"] = robust
    except ImportError as error:
        print(f"left out: {error}")
    return found


def solve(estimate: Callable[[Tensor, Tensor], Tensor | None], points1: Tensor, points2: Tensor) -> Tensor | None:
    """Return a homography; None also where OpenCV raises an error."""
    try:
        return estimate(points1, points2)
    except cv2.error:
        return None


def measure(sets: tuple[Tensor, ...], estimators: dict, layer: kln.LearnedHomography) -> list[list[str]]:
    """Return the rows of one table."""
    points1, points2, true, corners = sets
    solved: dict[str, list[Tensor | None]] = {}
    seconds: dict[str, float] = {}
    for name, estimate in estimators.items():
        estimate(points1[0], points2[0])  # the first call loads and compiles
        start = time.perf_counter()
        solved[name] = [solve(estimate, *pair) for pair in zip(points1, points2, strict=True)]
        seconds[name] = time.perf_counter() - start
    start = time.perf_counter()
    with torch.no_grad():
        parts = [layer(*pair) for pair in zip(points1.split(BATCH), points2.split(BATCH), strict=True)]
    solved[LEARNED], seconds[LEARNED] = [*torch.cat(parts)], time.perf_counter() - start
    rows = []
    for name, matrices in solved.items():
        error = torch.tensor([corner_error(*row) for row in zip(matrices, true, corners, strict=True)]).double()
        cells = [f"{error.median().item():.2f}", *auc_cells(error, THRESHOLDS)]
        rows.append([name, *cells, f"{1000 * seconds[name] / len(true):.1f}"])
    return rows


def read_planes(path: Path) -> list[tuple[Tensor, Tensor]]:
    """Return the matches (N, 2) x 2 of the pairs of a store whose inliers lie mostly on one plane."""
    store, pairs = read_store(path), []
    for matches in (store.matches(pair, MAX_RATIO) for pair in range(len(store))):
        points1, points2 = (points.astype(np.float64) for points in matches[:2])
        near = cv2.findFundamentalMat(points1, points2, cv2.USAC_MAGSAC, THRESHOLD)[1]
        on_plane = cv2.findHomography(points1, points2, cv2.USAC_MAGSAC, THRESHOLD)[1]
        if near is None or on_plane is None or on_plane.sum() < MIN_ON_PLANE:
            continue
        if (near & on_plane).sum() >= MIN_PLANE_SHARE * near.sum():
            pairs.append((torch.from_numpy(points1), torch.from_numpy(points2)))
    return pairs


def measure_photographs(pairs: list[tuple[Tensor, Tensor]], estimators: dict) -> list[list[str]]:
    """Return a row for each estimator of halves of the matches of pairs."""
    rows = []
    for name, estimate in estimators.items():
        errors, seconds = [], []
        for number, pair in enumerate(pairs):
            generator = torch.Generator().manual_seed(number)
            for order in (torch.randperm(len(pair[0]), generator=generator) for _ in range(2)):
                halves = order.chunk(2)
                for fitted, held_out in (halves, halves[::-1]):
                    start = time.perf_counter()
                    H_mat = solve(estimate, *(points[fitted] for points in pair))
                    seconds.append(time.perf_counter() - start)
                    found = H_mat is not None and H_mat.shape == (3, 3) and bool(H_mat.any())
                    H = H_mat.double() if found else torch.full((3, 3), torch.nan).double()
                    errors.append(kln.transfer_distance(*(points[held_out][None] for points in pair), H[None])[0])
        every = torch.cat(errors).nan_to_num(MAX_ERROR)
        rows.append([name, *auc_cells(every, THRESHOLDS), f"{1000 * np.median(seconds):.1f}"])
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__, csv="write all tables to this file")
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 64, 256, 512])
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.1, 0.5, 0.8])
    parser.add_argument("--sets", type=int, default=512)
    parser.add_argument("--rotated", type=float, default=0.0, help="image 2 in its plane, degrees")
    parser.add_argument("--photographs", type=Path, help="a store of matches")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    estimators, layer, rows = find_estimators(), kln.LearnedHomography.from_pretrained(), []
    if args.photographs:
        estimators[LEARNED] = torch.no_grad()(lambda points1, points2: layer(points1[None], points2[None])[0])
        pairs, header = read_planes(args.photographs), ["estimator", *HEADER[2:]]
        rows = measure_photographs(pairs, estimators)
        print(f"{len(pairs)} pairs of photographs\n\n{format_table(header, rows)}")
    else:
        header = ["outliers", "N", *HEADER]
        for outliers in args.outliers:
            for size in args.sizes:
                found = measure(draw(args.sets, size, outliers, args.rotated), estimators, layer)
                print(f"N = {size}, {outliers:.0%} outliers\n\n{format_table(HEADER, found)}\n", flush=True)
                rows += [[f"{outliers:.0%}", str(size), *row] for row in found]
    write_csv(args.csv, [header, *rows])


if __name__ == "__main__":
    main()

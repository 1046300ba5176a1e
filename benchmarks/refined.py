"""Compare matches as they were found, moved by a MatchRefiner and tracked by Lucas and Kanade, on pairs with images.

Table: median symmetric epipolar distance of the matches that are within 4 px of the true lines as they were found, from
the true lines (px) and from those of RANSAC's matrix (fit), px, mean over pairs: the true poses of KITTI and TUM are no
more exact than good matches. AUC of the pose error up to 5 degrees, %, by estimator; median CPU time of moving the
matches, ms, of one thread. Lucas-Kanade is OpenCV's, with a window of 15 px, started at the match; where it fails the
found match stays. Keypt2Subpx (S. Kim, M. Pollefeys, D. Barath, ECCV 2024) has rows of XFeat's stores only, with a
checkout of its repository: its authors' weights for XFeat, with descriptors of Kornia's XFeat.

    python benchmarks/refined.py STORE.h5 [STORE.h5 ...] --images FOLDER [FOLDER ...] [--pairs 25] [--filtered]
        [--weights refiner ...] [--passes 1] [--estimators NAME ...] [--keypt2subpx FOLDER] [--csv FILE]

Each of several weights has a row. An estimator is one of learnnorm robust; what is not installed is left out. --csv
adds the rows to those of other stores in the file.
"""

import importlib
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from kornia.feature import XFeat
from poses import THRESHOLD, find_installed
from shared import auc_cells, make_parser, read_csv, write_csv
from torch import Tensor
from torch.nn.functional import interpolate, normalize

import kornia_learnnorm as kln
from kornia_learnnorm.data.image_sets import find_images
from kornia_learnnorm.data.images import read_image
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.robust.robust_estimators import EvaluatedPair, find_estimator, run_estimator
from kornia_learnnorm.evaluation.robust.robust_run import even_pairs, measure, shuffled_pair
from kornia_learnnorm.evaluation.tables import format_table, names_of

ESTIMATORS = ("RANSAC", "poselib", "RANSAC-calibrated", "poselib-calibrated", "learned:robust-pose-synthetic+scores")
TRUE_MATCH = 4.0  # pixels from the true lines
WINDOW = 15  # pixels, of Lucas-Kanade

Mover = Callable[[list[np.ndarray], EvaluatedPair], tuple[Tensor, Tensor]]  # of two grey images and their matches


def track(images: list[np.ndarray], pair: EvaluatedPair) -> tuple[Tensor, Tensor]:
    """Return the matches with second points by Lucas and Kanade."""
    first, second = (points.float().numpy()[:, None] for points in (pair.points1, pair.points2))
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        *images, first, second.copy(), winSize=(WINDOW, WINDOW), maxLevel=0, flags=flags
    )
    return pair.points1, torch.from_numpy(np.where(status[..., None] > 0, tracked, second)[:, 0]).double()


def mover(path: str, passes: int) -> Mover:
    """Return a refiner's weights as a function of grey images and a pair."""
    refiner = kln.MatchRefiner.from_pretrained(path)
    refiner.passes = passes

    @torch.no_grad()
    def move(images: list[np.ndarray], pair: EvaluatedPair) -> tuple[Tensor, Tensor]:
        views = [torch.from_numpy(image)[None, None] for image in images]
        points1, points2, _ = refiner(*views, pair.points1[None], pair.points2[None])
        return points1[0], points2[0]

    return move


def keypt2subpx(folder: str) -> Mover:
    """Return Keypt2Subpx of a checkout as a function of grey images and a pair."""
    sys.path.append(folder)
    network = importlib.import_module("model").Keypt2Subpx(output_dim=64, use_score=False).eval()
    scalars = [(np.float64().__reduce__()[0], "numpy.core.multiarray.scalar"), np.dtype, np.dtypes.Float64DType]
    with torch.serialization.safe_globals(scalars):  # the file has its accuracy too
        weights = torch.load(
            Path(folder) / "pretrained/k2s_xfeat_pretrained.pth", map_location="cpu", weights_only=True
        )
    network.net.load_state_dict(weights["model"])
    xfeat = XFeat.from_pretrained()

    @torch.no_grad()
    def move(images: list[np.ndarray], pair: EvaluatedPair) -> tuple[Tensor, Tensor]:
        views = [torch.from_numpy(image)[None] / 255 for image in images]
        points, descriptors = [pair.points1.float(), pair.points2.float()], []
        for view, keypoints in zip(views, points, strict=True):
            size = [32 * (length // 32) for length in view.shape[1:]]  # that XFeat reads
            features = normalize(xfeat.net(interpolate(view[None], size, mode="bilinear"))[0], dim=1)
            scaled = keypoints * torch.tensor(size[::-1]) / torch.tensor(view.shape[:0:-1])
            descriptors.append(normalize(xfeat.interpolator(features, scaled[None], *size)[0], dim=-1))
        moved1, moved2 = network(*points, *views, *descriptors)
        return moved1.double(), moved2.double()

    return move


def measure_store(path: str, folders: list[str], number: int, protocol: str, movers: dict, estimators: dict) -> list:
    """Return the rows of a store's table."""
    store, find = read_store(path), find_images(folders)
    pixels: dict[str, list[tuple[float, float]]] = {name: [] for name in movers}
    fit = find_estimator("RANSAC")
    seconds: dict[str, list[float]] = {name: [] for name in movers}
    errors: dict[tuple[str, str], list[float]] = {(name, other): [] for name in movers for other in estimators}
    for index in even_pairs(len(store), number):
        found = shuffled_pair(store, index, protocol, seed=0)
        sizes = [(int(width), int(height)) for width, height in found.size]
        files = [find(name, size) for name, size in zip(store.names[index], sizes, strict=True)]
        if None in files:
            raise FileNotFoundError(f"{path}: no images of {store.names[index]} in {', '.join(folders)}")
        images = [read_image(file, max(size)) for file, size in zip(files, sizes, strict=True)]
        near = kln.symmetric_epipolar_distance(found.points1, found.points2, found.F_mat) < TRUE_MATCH
        for name, move in movers.items():
            start = time.process_time()
            points1, points2 = move(images, found)
            seconds[name].append(time.process_time() - start)
            pair = found._replace(points1=points1, points2=points2)
            matrices = torch.stack([found.F_mat, run_estimator(fit, pair, 0, THRESHOLD).F_mat])
            distance = kln.symmetric_epipolar_distance(points1[near], points2[near], matrices)
            pixels[name].append(tuple(distance.median(-1).values.tolist()) if near.any() else (math.nan, math.nan))
            for other, estimator in estimators.items():
                F_mat = run_estimator(estimator, pair, 0, THRESHOLD).F_mat
                results = measure(pair, F_mat, THRESHOLD)
                errors[name, other].append(max(results["rotation_error"], results["translation_error"]))
    rows = []
    for name in movers:
        aucs = [cell for other in estimators for cell in auc_cells(errors[name, other], [5])]
        ms = 1000 * np.median(seconds[name])
        rows.append([name, *(f"{mean:.3f}" for mean in np.nanmean(pixels[name], 0)), *aucs, f"{ms:.1f}"])
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__, csv="add the rows to this file")
    parser.add_argument("stores", nargs="+")
    parser.add_argument("--images", nargs="+", required=True, help="folders below which the images lie")
    parser.add_argument("--pairs", type=int, default=25, help="of each store, evenly spaced; 0: all")
    parser.add_argument("--filtered", action="store_true", help="matches that pass the ratio test, as for SIFT")
    parser.add_argument("--weights", nargs="+", default=["refiner"], help="of a MatchRefiner, by name or a file")
    parser.add_argument("--passes", type=int, default=1, help="how often the refiner moves the points")
    parser.add_argument("--estimators", nargs="*", default=[*ESTIMATORS])
    parser.add_argument("--keypt2subpx", metavar="FOLDER", help="a checkout of its repository")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    names = names_of(args.weights) if len(args.weights) > 1 else {args.weights[0]: "moved"}
    moved = {name: mover(path, args.passes) for path, name in names.items()}
    movers = {"found": lambda _, pair: (pair.points1, pair.points2), **moved, "Lucas-Kanade": track}
    estimators, protocol = find_installed(args.estimators), "filtered" if args.filtered else "unfiltered"
    header, rows = ["matches", "px", "fit", *estimators, "ms"], []
    for path, name in names_of(args.stores).items():
        peer = {"Keypt2Subpx": keypt2subpx(args.keypt2subpx)} if args.keypt2subpx and "xfeat" in name else {}
        found = measure_store(path, args.images, args.pairs, protocol, movers | peer, estimators)
        print(f"{name}\n\n{format_table(header, found)}\n", flush=True)
        rows += [[name, *row] for row in found]
    before = read_csv(args.csv)[1:] if args.csv and Path(args.csv).exists() else []
    kept = [row for row in before if row[0] not in {row[0] for row in rows}]
    write_csv(args.csv, [["store", *header], *kept, *rows])


if __name__ == "__main__":
    main()

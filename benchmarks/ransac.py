"""Time robust estimators on the image pairs of a store, all with their defaults at one pixel.

The estimators take turns on every pair in one process; the table has the medians over pairs and turns, the ratio to
Kornia's, and the mean F1 at 1 px against the ground truth. PoseLib's row is left out where it is not installed.

    python benchmarks/ransac.py kitti_06.h5 [--unfiltered] [--pairs 24] [--repeat 3]
"""

import argparse
import statistics
import time
from importlib.util import find_spec

import cv2
import numpy as np
import torch
from kornia.geometry.ransac import RANSAC

import kornia_learnnorm as kln
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.tables import format_table

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("store")
parser.add_argument("--unfiltered", action="store_true", help="all matches, not at most 1,000 that pass the ratio test")
parser.add_argument("--pairs", type=int, default=24, help="evenly spaced image pairs")
parser.add_argument("--repeat", type=int, default=3, help="turns")
args = parser.parse_args()


def poselib(x1, x2, _):
    import poselib as library

    return torch.from_numpy(library.estimate_fundamental(x1.numpy(), x2.numpy(), {"max_epipolar_error": 1.0}, {})[0])


def magsac(x1, x2, _):
    return torch.from_numpy(cv2.findFundamentalMat(x1.numpy(), x2.numpy(), cv2.USAC_MAGSAC, 1.0)[0])


estimators = {
    "kornia, seven-point": lambda x1, x2, _: RANSAC("fundamental", 1.0, seed=0)(x1.float(), x2.float())[0],
    "kornia, eight-point": lambda x1, x2, _: RANSAC("fundamental_8pt", 1.0, seed=0)(x1.float(), x2.float())[0],
    "PoseLib": poselib,
    "OpenCV MAGSAC": magsac,
    "kornia_learnnorm": lambda x1, x2, _: kln.RANSAC(seed=0)(x1, x2)[0],
    "kornia_learnnorm, weights 1 - ratio": lambda x1, x2, ratio: kln.RANSAC(seed=0)(x1, x2, 1 - ratio)[0],
}
if find_spec("poselib") is None:
    del estimators["PoseLib"]

store, rng = read_store(args.store), np.random.default_rng(0)
times: dict[str, list[float]] = {name: [] for name in estimators}
scores: dict[str, list[float]] = {name: [] for name in estimators}
numbers = []
for pair in np.unique(np.linspace(0, len(store) - 1, args.pairs).round().astype(int)):
    rows = np.arange(store.offsets[pair], store.offsets[pair + 1])
    if not args.unfiltered:
        rows = rng.permutation(rows[store.ratio[rows] < 0.8])[:1000]
    numbers.append(len(rows))
    x1, x2, ratio = (torch.from_numpy(values[rows]).double() for values in (store.points1, store.points2, store.ratio))
    for _ in range(args.repeat):
        for name, estimate in estimators.items():
            start = time.perf_counter()
            F_mat = estimate(x1, x2, ratio)
            times[name].append(1e3 * (time.perf_counter() - start))
            scores[name].append(100 * kln.f1_score(x1, x2, F_mat.double(), torch.from_numpy(store.F[pair]), 1.0).item())
medians = {name: statistics.median(values) for name, values in times.items()}
kornia = medians["kornia, seven-point"]
rows = [
    [name, f"{value:.1f}", f"{value / kornia:.2f}", f"{np.nanmean(scores[name]):.2f}"]
    for name, value in medians.items()
]
print(f"{len(numbers)} pairs, median of {statistics.median(numbers):.0f} matches, {torch.get_num_threads()} threads\n")
print(format_table(["estimator", "ms", "ratio to kornia", "F1 at 1 px (%)"], rows))

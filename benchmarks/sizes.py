"""Measure how the number of correspondences decides which normalisation is the most accurate.

The matches of each image pair that pass the ratio test are shuffled and cut into samples of N, at most 20 a pair. The
error of a sample is the median symmetric epipolar distance of the ground-truth inliers of its pair; the table has the
medians over samples, in pixels.

    python benchmarks/sizes.py STORE.h5 [--sizes 8 32 128 512] [--seed 0]
"""

import argparse

import torch

import kornia_learnnorm as kln
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("store")
parser.add_argument("--sizes", type=int, nargs="+", default=[8, 32, 128, 512], help="correspondences in a sample")
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()

ransac = kln.RANSAC(seed=0)
methods = {
    "Hartley": kln.EightPoint(),
    "whitening": kln.EightPoint(kln.Whitening()),
    "reweighted whitening": kln.EightPoint(kln.ReweightedWhitening()),
    "learned: paper": kln.EightPoint(kln.LearnedNormalizer.from_pretrained("paper")),
    "learned: crossview": kln.EightPoint(kln.LearnedNormalizer.from_pretrained()),
    "learned: crossview-synthetic": kln.EightPoint(kln.LearnedNormalizer.from_pretrained("crossview-synthetic")),
    "Hartley, optimal correction": kln.EightPoint(rank2="optimal"),
    "RANSAC": lambda x1, x2: torch.stack([ransac(*pair)[0] for pair in zip(x1, x2, strict=True)]),
}
store, generator = read_store(args.store), torch.Generator().manual_seed(args.seed)
columns = []
for size in args.sizes:
    errors: dict[str, list[torch.Tensor]] = {name: [] for name in methods}
    for pair in range(len(store)):
        rows = torch.arange(store.offsets[pair], store.offsets[pair + 1])
        rows = rows[torch.from_numpy(store.ratio)[rows] < RATIO]
        x1, x2 = (torch.from_numpy(points)[rows].double() for points in (store.points1, store.points2))
        near = kln.symmetric_epipolar_distance(x1, x2, torch.from_numpy(store.F[pair])) < INLIER_THRESHOLD
        samples = torch.randperm(len(rows), generator=generator)[: len(rows) // size * size].view(-1, size)[:20]
        for name, method in methods.items():
            if len(samples) and near.any() and (name != "RANSAC" or size > 8):  # RANSAC needs more than a sample
                with torch.no_grad():
                    F_mat = method(x1[samples], x2[samples])
                truth = (points[near].expand(len(samples), -1, -1) for points in (x1, x2))
                errors[name].append(kln.symmetric_epipolar_distance(*truth, F_mat).median(-1).values)
    number = sum(len(values) for values in errors["Hartley"])
    columns.append([f"N = {size}, {number} samples"])
    columns[-1] += [f"{torch.cat(values).median():.2f}" if values else "-" for values in errors.values()]
rows = [list(cells) for cells in zip(["median error, px", *methods], *columns, strict=True)]
print(format_table(rows[0], rows[1:]))

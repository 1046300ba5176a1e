"""Time a batch of eight-point samples under each normaliser against kornia.geometry.epipolar.find_fundamental.

All methods take turns in one process; the table has medians and the ratio of each to Kornia's.

    python benchmarks/normalizers.py [--batch 1024] [--repeat 21] [--device cpu]
"""

import argparse
import statistics
import time

import torch
from kornia.geometry.epipolar import find_fundamental

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import random_scenes
from kornia_learnnorm.evaluation.tables import format_table

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--batch", type=int, default=1024, help="samples in a batch")
parser.add_argument("--repeat", type=int, default=21, help="turns")
parser.add_argument("--device", default="cpu")
args = parser.parse_args()

scenes = random_scenes(args.batch, 8, torch.Generator().manual_seed(0))
points1, points2 = scenes.points1.to(args.device, torch.float32), scenes.points2.to(args.device, torch.float32)
normalizers = {
    "Hartley": kln.Hartley(),
    "whitening": kln.Whitening(),
    "reweighted": kln.ReweightedWhitening(),
    "paper": kln.LearnedNormalizer.from_pretrained("paper").to(args.device),
    "crossview": kln.LearnedNormalizer.from_pretrained().to(args.device),
}
methods = {"kornia (Hartley)": lambda: find_fundamental(points1, points2)}
for name, normalizer in normalizers.items():
    methods[name] = lambda normalizer=normalizer: kln.find_fundamental(points1, points2, normalizer=normalizer)

times: dict[str, list[float]] = {name: [] for name in methods}
with torch.no_grad():
    for _ in range(args.repeat + 1):
        for name, method in methods.items():
            start = time.perf_counter()
            method()
            if args.device != "cpu":
                torch.cuda.synchronize()
            times[name].append(1e3 * (time.perf_counter() - start))
medians = {name: statistics.median(values[1:]) for name, values in times.items()}
kornia = medians["kornia (Hartley)"]
rows = [[name, f"{value:.1f}", f"{value / kornia:.2f}"] for name, value in medians.items()]
print(f"{args.batch} samples of eight, float32, {args.device}, {torch.get_num_threads()} threads\n")
print(format_table(["method", "ms", "ratio to kornia"], rows))

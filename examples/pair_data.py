"""What the examples share: image pairs with outliers and ground truth, and a small network over their correspondences.

With ``LEARNNORM_DATA``, pairs come from KITTI's sequences, 03 or others for training and 06 held out; else they are
synthetic.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import orbit


class Pairs(NamedTuple):
    """Image pairs: points (P, N, 2) of both views, one more feature (P, N), fundamental matrices (P, 3, 3)."""

    points1: Tensor
    points2: Tensor
    feature: Tensor
    F_mat: Tensor

    def draw(self, num_pairs: int, num_points: int, generator: Generator) -> Pairs:
        """Return some correspondences of some pairs."""
        rows = torch.randperm(len(self.F_mat), generator=generator)[:num_pairs]
        columns = torch.randperm(self.feature.shape[1], generator=generator)[:num_points]
        return Pairs(*(value[rows][:, columns] for value in self[:3]), self.F_mat[rows])

    def select(self, columns: slice) -> Pairs:
        """Return some correspondences of all pairs."""
        return Pairs(*(value[:, columns] for value in self[:3]), self.F_mat)

    def error(self, F_mat: Tensor, bound: float = 10.0) -> Tensor:
        """Return distances of ground-truth inliers in pixels, clamped, averaged per matrix (P, *, 3, 3)."""
        extra = F_mat.ndim - 3
        points = [p.view(len(p), *[1] * extra, *p.shape[1:]).expand(*F_mat.shape[:-2], -1, -1) for p in self[:2]]
        with torch.no_grad():
            truth = kln.symmetric_epipolar_distance(self.points1, self.points2, self.F_mat)
            inliers = (truth < 1).view(len(truth), *[1] * extra, -1).to(truth)
        distance = kln.symmetric_epipolar_distance(*points, F_mat)
        return (inliers * distance.clamp(max=bound)).sum(-1) / inliers.sum(-1).clamp(min=1)


class SetNetwork(nn.Module):
    """One number per correspondence, from itself and from the mean over all: order does not matter."""

    def __init__(self, width: int = 48, depth: int = 4) -> None:
        super().__init__()
        self.stem = nn.Linear(5, width)
        self.layers = nn.ModuleList(nn.Linear(2 * width, width) for _ in range(depth))
        self.head = nn.Linear(width, 1)
        nn.init.zeros_(self.head.weight)

    def forward(self, pairs: Pairs) -> Tensor:
        """Return numbers (P, N), zero before training."""
        points1, points2 = standardize(pairs.points1), standardize(pairs.points2)
        x = self.stem(torch.cat([points1, points2 - points1, pairs.feature[..., None]], -1))
        for layer in self.layers:
            y = torch.nn.functional.layer_norm(x, x.shape[-1:])
            x = x + layer(torch.cat([y, y.mean(1, keepdim=True).expand_as(y)], -1)).relu()
        return self.head(x).squeeze(-1)


def standardize(points: Tensor) -> Tensor:
    """Return points (P, N, 2) with their mean at zero and a spread of one."""
    return (points - points.mean(1, keepdim=True)) / points.std((1, 2), keepdim=True)


def load_pairs(*sequences: str, num_points: int = 1000, num_held_out: int = 1000) -> tuple[Pairs, Pairs]:
    """Return pairs to learn from, of KITTI's sequence 03 where none is named, and pairs held out."""
    if folder := os.environ.get("LEARNNORM_DATA"):
        stores = Path(folder) / "correspondences"
        parts = [read_pairs(stores / f"kitti_{name}.h5", num_points) for name in sequences or ["03"]]
        training = Pairs(*(torch.cat(values) for values in zip(*parts, strict=True)))
        return training, read_pairs(stores / "kitti_06.h5", num_held_out)
    return synthetic_pairs(400, seed=0), synthetic_pairs(50, seed=1)


def read_pairs(path: Path, num_points: int = 1000) -> Pairs:
    """Return the pairs of a store that have as many correspondences; the feature is Lowe's ratio."""
    from kornia_learnnorm.data.store import read_store

    store, generator = read_store(path), Generator().manual_seed(0)
    kept = [k for k in range(len(store)) if store.offsets[k + 1] - store.offsets[k] >= num_points]
    sizes = [int(store.offsets[k + 1] - store.offsets[k]) for k in kept]
    rows = [
        int(store.offsets[k]) + torch.randperm(n, generator=generator)[:num_points]
        for k, n in zip(kept, sizes, strict=True)
    ]
    values = [torch.from_numpy(v)[torch.stack(rows)] for v in (store.points1, store.points2, store.ratio)]
    return Pairs(*values, torch.from_numpy(store.F[kept]).float())


def synthetic_pairs(num_pairs: int, seed: int, num_points: int = 500) -> Pairs:
    """Return random scenes with 30 % outliers; the feature is noise."""
    generator = Generator().manual_seed(seed)
    scene = orbit(num_pairs, num_points, generator, noise=0.3, outliers=0.3)
    feature = torch.rand(num_pairs, num_points, generator=generator)
    return Pairs(scene.points1.float(), scene.points2.float(), feature, scene.F_mat.float())


def parse(description: str, args: Sequence[str] | None, steps: int) -> argparse.Namespace:
    """Return the options of an example."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--steps", type=int, default=steps)
    parser.add_argument("--pairs", type=int, default=8, help="image pairs per step")
    parser.add_argument("--points", type=int, default=256, help="correspondences per pair")
    return parser.parse_args(args)

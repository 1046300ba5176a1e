"""Train a weight for every match of LightGlue without labels: half of the matches has to fit the matrix of the others.

XFeat and its LightGlue, with Kornia's weights, match consecutive images of folders. A small network reads what
LightGlue knows of a match, both descriptors before its last layer and the score, and gives a weight. LearnedEightPoint
estimates the fundamental matrix from one half of the matches with their weights; the loss is the log distance of the
other half. benchmarks/match_weights.py measures what that gives.

    python examples/finetune_lightglue.py FOLDER [FOLDER ...] [--steps 300]
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.feature import LightGlue
from torch import Generator, Tensor, nn
from tqdm import tqdm

import kornia_learnnorm as kln
from kornia_learnnorm.data.images import read_colour
from kornia_learnnorm.data.matching.features import detect_xfeat
from kornia_learnnorm.evaluation.robust.robust_run import even_pairs

HALF = 200  # matches of a half in training
FAR = 6.0  # pixels, at which the distance of a match is clamped: more is an outlier
MAX_PAIRS = 40  # of a folder, evenly spaced
MIN_MATCHES = 60  # of a pair


class Pair(NamedTuple):
    """The matches of an image pair and what LightGlue knows of them."""

    points: Tensor  # pixels in both views, (N, 4), float64
    scores: Tensor  # LightGlue's, (N,)
    descriptors: Tensor  # before its last layer, of both views, (2, N, D)
    truth: tuple[Tensor, ...] = ()  # K1, K2, R, t, where known


class MatchWeights(nn.Module):
    """Predict a weight from 0 to 2 for every match, 1 at first, the same with the views swapped."""

    def __init__(self, dim: int = 96) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(2 * dim + 1, 64), nn.ReLU(), nn.Linear(64, 1))
        nn.init.zeros_(self.network[2].weight)
        nn.init.zeros_(self.network[2].bias)

    def forward(self, pair: Pair) -> Tensor:
        """Return the weights (N,)."""
        logit = pair.scores.clamp(1e-4, 1 - 1e-4).logit()[:, None]
        views = pair.descriptors, pair.descriptors.flip(0)
        return 2 * sum(self.network(torch.cat([*view, logit], -1))[:, 0] for view in views).sigmoid().double()


def pretrained() -> tuple[kln.LearnedEightPoint, LightGlue]:
    """Return the layer, which is not trained, and XFeat's LightGlue, which drops no keypoint before its last layer."""
    lightglue = LightGlue("xfeat")
    lightglue.conf.width_confidence = -1
    return kln.LearnedEightPoint.from_pretrained("robust-synthetic").requires_grad_(False), lightglue


def features(images: Sequence[Any], num_features: int = 1000) -> dict[str, dict[str, Tensor]]:
    """Return the input of LightGlue for two images, uint8 arrays (H, W) or (H, W, 3)."""
    sides = {}
    for k, image in enumerate(images):
        points, descriptors, size, _ = detect_xfeat(image, num_features)
        side = {"keypoints": points, "descriptors": descriptors, "image_size": np.array(size)}
        sides[f"image{k}"] = {name: torch.from_numpy(value)[None] for name, value in side.items()}
    return sides


def match(lightglue: LightGlue, sides: dict[str, dict[str, Tensor]], truth: tuple[Tensor, ...] = ()) -> Pair:
    """Match the features of two images and keep what the last layer of LightGlue reads."""
    inputs: list[Tensor] = []
    with torch.no_grad(), lightglue.log_assignment[-1].register_forward_pre_hook(lambda _, args: inputs.extend(args)):
        output = lightglue(sides)
    index = output["matches"][0].T
    points = [side["keypoints"][0, rows] for side, rows in zip(sides.values(), index, strict=True)]
    descriptors = [view[0, rows] for view, rows in zip(inputs, index, strict=True)]
    return Pair(torch.cat(points, 1).double(), output["scores"][0], torch.stack(descriptors), truth)


def halves_loss(layer: nn.Module, weigh: nn.Module, pairs: Sequence[Pair], generator: Generator) -> Tensor:
    """Return the mean log distance, pixels, of random halves of the matches under the matrices of the other halves."""
    rows = []
    for pair in pairs:
        row = torch.cat([pair.points, pair.scores[:, None], weigh(pair)[:, None]], 1)
        halves = row[torch.randperm(len(row), generator=generator)].chunk(2)
        rows.append(torch.stack([half[torch.arange(HALF) % len(half)] for half in halves]))
    used, held = torch.cat(rows), torch.cat([row.flip(0) for row in rows])
    F_mat = layer.estimate(used[..., :2], used[..., 2:4], scores=used[..., 4], weights=used[..., 5]).F_mat
    distance = kln.symmetric_epipolar_distance(held[..., :2], held[..., 2:4], F_mat)
    return (distance.clamp(max=FAR) + 0.05).log().mean()


def train(layer: nn.Module, weigh: nn.Module, pairs: Sequence[Pair], steps: int, batch: int = 4) -> None:
    """Train the weights on random pairs."""
    optimizer, generator = torch.optim.AdamW(weigh.parameters(), 2e-3), Generator().manual_seed(1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in tqdm(range(steps), "training", unit="step", disable=None):
        chosen = torch.randint(len(pairs), (batch,), generator=generator).tolist()
        optimizer.zero_grad()
        halves_loss(layer, weigh, [pairs[i] for i in chosen], generator).backward()
        nn.utils.clip_grad_norm_(weigh.parameters(), 1.0)
        optimizer.step()
        schedule.step()


@torch.no_grad()
def held_out_loss(layer: nn.Module, weigh: nn.Module, pairs: Sequence[Pair]) -> float:
    """Return the mean loss of pairs, always of the same halves."""
    generator = Generator().manual_seed(0)
    return torch.stack([halves_loss(layer, weigh, [pair], generator) for pair in pairs]).mean().item()


def read_pairs(lightglue: LightGlue, folders: Sequence[Path]) -> list[Pair]:
    """Match consecutive images of folders, without the pairs of few matches."""
    pairs = []
    for neighbours in [list(pairwise(sorted(folder.glob("*.*g")))) for folder in folders]:
        chosen = [neighbours[i] for i in even_pairs(len(neighbours), MAX_PAIRS)]
        chosen = tqdm(chosen, "matching", unit="pair", disable=None)
        pairs += [match(lightglue, features([read_colour(path, 1024) for path in paths])) for paths in chosen]
    return [pair for pair in pairs if len(pair.points) >= MIN_MATCHES]


def main(args: Sequence[str] | None = None) -> tuple[float, float]:
    """Train, and print and return the loss before and after; every sixth pair is held out."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args(args)
    layer, lightglue = pretrained()
    pairs = read_pairs(lightglue, options.folders)
    if len(pairs) < 1 + (options.steps > 0):  # one is held out
        parser.error(f"the folders have {len(pairs)} pairs of {MIN_MATCHES} or more matches, expected 2 or more")
    torch.manual_seed(0)
    weigh = MatchWeights()
    before = held_out_loss(layer, weigh, pairs[::6])
    train(layer, weigh, [pair for i, pair in enumerate(pairs) if i % 6], options.steps)
    after = held_out_loss(layer, weigh, pairs[::6])
    print(f"{len(pairs[::6])} held-out pairs, mean log distance: {before:.3f} before, {after:.3f} after")
    return before, after


if __name__ == "__main__":
    main()

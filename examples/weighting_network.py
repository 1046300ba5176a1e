"""Train a network that weighs correspondences through the eight-point algorithm, then go on with other normalisations.

Two stages: the first weighs correspondences by themselves, the second also by their distances under the first result.
Both end in the weighted eight-point algorithm, a layer, so that the error of the matrices trains everything before it.
The first steps are with Hartley's normalisation; the last ones, from where these ended and on the same batches, with
each of those compared. The estimator sees some of a pair's matches; all of them count in the loss and in the results.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from copy import deepcopy
from time import perf_counter

import torch
from pairs import Pairs, load_pairs, standardize
from torch import Generator, Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

import kornia_learnnorm as kln

INLIER, FLOOR = 1.0, 0.01  # pixels: what counts as an inlier; errors below are as good as this


class ContextBlock(nn.Module):
    """Two layers over each correspondence, each normalised over all of the pair's (context normalisation), plus a skip.

    Reference:
        K. M. Yi et al., Learning to find good correspondences, CVPR 2018.

    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width)) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the shape that they came in, (P, N, C)."""
        h = x
        for layer in self.layers:
            h = layer(h)
            h = ((h - h.mean(1, keepdim=True)) / (h.std(1, keepdim=True) + 1e-3)).relu()
        return x + h


class WeightingNetwork(nn.Module):
    """A logit for each correspondence, from it and its context."""

    def __init__(self, extra_features: int = 0, width: int = 48, depth: int = 4) -> None:
        super().__init__()
        self.stem = nn.Linear(5 + extra_features, width)
        self.blocks = nn.Sequential(*(ContextBlock(width) for _ in range(depth)))
        self.head = nn.Linear(width, 1)
        nn.init.zeros_(self.head.weight)

    def forward(self, pairs: Pairs, *extra: Tensor) -> Tensor:
        """Return logits (P, N), zero before training; ``extra`` are further features (P, N)."""
        points1, points2 = standardize(pairs.points1), standardize(pairs.points2)
        features = [points1, 10 * (points2 - points1), pairs.feature[..., None], *(value[..., None] for value in extra)]
        return self.head(self.blocks(self.stem(torch.cat(features, -1)))).squeeze(-1)


class Estimator(nn.Module):
    """Weighting, eight-point algorithm, and once more with the distances that it left."""

    def __init__(self, normalizer: nn.Module) -> None:
        super().__init__()
        self.stages = nn.ModuleList([WeightingNetwork(), WeightingNetwork(extra_features=2)])
        self.eight_point = kln.EightPoint(normalizer)

    def forward(self, pairs: Pairs) -> list[tuple[Tensor, Tensor]]:
        """Return logits (P, N) and fundamental matrices (P, 3, 3) of both stages."""
        results: list[tuple[Tensor, Tensor]] = []
        extra: list[Tensor] = []
        for stage in self.stages:
            logits = stage(pairs, *extra)
            weights = logits.sigmoid().square()
            F_mat = self.eight_point(pairs.points1, pairs.points2, weights)
            distance = kln.symmetric_epipolar_distance(pairs.points1, pairs.points2, F_mat.detach())
            extra = [(distance + 0.1).log(), weights.detach()]
            results.append((logits, F_mat))
        return results


def make_normalizer(name: str) -> nn.Module:
    """Return one of the normalisers to compare."""
    if name == "hartley":
        return kln.Hartley()
    if name == "whitening":
        return kln.Whitening()
    # Starts exactly as Hartley's.
    return kln.LearnedNormalizer(kln.Hartley(), kln.CrossViewNetwork(width=32, depth=2))


NORMALIZERS = ["hartley", "whitening", "learned"]


def loss(results: list[tuple[Tensor, Tensor]], batch: Pairs, whole: Pairs) -> Tensor:
    """Return the mean log error over all inliers of the pairs, plus the cross-entropy of the batch's own."""
    with torch.no_grad():
        inliers = kln.symmetric_epipolar_distance(batch.points1, batch.points2, batch.F_mat) < INLIER
    total = torch.zeros(())
    for logits, F_mat in results:
        error = (whole.error(F_mat, bound=100.0) + FLOOR).log().mean()
        total = total + error + 0.3 * binary_cross_entropy_with_logits(logits, inliers.to(logits))
    return total


def train(estimator: Estimator, training: Pairs, options: Namespace, seed: int, last: bool = False) -> None:
    """Train the network and what is trained of the normaliser."""
    steps, rate = (options.last_steps, options.rate / 2) if last else (options.steps, options.rate)
    generator = Generator().manual_seed(seed)
    parameters = [p for p in estimator.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(parameters, rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, max(steps, 2), pct_start=0.1)
    start = perf_counter()
    for step in range(1, steps + 1):
        whole = training.draw(options.pairs, training.feature.shape[1], generator)
        batch = whole.select(slice(options.points))
        value = loss(estimator(batch), batch, whole)
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        if step == 1 or step % max(1, steps // 5) == 0:
            print(f"step {step:4d}: loss {value.item():6.3f}, {perf_counter() - start:4.0f} s", flush=True)


def evaluate(estimator: Estimator, pairs: Pairs, num_points: int) -> tuple[float, float, float]:
    """Return mean F1 at 1 and at 0.1 px in percent, and the mean epipolar error in pixels.

    The matches of a pair make as many samples of ``num_points`` as they can, up to 16; each is measured on all matches.
    """
    rows = []
    for start in range(0, pairs.feature.shape[1] - num_points + 1, num_points)[:16]:
        with torch.no_grad():
            F_mat = estimator(pairs.select(slice(start, start + num_points)))[-1][1]
        known = pairs.points1, pairs.points2, F_mat, pairs.F_mat
        scores = [100 * kln.f1_score(*known, threshold=threshold) for threshold in (1.0, 0.1)]
        rows.append(torch.stack([*scores, kln.epipolar_error(*known)]).nanmean(-1))
    f1, f1_fine, error = torch.stack(rows).mean(0).tolist()
    return f1, f1_fine, error


def main(args: Sequence[str] | None = None) -> dict[str, list[tuple[float, float, float]]]:
    """Train and evaluate each normaliser with each seed; return the results by normaliser."""
    options = parse(args)
    training, held_out = load_pairs("00", "01", "03", num_points=960, num_held_out=1500)
    results: dict[str, list[tuple[float, float, float]]] = {name: [] for name in options.normalizers}
    for seed in options.seeds:
        torch.manual_seed(seed)
        start = Estimator(kln.Hartley())
        train(start, training, options, seed)
        for name in options.normalizers:
            estimator = deepcopy(start)
            estimator.eight_point = kln.EightPoint(make_normalizer(name))
            train(estimator, training, options, seed, last=True)
            results[name].append(evaluate(estimator, held_out, options.points))
            print(format_row(f"{name}, seed {seed}", *results[name][-1]), flush=True)
    for name, rows in results.items():
        print(format_row(f"{name}, mean of {len(rows)}", *torch.tensor(rows).mean(0).tolist()))
    return results


def format_row(name: str, f1: float, f1_fine: float, error: float) -> str:
    """Return a line of text."""
    return f"{name:28} F1 at 1 px {f1:5.2f} %, at 0.1 px {f1_fine:5.2f} %, epipolar error {error:.3f} px"


def parse(args: Sequence[str] | None) -> Namespace:
    """Return the options."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--normalizers", nargs="+", choices=NORMALIZERS, default=NORMALIZERS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=600, help="with Hartley's normalisation")
    parser.add_argument("--last-steps", type=int, default=200, help="with each normalisation")
    parser.add_argument("--rate", type=float, default=2e-3, help="largest learning rate")
    parser.add_argument("--pairs", type=int, default=16, help="image pairs per step")
    parser.add_argument("--points", type=int, default=64, help="matches of a pair that the estimator sees")
    return parser.parse_args(args)


if __name__ == "__main__":
    main()

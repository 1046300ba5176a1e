"""The layer in ``kornia.geometry.RANSAC``, beside what this package's RANSAC makes of the same normalisation.

Kornia's RANSAC keeps its solvers as attributes. With ``local_optimization="dlt"`` it calls them, for minimal samples
and for refits; in its default, ``"lm"``, it does not.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence

import torch
from kornia.geometry import RANSAC
from pair_data import Pairs, load_pairs
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.metrics.inliers import epipolar_error, f1_score
from kornia_learnnorm.normalizers.normalizer import Normalizer

Estimator = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def kornia_ransac(normalizer: Normalizer | None = None, max_samples: int = 1000, seed: int = 0) -> RANSAC:
    """Return Kornia's RANSAC of samples of eight; its solver is the layer where a normaliser is given."""
    ransac = RANSAC("fundamental_8pt", inl_th=1.0, max_samples=max_samples, seed=seed, local_optimization="dlt")
    if normalizer is not None:
        ransac.minimal_solver = ransac.polisher_solver = kln.EightPoint(normalizer)
    return ransac


def evaluate(estimator: Estimator, pairs: Pairs) -> tuple[float, float]:
    """Return mean F1 at 1 px in percent and the mean epipolar error in pixels."""
    found = [estimator(points1, points2)[0] for points1, points2 in zip(pairs.points1, pairs.points2, strict=True)]
    known = pairs.points1, pairs.points2, torch.stack(found), pairs.F_mat
    return 100 * f1_score(*known, threshold=1.0).nanmean().item(), epipolar_error(*known).nanmean().item()


def main(args: Sequence[str] | None = None) -> dict[str, tuple[float, float]]:
    """Return F1 and epipolar error by estimator, on the pairs held out."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000, help="minimal samples per pair, at most")
    parser.add_argument("--pairs", type=int, default=51)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(args)
    pairs = Pairs(*(value[: options.pairs] for value in load_pairs(num_held_out=1500)[1]))
    learned, samples, seed = kln.LearnedNormalizer.from_pretrained(), options.samples, options.seed
    default = RANSAC("fundamental_8pt", inl_th=1.0, max_samples=samples, seed=seed)
    estimators: dict[str, Estimator] = {
        "Kornia, dlt": kornia_ransac(None, samples, seed),
        "Kornia, dlt, Hartley layer": kornia_ransac(kln.Hartley(), samples, seed),
        "Kornia, dlt, whitening layer": kornia_ransac(kln.Whitening(), samples, seed),
        "Kornia, dlt, learned layer": kornia_ransac(learned, samples, seed),
        "Kornia, lm (its default)": default,
        "kornia_learnnorm.RANSAC, learned": kln.RANSAC(learned, max_samples=samples, seed=seed),
        "kornia_learnnorm.RANSAC": kln.RANSAC(max_samples=samples, seed=seed),
    }
    results = {}
    for name, estimator in estimators.items():
        with torch.no_grad():
            results[name] = evaluate(estimator, pairs)
        print(f"{name:34} F1 {results[name][0]:5.2f} %, epipolar error {results[name][1]:.3f} px", flush=True)
    return results


if __name__ == "__main__":
    main()

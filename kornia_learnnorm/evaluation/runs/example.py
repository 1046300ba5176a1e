"""One random image pair of a run: its matches, and the errors of samples of growing size from it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.methods import Method
from kornia_learnnorm.evaluation.runs.predict import ground_truth_inliers, median_distance, pair_matches
from kornia_learnnorm.evaluation.runs.results_store import Arrays
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.median import median
from kornia_learnnorm.protocol import RATIO

# Arrays in the files.
EXAMPLE = ("store", "pair", "names", "points1", "points2", "truth", "F", "size")
SWEEP = ("size", "own", "truth")
SIZES = (8, 9, 10, 12, 16, 24, 32, 64, 128, 256)  # correspondences in a sample
TRIALS = 1000  # samples of each size


def random_pair(stores: Mapping[str, CorrespondenceStore], seed: int) -> Arrays:
    """Return a random pair of the first store, among those with enough matches and a ground truth.

    ``points1`` and ``points2`` (M, 2), pixels, are the matches that pass the ratio test; ``truth`` are some of the
    ground-truth inliers (x1, y1, x2, y2), padded with NaN; ``F`` is the true matrix and ``size`` (width, height) of
    both images.
    """
    name, store = next(iter(stores.items()))
    truth = ground_truth_inliers(store)
    passing = [len(store.rows(pair, RATIO)) for pair in range(len(store))]
    suitable = np.flatnonzero((np.array(passing) >= SIZES[-1]) & truth.isfinite().any(-1).any(-1).numpy())
    if len(suitable) == 0:
        raise ValueError(f"no pair of {name} has {SIZES[-1]} matches that pass the ratio test and a ground truth")
    pair = int(np.random.default_rng(seed).choice(suitable))
    points1, points2 = pair_matches(store, pair, RATIO)
    names, F_mat, size = store.names[pair], store.F[pair], store.image_size[pair]
    values = (name, pair, names, points1.numpy(), points2.numpy(), truth[pair].numpy(), F_mat, size)
    return {key: np.array(value) for key, value in zip(EXAMPLE, values, strict=True)}


@torch.no_grad()
def sweep(method: Method, example: Arrays, seed: int) -> Arrays:
    """Return the median errors of random samples of growing ``size`` from the pair of :func:`random_pair`.

    ``own`` is the median over samples of the mean distance of a sample's points, ``truth`` that of the median distance
    of the ground-truth inliers, pixels.
    """
    points1, points2, truth = (torch.from_numpy(example[key]) for key in ("points1", "points2", "truth"))
    generator = torch.Generator().manual_seed(seed)
    own, accuracy = [], []
    for size in SIZES:
        rows = torch.rand(TRIALS, len(points1), generator=generator).argsort(-1)[:, :size]
        F_mat = method.estimate(points1[rows], points2[rows])
        own.append(median(symmetric_epipolar_distance(points1[rows], points2[rows], F_mat).mean(-1)))
        accuracy.append(median(median_distance(truth.expand(TRIALS, -1, -1), F_mat)))
    return {"size": np.array(SIZES), "own": torch.stack(own).numpy(), "truth": torch.stack(accuracy).numpy()}

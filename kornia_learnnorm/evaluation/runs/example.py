"""One image pair of a run, taken at random: its correspondences, and errors by the number of them in a sample."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.methods import Method
from kornia_learnnorm.evaluation.predict import ground_truth_inliers
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance

__all__ = ["median_distance", "random_pair", "sweep"]

SIZES = (8, 9, 10, 12, 16, 24, 32, 64, 128, 256)
TRIALS = 1000

Arrays = dict[str, NDArray[Any]]


def random_pair(stores: Mapping[str, CorrespondenceStore], seed: int) -> Arrays:
    """Choose a pair of the first store that has enough matches.

    Args:
        stores: stores by name.
        seed: seed of the choice.

    Returns:
        ``store``, its name; ``pair``, its index, and ``names``; ``points1`` and ``points2``, the matches that pass the
        ratio test, pixels, (M, 2); ``truth``, some of its ground-truth inliers (x1, y1, x2, y2), padded with NaN;
        ``F``, the true matrix (3, 3); ``size``, (width, height) of both images.

    Raises:
        ValueError: if no pair has enough matches and ground truth.

    """
    name, store = next(iter(stores.items()))
    truth = ground_truth_inliers(store)
    passing = np.add.reduceat(store.ratio < RATIO, store.offsets[:-1])
    fit = np.flatnonzero((passing >= SIZES[-1]) & truth.isfinite().any(-1).any(-1).numpy())
    if len(fit) == 0:
        raise ValueError(f"no pair has {SIZES[-1]} matches that pass the ratio test and a ground truth")
    pair = int(np.random.default_rng(seed).choice(fit))
    rows = np.arange(store.offsets[pair], store.offsets[pair + 1])
    rows = rows[store.ratio[rows] < RATIO]
    return {
        "store": np.array(name),
        "pair": np.array(pair),
        "names": np.array(store.names[pair]),
        "points1": store.points1[rows].astype(float),
        "points2": store.points2[rows].astype(float),
        "truth": truth[pair].numpy(),
        "F": store.F[pair],
        "size": store.image_size[pair],
    }


@torch.no_grad()
def sweep(method: Method, example: Arrays, seed: int) -> Arrays:
    """Measure median errors of random samples of growing size from one pair.

    Args:
        method: what solves the samples.
        example: the pair, from :func:`random_pair`.
        seed: seed of the samples.

    Returns:
        ``size``, correspondences in a sample; ``own``, median over samples of the mean distance of a sample's points;
        ``truth``, that of the ground-truth inliers, pixels.

    """
    points1, points2, truth = (torch.from_numpy(example[key]) for key in ("points1", "points2", "truth"))
    generator = torch.Generator().manual_seed(seed)
    own, accuracy = [], []
    for size in SIZES:
        rows = torch.rand(TRIALS, len(points1), generator=generator).argsort(-1)[:, :size]
        F_mat = method.estimate(points1[rows], points2[rows])
        own.append(symmetric_epipolar_distance(points1[rows], points2[rows], F_mat).mean(-1).nanmedian())
        accuracy.append(median_distance(truth.expand(TRIALS, -1, -1), F_mat).nanmedian())
    return {"size": np.array(SIZES), "own": torch.stack(own).numpy(), "truth": torch.stack(accuracy).numpy()}


def median_distance(points: Tensor, F_mat: Tensor) -> Tensor:
    """Return the median symmetric epipolar distance of each set of (x1, y1, x2, y2).

    Args:
        points: correspondences with shape (S, N, 4), pixels; rows of NaN are left out.
        F_mat: matrices with shape (S, 3, 3).

    Returns:
        medians with shape (S,), pixels; NaN where a set is empty.

    """
    known = points.nan_to_num()
    distance = symmetric_epipolar_distance(known[..., :2], known[..., 2:], F_mat)
    distance[points.isnan().any(-1)] = torch.nan
    return distance.nanmedian(-1).values

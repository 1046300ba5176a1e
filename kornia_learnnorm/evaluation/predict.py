"""Run normalisers over the samples of a store and keep their residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.samples import RATIO, Samples
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.estimators.fundamental import find_fundamental
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance

__all__ = ["Residuals", "evaluate_normalizers", "ground_truth_inliers"]

Normalizer = Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]]


class Residuals(NamedTuple):
    """One method's residuals on a set of samples, pixels.

    Attributes:
        own: mean symmetric epipolar distance of each sample's own points, (S,).
        ground_truth: median symmetric epipolar distance of the ground-truth inliers of each sample's pair, (S,); NaN
            where the pair has no ground truth or too few inliers.
    """

    own: Tensor
    ground_truth: Tensor


def evaluate_normalizers(
    samples: Samples, store: CorrespondenceStore, normalizers: Mapping[str, Normalizer], batch_size: int = 4096
) -> dict[str, Residuals]:
    """Solve every sample with every normaliser.

    Args:
        samples: samples of the store.
        store: where the samples come from.
        normalizers: normalisers by name.
        batch_size: samples solved at once.

    Returns:
        residuals by name, in the order of the normalisers.

    """
    inliers = ground_truth_inliers(store)
    return {name: _evaluate(samples, inliers, normalizer, batch_size) for name, normalizer in normalizers.items()}


@torch.no_grad()
def _evaluate(samples: Samples, inliers: Tensor, normalizer: Normalizer, batch_size: int) -> Residuals:
    own, ground_truth = [], []
    for rows in torch.split(torch.arange(len(samples.pair)), batch_size):
        x1, x2 = samples.points1[rows].double(), samples.points2[rows].double()
        F_mat = find_fundamental(x1, x2, normalizer=normalizer)
        own.append(symmetric_epipolar_distance(x1, x2, F_mat).mean(-1))
        truth = inliers[samples.pair[rows]]
        distance = symmetric_epipolar_distance(truth[..., :2].nan_to_num(), truth[..., 2:].nan_to_num(), F_mat)
        distance[truth.isnan().any(-1)] = torch.nan
        ground_truth.append(distance.nanmedian(-1).values)
    return Residuals(torch.cat(own), torch.cat(ground_truth))


def ground_truth_inliers(
    store: CorrespondenceStore, threshold: float = 1.0, at_least: int = 16, at_most: int = 200
) -> Tensor:
    """Collect each pair's matches that pass the ratio test and lie near their ground-truth epipolar lines.

    Args:
        store: correspondences of image pairs.
        threshold: largest symmetric epipolar distance under the ground truth, pixels.
        at_least: pairs with fewer inliers get none.
        at_most: inliers kept of a pair, the first in the store's random order.

    Returns:
        points (x1, y1, x2, y2) with shape (P, at_most, 4), float64, padded with NaN.

    """
    result = torch.full((len(store), at_most, 4), torch.nan, dtype=torch.float64)
    for pair, (start, end) in enumerate(zip(store.offsets[:-1], store.offsets[1:], strict=True)):
        F_mat = torch.from_numpy(store.F[pair])
        if not bool(torch.isfinite(F_mat).all()):
            continue
        passes = torch.from_numpy(store.ratio[start:end]) < RATIO
        x1 = torch.from_numpy(store.points1[start:end])[passes].double()
        x2 = torch.from_numpy(store.points2[start:end])[passes].double()
        near = symmetric_epipolar_distance(x1, x2, F_mat) < threshold
        points = torch.cat([x1, x2], -1)[near][:at_most]
        if len(points) >= at_least:
            result[pair, : len(points)] = points
    return result

"""What a run keeps of samples and of each method's matrices of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.samples import Samples, draw_samples, plain_residual
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.diagnostics import diagnose
from kornia_learnnorm.evaluation.methods import Method
from kornia_learnnorm.evaluation.predict import ground_truth_inliers
from kornia_learnnorm.evaluation.runs.consensus import consensus
from kornia_learnnorm.evaluation.runs.example import median_distance
from kornia_learnnorm.evaluation.runs.run import check_limit
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import rotation_error, translation_error
from kornia_learnnorm.normalizers.contract import normalizing_transforms

__all__ = ["describe", "draw", "predict"]

HELDOUT = 16
BATCH = 2048

Arrays = dict[str, NDArray[Any]]


def draw(store: CorrespondenceStore, ratio: float | None, seed: int, max_samples: int | None) -> Samples:
    """Draw the samples of a store.

    Args:
        store: correspondences.
        ratio: only those with Lowe's ratio below; None for all.
        seed: seed of the shuffle.
        max_samples: at most so many samples, at random; None for all.

    Raises:
        ValueError: if no pair fills a sample.

    """
    generator = torch.Generator().manual_seed(seed)
    samples = draw_samples(store, generator, 8, ratio, HELDOUT)
    if max_samples is None or len(samples.pair) <= max_samples:
        return samples
    return samples.select(torch.randperm(len(samples.pair), generator=generator)[:max_samples].sort().values)


def describe(samples: Samples, place: Path) -> Arrays:
    """Return each sample's image pair and its un-normalised residual.

    Args:
        samples: all that were drawn.
        place: whose samples they are, for the message.

    Raises:
        ValueError: if none has a residual within the limit.

    """
    residual = plain_residual(samples.points1, samples.points2).numpy()
    check_limit(residual, place)
    return {"pair": samples.pair.numpy(), "plain_residual": residual}


@torch.no_grad()
def predict(method: Method, samples: Samples, store: CorrespondenceStore, max_ratio: float | None) -> Arrays:
    """Return everything that a report shows of a method's samples.

    Args:
        method: what solves them.
        samples: those within the limit.
        store: where they come from.
        max_ratio: only matches with Lowe's ratio below count for the shares of inliers; None for all.

    Raises:
        ValueError: if the method's normaliser fails.

    """
    truth = ground_truth_inliers(store)
    parts = [
        _predict_batch(method, samples.select(rows), store, truth)
        for rows in torch.split(torch.arange(len(samples.pair)), BATCH)
    ]
    found = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    found |= consensus(found["F_mat"], samples.pair, store, max_ratio)
    return {key: value.numpy() for key, value in found.items()}


def _predict_batch(method: Method, samples: Samples, store: CorrespondenceStore, truth: Tensor) -> dict[str, Tensor]:
    x1, x2 = samples.points1.double(), samples.points2.double()
    transforms = normalizing_transforms(method.normalizer, x1, x2, None)  # once: the searched optimum takes its time

    def known(*_: Tensor | None) -> tuple[Tensor, Tensor]:
        return transforms

    F_mat = method.solve(x1, x2, known)
    inside = diagnose(x1, x2, known)
    K, R, t = (torch.from_numpy(part)[samples.pair] for part in (store.K, store.R, store.t))
    found = relative_pose(F_mat, K[:, 0], K[:, 1], x1, x2)
    return {
        "F_mat": F_mat,
        "own": symmetric_epipolar_distance(x1, x2, F_mat).mean(-1),
        "heldout": median_distance(torch.cat([samples.heldout1, samples.heldout2], -1).double(), F_mat),
        "truth": median_distance(truth[samples.pair], F_mat),
        "condition_number": inside.condition_number,
        "rho": inside.singularity_ratio,
        "distance1": inside.distance1,
        "distance2": inside.distance2,
        "rotation_error": rotation_error(found[0], R),
        "translation_error": translation_error(found[1], t),
    }

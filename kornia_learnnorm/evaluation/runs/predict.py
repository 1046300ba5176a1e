"""The samples of a run, and what it keeps of each method's matrices of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_learnnorm.data.samples import Samples, draw_samples
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.diagnostics import diagnose_in_coordinates
from kornia_learnnorm.evaluation.methods import Method
from kornia_learnnorm.evaluation.runs.arrays import Arrays
from kornia_learnnorm.evaluation.runs.consensus import consensus
from kornia_learnnorm.evaluation.runs.pairs import ground_truth_inliers, median_distance
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.metrics.poses import rotation_error, translation_error
from kornia_learnnorm.normalizers.contract import normalizing_transforms
from kornia_learnnorm.protocol import MAX_RESIDUAL

__all__ = ["AGREEMENT", "ERRORS", "SampleOptions", "predict"]

# What a run keeps of each sample, by name.
ERRORS = (
    *("F_mat", "own", "heldout", "truth", "rotation_error", "translation_error"),
    *("condition_number", "rho", "distance1", "distance2", "rank2_share"),
)
AGREEMENT = ("inliers", "f1")  # takes longer than all others together
NUM_HELDOUT = 16  # held-out matches of a sample
BATCH_SIZE = 2048  # samples solved at once


@dataclass(frozen=True)
class SampleOptions:
    """How the samples of a run are drawn.

    Attributes:
        size: correspondences in a sample.
        seed: seed of the shuffle.
        max_samples: at most so many samples of each store and protocol, at random; None for all.
        max_residual: samples whose residual under the un-normalised eight-point algorithm is this or larger are left
            out, pixels.

    Raises:
        ValueError: if the size is below 8 or ``max_samples`` is not positive.
    """

    size: int = 8
    seed: int = 0
    max_samples: int | None = 16000
    max_residual: float = MAX_RESIDUAL

    def __post_init__(self) -> None:
        if self.size < 8:
            raise ValueError(f"a sample needs at least 8 correspondences, got size={self.size}")
        if self.max_samples is not None and self.max_samples < 1:
            raise ValueError(f"max_samples must be 1 or more, or None for all, got {self.max_samples}")

    def draw(self, store: CorrespondenceStore, max_ratio: float | None) -> Samples:
        """Return samples of a store, before the filter on the residual.

        The held-out points are NaN for the samples of pairs that have no match to hold out.

        Args:
            store: correspondences.
            max_ratio: only those with Lowe's ratio below; None for all.

        Raises:
            ValueError: if no pair fills a sample.

        """
        generator = torch.Generator().manual_seed(self.seed)
        samples = draw_samples(store, generator, self.size, max_ratio, NUM_HELDOUT, require_heldout=False)
        if self.max_samples is None or len(samples.pair) <= self.max_samples:
            return samples
        order = torch.randperm(len(samples.pair), generator=generator)
        return samples.select(order[: self.max_samples].sort().values)


@torch.no_grad()
def predict(
    method: Method, samples: Samples, store: CorrespondenceStore, max_ratio: float | None, agreement: bool = True
) -> Arrays:
    """Return a method's matrices of samples, their errors and diagnostics.

    Args:
        method: what solves them.
        samples: samples of the store.
        store: where they come from.
        max_ratio: only matches with Lowe's ratio below count for the shares of inliers; None for all.
        agreement: compute the shares of inliers and F1 too.

    Returns:
        arrays (S, ...) by the names in :data:`ERRORS`, and in :data:`AGREEMENT` where wanted.

    Raises:
        ValueError: if the method's normaliser fails.

    """
    truth = ground_truth_inliers(store)
    parts = [
        _predict_batch(method, samples.select(rows), store, truth)
        for rows in torch.split(torch.arange(len(samples.pair)), BATCH_SIZE)
    ]
    found = {key: torch.cat([part[key] for part in parts]) for key in ERRORS}
    if agreement:
        found |= consensus(found["F_mat"], samples.pair, store, max_ratio)
    return {key: value.numpy() for key, value in found.items()}


def _predict_batch(method: Method, samples: Samples, store: CorrespondenceStore, truth: Tensor) -> dict[str, Tensor]:
    problem = LinearProblem.from_points(samples.points1, samples.points2)
    x1, x2 = problem.points1, problem.points2
    T1, T2 = normalizing_transforms(method.normalizer, problem)
    F_mat, inside = method.solve(problem, T1, T2), diagnose_in_coordinates(problem, T1, T2)
    K, R, t = (torch.from_numpy(part)[samples.pair] for part in (store.K, store.R, store.t))
    found = relative_pose(F_mat, K[:, 0], K[:, 1], x1, x2)
    return {
        "F_mat": F_mat,
        "own": symmetric_epipolar_distance(x1, x2, F_mat).mean(-1),
        "heldout": median_distance(torch.cat([samples.heldout1, samples.heldout2], -1).double(), F_mat),
        "truth": median_distance(truth[samples.pair], F_mat),
        "rotation_error": rotation_error(found[0], R),
        "translation_error": translation_error(found[1], t),
        "condition_number": inside.condition_number,
        "rho": inside.singularity_ratio,
        "distance1": inside.distance1,
        "distance2": inside.distance2,
        "rank2_share": inside.rank2_share,
    }

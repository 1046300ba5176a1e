"""The samples of a run, what it keeps of each method's matrices of them, and matches of image pairs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_learnnorm.data.sets import MatchSets, draw_samples
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.diagnostics import diagnose_in_coordinates
from kornia_learnnorm.evaluation.methods import Method
from kornia_learnnorm.evaluation.runs.results_store import Arrays
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.metrics.inliers import f1_from_masks, finite_distance
from kornia_learnnorm.metrics.median import median
from kornia_learnnorm.metrics.poses import rotation_error, translation_error
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.normalizers.normalizer import normalizing_transforms
from kornia_learnnorm.protocol import INLIER_THRESHOLD, MAX_RESIDUAL, RATIO, THRESHOLDS

# What a run keeps of each sample, by name.
DIAGNOSTICS = ("condition_number", "rho", "distance1", "distance2", "rank2_share")  # in the order of Diagnostics
ERRORS = ("F_mat", "own", "heldout", "truth", "rotation_error", "translation_error", *DIAGNOSTICS)
AGREEMENT = ("inliers", "f1")  # takes longer than all others together
NUM_HELDOUT = 16  # held-out matches of a sample
BATCH_SIZE = 2048  # samples solved at once
MIN_INLIERS = 16  # a pair with fewer has no ground-truth inliers to measure with
MAX_INLIERS = 200  # of a pair, the first in the store's random order


@dataclass(frozen=True)
class SampleOptions:
    """How the samples of a run are drawn."""

    size: int = 8  # correspondences in a sample
    seed: int = 0  # of the shuffle
    max_samples: int | None = 16000  # at most so many samples of each store and protocol, at random; None for all
    max_residual: float = MAX_RESIDUAL  # pixels; samples with a larger residual without normalisation are left out

    def __post_init__(self) -> None:
        if self.size < 8:
            raise ValueError(f"a sample needs at least 8 correspondences, got size={self.size}")
        if self.max_samples is not None and self.max_samples < 1:
            raise ValueError(f"max_samples must be 1 or more, or None for all, got {self.max_samples}")

    def draw(self, store: CorrespondenceStore, max_ratio: float | None) -> MatchSets:
        """Return samples before the filter on the residual; held-out points of pairs without any are NaN."""
        generator = torch.Generator().manual_seed(self.seed)
        samples = draw_samples(store, generator, self.size, max_ratio, NUM_HELDOUT, require_heldout=False)
        if self.max_samples is None or len(samples.pair) <= self.max_samples:
            return samples
        order = torch.randperm(len(samples.pair), generator=generator)
        return samples.select(order[: self.max_samples].sort().values)


@torch.no_grad()
def predict(
    method: Method, samples: MatchSets, store: CorrespondenceStore, max_ratio: float | None, agreement: bool = True
) -> Arrays:
    """Return a method's matrices of the samples of a store, their errors and diagnostics, arrays (S, ...).

    They are named as in ``ERRORS``, and ``AGREEMENT`` where wanted, on matches with Lowe's ratio below ``max_ratio``.
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


def _predict_batch(method: Method, samples: MatchSets, store: CorrespondenceStore, truth: Tensor) -> dict[str, Tensor]:
    problem = LinearProblem.from_points(samples.points1, samples.points2, None, Fundamental())
    x1, x2 = problem.points1, problem.points2
    T1, T2 = normalizing_transforms(method.normalizer, problem)
    F_mat = method.solve(problem, T1, T2)
    K, R, t = (torch.from_numpy(part)[samples.pair] for part in (store.K, store.R, store.t))
    found = relative_pose(F_mat, K[:, 0], K[:, 1], x1, x2)
    return {
        "F_mat": F_mat,
        "own": symmetric_epipolar_distance(x1, x2, F_mat).mean(-1),
        "heldout": median_distance(torch.cat([samples.heldout1, samples.heldout2], -1).double(), F_mat),
        "truth": median_distance(truth[samples.pair], F_mat),
        "rotation_error": rotation_error(found[0], R),
        "translation_error": translation_error(found[1], t),
        **dict(zip(DIAGNOSTICS, diagnose_in_coordinates(problem, T1, T2), strict=True)),
    }


def consensus(F_mat: Tensor, pair: Tensor, store: CorrespondenceStore, max_ratio: float | None) -> dict[str, Tensor]:
    """Return ``inliers``, a share, and ``f1``, (S, thresholds), of matrices (S, 3, 3) on all matches of their pairs.

    F1 is NaN where the ground truth has no inliers.
    """
    inliers = F_mat.new_full((len(F_mat), len(THRESHOLDS)), torch.nan)
    f1 = inliers.clone()
    for index in torch.unique(pair).tolist():
        rows = torch.nonzero(pair == index).flatten()
        points1, points2 = pair_matches(store, index, max_ratio)
        true = _within(points1[None], points2[None], torch.from_numpy(store.F[index : index + 1]))
        number = len(rows), -1, -1
        found = _within(points1.expand(*number), points2.expand(*number), F_mat[rows])
        inliers[rows] = found.double().mean(-1)
        f1[rows] = f1_from_masks(found, true)
    return {"inliers": inliers, "f1": f1}


def _within(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    """Return which points lie within each threshold, (S, thresholds, N); none do under a matrix of NaN."""
    distance = finite_distance(points1, points2, F_mat)
    return distance[:, None] < distance.new_tensor(THRESHOLDS)[:, None]


def pair_matches(store: CorrespondenceStore, pair: int, max_ratio: float | None) -> tuple[Tensor, Tensor]:
    """Return the matches of an image pair in both views below Lowe's ratio, pixels, (M, 2) float64 each."""
    points1, points2, _ = store.matches(pair, max_ratio)
    return torch.from_numpy(points1).double(), torch.from_numpy(points2).double()


def ground_truth_inliers(store: CorrespondenceStore) -> Tensor:
    """Return each pair's matches that pass the ratio test and lie within 1 px of their ground-truth epipolar lines.

    They are points (x1, y1, x2, y2), (P, 200, 4) float64, padded with NaN; all NaN for a pair with fewer than 16.
    """
    result = torch.full((len(store), MAX_INLIERS, 4), torch.nan, dtype=torch.float64)
    for pair, F_mat in enumerate(torch.from_numpy(store.F)):
        x1, x2 = pair_matches(store, pair, RATIO)
        near = symmetric_epipolar_distance(x1, x2, F_mat) < INLIER_THRESHOLD  # none if F_mat is NaN, not known
        points = torch.cat([x1, x2], -1)[near][:MAX_INLIERS]
        if len(points) >= MIN_INLIERS:
            result[pair, : len(points)] = points
    return result


def median_distance(points: Tensor, F_mat: Tensor) -> Tensor:
    """Return the median symmetric epipolar distance (S,) of sets (S, N, 4), pixels; rows of NaN are left out."""
    known = points.nan_to_num()
    distance = symmetric_epipolar_distance(known[..., :2], known[..., 2:], F_mat)
    distance[points.isnan().any(-1)] = torch.nan
    return median(distance)

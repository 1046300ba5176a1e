r"""Metrics of an estimated fundamental matrix, one number per image pair: F1 score and epipolar error.

All distances are symmetric epipolar distances in pixels, the sum :math:`d_1 + d_2` of both points' distances to their
epipolar lines; other packages take the larger of the two or their mean. A failed estimate (NaN or zero matrix) has no
inliers and an infinite error. NaN is not a failure: the pair cannot be measured. The evaluation of NG-RANSAC drops a
pair from all three metrics when the ground truth has no inliers at the threshold or none below 1 px.

Reference:
    R. Ranftl, V. Koltun, Deep Fundamental Matrix Estimation, ECCV 2018, as evaluated by E. Brachmann, C. Rother,
    Neural-Guided RANSAC, ICCV 2019.
"""

from math import inf

import torch
from torch import Tensor

from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance


def f1_score(points1: Tensor, points2: Tensor, F_mat: Tensor, F_true: Tensor, threshold: float) -> Tensor:
    r"""Return the harmonic mean of precision and recall between the inliers of an estimate and of the ground truth.

    :math:`2 |A \cap B| / (|A| + |B|)` with :math:`A = \{i : d_i(F) < \tau\}` and the same :math:`B` of the true matrix
    ``F_true`` :math:`(*, 3, 3)`; NaN where the ground truth has no inliers. Points are pixels :math:`(*, N, 2)`, the
    estimates ``F_mat`` :math:`(*, 3, 3)` of any scale, the threshold :math:`\tau` symmetric epipolar distances, pixels.
    Errors are those of :func:`~kornia_learnnorm.symmetric_epipolar_distance`, and a ValueError for a threshold that is
    not positive.
    """
    masks = (_inliers(points1, points2, matrix, threshold) for matrix in (F_mat, F_true))
    return f1_from_masks(*masks).to(points1.dtype)


def f1_from_masks(inliers: Tensor, true: Tensor) -> Tensor:
    """Return the F1 score, float64, of masks (..., N) of inliers against the true ones; NaN where none is true."""
    both, either = (inliers & true).sum(-1).double(), inliers.sum(-1) + true.sum(-1)
    return torch.where(true.any(-1), 2 * both / either, torch.nan)


def epipolar_error(points1: Tensor, points2: Tensor, F_mat: Tensor, F_true: Tensor, threshold: float = 1.0) -> Tensor:
    r"""Return the mean symmetric epipolar distance of the ground truth's inliers under an estimate, in pixels.

    :math:`\frac{1}{|B|} \sum_{i \in B} d_i(F)` with :math:`B = \{i : d_i(F_{true}) < \tau\}`, whatever threshold the
    other metrics are taken at. The arguments and errors are those of :func:`f1_score`. The errors, :math:`(*)`, are
    infinite for a failed estimate and NaN where the ground truth has no inliers.
    """
    true = _inliers(points1, points2, F_true, threshold)
    return torch.where(true, finite_distance(points1, points2, F_mat), 0.0).sum(-1) / true.sum(-1)


def finite_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    """Return the symmetric epipolar distances (..., N), pixels, infinite under a matrix of NaN."""
    return symmetric_epipolar_distance(points1, points2, F_mat).nan_to_num(nan=inf, posinf=inf)


def _inliers(points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float) -> Tensor:
    if not threshold > 0:
        raise ValueError(f"threshold must be positive, got {threshold}")
    return finite_distance(points1, points2, F_mat) < threshold

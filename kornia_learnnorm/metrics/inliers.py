r"""Metrics of an estimated fundamental matrix, one number per image pair: share of inliers, F1 score, epipolar error.

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

__all__ = ["epipolar_error", "f1_from_masks", "f1_score", "finite_distance", "inlier_share"]


def inlier_share(points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float) -> Tensor:
    r"""Return the share of correspondences that agree with an estimate: :math:`|\{i : d_i(F) < \tau\}| / N`, strict.

    Args:
        points1: pixels in the first images with shape :math:`(*, N, 2)`.
        points2: pixels in the second images with shape :math:`(*, N, 2)`.
        F_mat: estimated fundamental matrices with shape :math:`(*, 3, 3)`, any scale.
        threshold: symmetric epipolar distance :math:`\tau` that an inlier stays below, pixels.

    Returns:
        shares with shape :math:`(*)`; zero for a failed estimate, NaN for a pair without correspondences.

    Raises:
        TypeError: if a tensor is not floating-point or dtypes differ.
        ValueError: if a shape is wrong (ShapeError), the points do not pair up, or the threshold is not positive.

    Example:
        >>> F_mat = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # lines are rows
        >>> points1, points2 = torch.tensor([[5.0, 1.0], [5.0, 2.0]]), torch.tensor([[9.0, 1.25], [9.0, 3.0]])
        >>> inlier_share(points1, points2, F_mat, threshold=1.0)  # distances 0.5 and 2
        tensor(0.5000)
    """
    return _inliers(points1, points2, F_mat, threshold).to(points1.dtype).mean(-1)


def f1_score(points1: Tensor, points2: Tensor, F_mat: Tensor, F_true: Tensor, threshold: float) -> Tensor:
    r"""Return the harmonic mean of precision and recall between the inliers of an estimate and of the ground truth.

    :math:`2 |A \cap B| / (|A| + |B|)` with :math:`A = \{i : d_i(F) < \tau\}` and the same :math:`B` of the true matrix
    ``F_true`` :math:`(*, 3, 3)`; NaN where the ground truth has no inliers. Other arguments and errors are those of
    :func:`inlier_share`.
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

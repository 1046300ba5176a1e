"""Training losses: self-supervised on samples, without labels on matches with outliers, and with ground truth."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from kornia_learnnorm.geometry.checks import check_number_of_matrices, check_pairs, solve_dtype
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance

Residual = Callable[[Tensor, Tensor, Tensor], Tensor]  # distances (B, N) of points (B, N, 2) x 2 under (B, 3, 3)
Heldout = Tensor | None  # (B, M, 2)
MAX_DISTANCE = 1e4  # pixels; larger distances count as this and send no gradient


class EpipolarLoss(nn.Module):
    r"""Residuals on the sample's own points and on held-out points: the self-supervised loss of Fan et al.

    With ``log=False``, the mean residual of a sample is averaged over the batch (Fan et al., Eq. 8). With ``log=True``,
    the logarithm of this mean is averaged, so that a few bad samples do not dominate. For held-out residuals,
    the logarithm of each correspondence is averaged.

    Args:
        residual: maps ``(points1, points2, F_mat)`` to residuals :math:`(B, N)`, such as
            :func:`~kornia_learnnorm.symmetric_epipolar_distance` or :func:`~kornia_learnnorm.sampson_distance`.
        log: average the logarithm instead of the residual.
        heldout_weight: share of the held-out residuals in the loss, 0 to 1.
        floor: added to the residuals under the logarithm, in their unit.
        heldout_floor: floor of the held-out residuals, which rarely are far below a pixel.
        ceiling: residuals above this, also infinite ones, are clamped to it and send no gradient.

    ValueError if ``heldout_weight`` is outside 0 to 1, or a floor or the ceiling is not positive.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> points1, points2 = torch.zeros(1, 8, 2), torch.ones(1, 8, 2)
        >>> EpipolarLoss(log=False)(points1, points2, F_mat)
        tensor(2.)
    """

    def __init__(
        self,
        residual: Residual = symmetric_epipolar_distance,
        log: bool = True,
        heldout_weight: float = 0.0,
        floor: float = 1e-3,
        heldout_floor: float = 0.1,
        ceiling: float = MAX_DISTANCE,
    ) -> None:
        super().__init__()
        if not 0 <= heldout_weight <= 1:
            raise ValueError(f"heldout_weight must be in [0, 1], got {heldout_weight}")
        if not all(value > 0 for value in (floor, heldout_floor, ceiling)):
            raise ValueError(f"floors and ceiling must be positive, got {floor}, {heldout_floor} and {ceiling}")
        self.residual, self.log, self.heldout_weight = residual, log, heldout_weight
        self.floor, self.heldout_floor, self.ceiling = floor, heldout_floor, ceiling

    def extra_repr(self) -> str:
        """Return the parameters."""
        name = getattr(self.residual, "__name__", self.residual)
        return f"residual={name}, log={self.log}, heldout_weight={self.heldout_weight:g}, ceiling={self.ceiling:g}"

    def forward(
        self, points1: Tensor, points2: Tensor, F_mat: Tensor, heldout1: Heldout = None, heldout2: Heldout = None
    ) -> Tensor:
        """Return the loss, a scalar, of pixels (B, N, 2) and held-out ones (B, M, 2) under matrices (B, 3, 3).

        ValueError if there are no correspondences, or no held-out ones although ``heldout_weight`` is positive.
        """
        own = _distances(self.residual, points1, points2, F_mat, self.ceiling).mean(-1)
        loss = (own + self.floor).log().mean() if self.log else own.mean()
        if self.heldout_weight == 0:
            return loss.to(F_mat.dtype)
        if heldout1 is None or heldout2 is None or heldout1.shape[-2] == 0:
            raise ValueError(f"heldout_weight={self.heldout_weight} needs held-out correspondences, got none")
        rest = _distances(self.residual, heldout1, heldout2, F_mat, self.ceiling)
        heldout = (rest + self.heldout_floor).log().mean() if self.log else rest.mean()
        return ((1 - self.heldout_weight) * loss + self.heldout_weight * heldout).to(F_mat.dtype)


def _distances(residual: Residual, points1: Tensor, points2: Tensor, M: Tensor, most: float = MAX_DISTANCE) -> Tensor:
    check_pairs(points1, points2, ["B", "N", "2"])
    check_number_of_matrices("F_mat", M, len(points1))
    if points1.shape[1] == 0:
        raise ValueError("the mean distance needs a correspondence, got none")
    # In float64: next to an epipole, the square of a line's normal leaves the range of float32.
    return residual(*(value.to(solve_dtype(M.device)) for value in (points1, points2, M))).clamp(max=most)


class BoundedEpipolarLoss(nn.Module):
    r"""Mean of :math:`d^2 / (d^2 + s^2)` over matches with outliers, for training without labels.

    :math:`d` is the symmetric epipolar distance (Fan et al., Eq. 8). A match far from its lines costs at most one
    and has little gradient, so the matrix that explains most matches has the least loss.

    Args:
        scale: distance :math:`s` in pixels at which a match costs one half; ValueError unless positive.
        residual: another distance, such as :func:`~kornia_learnnorm.transfer_distance` of homographies.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> BoundedEpipolarLoss(2.0)(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 2.0]]]), F_mat)
        tensor([0.5000])
    """

    def __init__(self, scale: float = 2.0, residual: Residual = symmetric_epipolar_distance) -> None:
        super().__init__()
        if not scale > 0:
            raise ValueError(f"scale must be positive, got {scale}")
        self.scale, self.residual = scale, residual

    def forward(self, points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
        """Return the loss of each set, (B,), of one or more matches (B, M, 2) x 2 under matrices (B, 3, 3)."""
        squared = _distances(self.residual, points1, points2, F_mat).square()
        return (squared / (squared + self.scale**2)).mean(-1).to(F_mat.dtype)


class LogEpipolarLoss(nn.Module):
    r"""Mean of :math:`\log(d + f)` over true inliers, with the symmetric epipolar distance :math:`d`.

    Args:
        floor: distance :math:`f` in pixels; errors far below it hardly count. ValueError unless positive.
        residual: another distance, such as :func:`~kornia_learnnorm.transfer_distance` of homographies.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> LogEpipolarLoss(1.0)(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 1.0]]]), F_mat)
        tensor([0.])
    """

    def __init__(self, floor: float = 0.1, residual: Residual = symmetric_epipolar_distance) -> None:
        super().__init__()
        if not floor > 0:
            raise ValueError(f"floor must be positive, got {floor}")
        self.floor, self.residual = floor, residual

    def forward(self, points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
        """Return the loss of each set, (B,), of one or more correspondences (B, M, 2) x 2 under matrices (B, 3, 3)."""
        return (_distances(self.residual, points1, points2, F_mat) + self.floor).log().mean(-1).to(F_mat.dtype)


class LogEssentialLoss(nn.Module):
    r"""Logarithm of the chordal distance :math:`d` of essential matrices of unit norm, :math:`\log \sqrt{d^2 + f^2}`.

    The sign of the essential matrix that gives the smaller distance counts. For small errors :math:`d` is the angle in
    radians between the translations, or 0.7 to 1 times the angle between the rotations.

    Args:
        floor: distance :math:`f`; errors far below it hardly count. ValueError unless positive.

    Example:
        >>> E_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> LogEssentialLoss(1.0)(E_mat, -2 * E_mat)
        tensor([0.])
    """

    def __init__(self, floor: float = 0.003) -> None:
        super().__init__()
        if not floor > 0:
            raise ValueError(f"floor must be positive, got {floor}")
        self.floor = floor

    def forward(self, E_mat: Tensor, true: Tensor) -> Tensor:
        """Return the loss of each set, (B,), of essential matrices and the true ones, (B, 3, 3), of any scale."""
        E_mat, true = (M / torch.linalg.matrix_norm(M, keepdim=True) for M in (E_mat, true.to(E_mat)))
        # Squares, because a norm has no derivative at zero.
        squares = torch.stack([E_mat - true, E_mat + true]).square().sum((-1, -2)).amin(0)
        return ((squares + self.floor**2).sqrt()).log()


class InlierLoss(nn.Module):
    """Cross-entropy of inlier logits and labels; correspondences with a label of NaN are ignored.

    Example:
        >>> InlierLoss()(torch.tensor([[0.0, 9.0]]), torch.tensor([[1.0, torch.nan]]))
        tensor([0.6931])
    """

    def forward(self, logits: Tensor, inliers: Tensor) -> Tensor:
        """Return the loss of each set, (B,), of logits (B, N) and labels ``inliers`` (B, N): one, zero or NaN."""
        known = ~inliers.isnan()
        target = torch.where(known, inliers, 0.0).to(logits)
        logits = torch.where(known, logits, 0.0)  # which may be NaN
        entropy = binary_cross_entropy_with_logits(logits, target, reduction="none")
        return (entropy * known).sum(-1) / known.sum(-1).clamp(min=1)

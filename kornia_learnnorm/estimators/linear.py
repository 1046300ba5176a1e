"""Linear estimation: the DLT of a model in the coordinates of a normaliser, as a function and as a layer."""

from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.matches import MatchLayer
from kornia_learnnorm.geometry.checks import check_cameras, check_correspondences, inference_mode, without_autocast
from kornia_learnnorm.geometry.dlt import DEPENDENT_GAP
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem, prepare_problem, solve_where_determined
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.models.fundamental import Fundamental, Rank2Method
from kornia_learnnorm.models.homography import Homography
from kornia_learnnorm.models.two_view_model import TwoViewModel
from kornia_learnnorm.normalizers.closed_form import Hartley, Identity, Whitening
from kornia_learnnorm.normalizers.normalizer import Normalizer, check_normalizer, normalizing_transforms
from kornia_learnnorm.normalizers.reweighted import ReweightedWhitening

CLOSED_FORMS = (Identity, Hartley, Whitening, ReweightedWhitening)


def find_fundamental(
    points1: Tensor,
    points2: Tensor,
    weights: Tensor | None = None,
    normalizer: Normalizer | None = None,
    rank2: Rank2Method = "projection",
) -> Tensor:
    r"""Compute the fundamental matrix from eight or more correspondences by the normalised eight-point algorithm.

    The points are mapped to normalised coordinates :math:`\hat x_i = T_i x_i`, the direct linear transformation (DLT)
    finds :math:`\hat F` with :math:`\hat x_2^\top \hat F \hat x_1 = 0`, :math:`\hat F` is made singular, and
    :math:`F = T_2^\top \hat F T_1`. With eight points the DLT is exact, and the normalisation acts only through the
    metric in which :math:`F` is projected. With ``rank2="optimal"``, :math:`T_2^\top \hat F T_1` is corrected by
    :func:`~kornia_learnnorm.optimal_rank2` instead; eight points then need no normalisation, and the normaliser is not
    called.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        weights: optional non-negative weights :math:`(B, N)` of the squared algebraic residuals; zero means absent.
        normalizer: maps ``(points1, points2, weights)`` to the transforms :math:`(B, 3, 3)` of both views; default
            :class:`~kornia_learnnorm.Hartley`.
        rank2: how the singularity constraint is enforced: ``"projection"`` in Frobenius norm in normalised coordinates,
            or ``"optimal"`` correction with the covariance of :math:`F`.

    Returns:
        fundamental matrices with shape :math:`(B, 3, 3)` in the dtype of the points, of rank 2 and unit Frobenius norm,
        :math:`x_2^\top F x_1 = 0`, with the sign of :func:`~kornia_learnnorm.geometry.matrices.unit_matrix`.
        Where the correspondences do not determine :math:`F` (coincident, collinear or coplanar points) it is one of the
        solutions and carries no gradient.

    Raises:
        TypeError: if the points are not floating-point tensors of one dtype, or the normaliser cannot be called.
        ShapeError: if the shapes do not agree with the above.
        ValueError: if there are fewer than eight correspondences, the views do not pair up, a value is not finite, a
            weight is negative, the normaliser does not return two finite and invertible transforms :math:`(B, 3, 3)`,
            or ``rank2`` is neither ``"projection"`` nor ``"optimal"``.

    Reference:
        R. Hartley, In defense of the eight-point algorithm, TPAMI 1997; B. Fan, Y. Dai, Y. Seo, M. He, A revisit of the
        normalized eight-point algorithm and a self-supervised deep solution, section 3.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
        >>> find_fundamental(points1, points2).shape
        torch.Size([4, 3, 3])
    """
    check_correspondences(points1, points2, weights)
    problem = LinearProblem.from_points(points1, points2, weights, Fundamental(rank2))
    with _inference_mode(normalizer):
        F_mat = solve_linear(problem, normalizer)
    return F_mat.to(points1.dtype, copy=not torch.is_grad_enabled())


def _inference_mode(normalizer: Normalizer | None) -> AbstractContextManager[object]:
    """Return inference mode if gradients are disabled and the normaliser is a closed form, else a null context.

    Another normaliser may cache tensors, and inference tensors cannot be used in training.
    """
    return inference_mode() if normalizer is None or type(normalizer) in CLOSED_FORMS else nullcontext()


def solve_linear(problem: LinearProblem, normalizer: Normalizer | None) -> Tensor:
    """Return the matrices of a problem, solved in the coordinates of a normaliser; None for Hartley's."""
    if normalizer is None or isinstance(normalizer, Hartley) or not problem.model.needs_transforms(problem):
        return solve_in_coordinates(problem, problem.T1, problem.T2)
    return solve_in_coordinates(problem, *normalizing_transforms(normalizer, problem))


def solve_in_coordinates(problem: LinearProblem, T1: Tensor, T2: Tensor) -> Tensor:
    """Return the matrices of a problem under known transforms :math:`(B, 3, 3)` of the pixels."""
    null_matrix, gap = problem.solve_in(T1, T2)
    M = unit_matrix(problem.model.constrain_in(problem, null_matrix, T1, T2))
    if not torch.is_grad_enabled():
        return M
    # Rounding chose this solution. If its epipole happens to lie on a point, gradients would be arbitrarily large.
    return torch.where((gap > DEPENDENT_GAP[gap.dtype])[:, None, None], M, M.detach())


class LinearLayer(MatchLayer):
    """The DLT of a model as an nn.Module, with finite outputs and gradients; see :class:`EightPoint`."""

    def __init__(self, model: TwoViewModel, normalizer: Normalizer | None = None) -> None:
        super().__init__()
        if normalizer is not None:
            check_normalizer(normalizer)
        self.model = model
        self.normalizer = Hartley() if normalizer is None else normalizer

    def forward(
        self, points1: Tensor, points2: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Return the matrices (B, 3, 3); arguments, shapes and errors as for :meth:`EightPoint.estimate`."""
        with _inference_mode(self.normalizer):
            problem = prepare_problem(self.model, points1, points2, weights, mask)
            (M,) = solve_where_determined(problem, self._solve, self._solve_undetermined)
        return M.to(points1.dtype, copy=not torch.is_grad_enabled())

    def _solve(self, problem: LinearProblem, rows: Tensor | None) -> tuple[Tensor]:
        return (solve_linear(problem, self.normalizer),)

    def _solve_undetermined(self, problem: LinearProblem) -> tuple[Tensor]:
        return (problem.model.fallback(solve_linear(problem, getattr(self.normalizer, "base", None))),)


def find_homography(
    points1: Tensor,
    points2: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    normalizer: Normalizer | None = None,
) -> Tensor:
    r"""Compute the homography from four or more correspondences of a plane, or of a camera that only rotates.

    The DLT in normalised coordinates, :math:`H = T_2^{-1} \hat H T_1`. Four points determine :math:`H` exactly,
    whatever the weights and the normaliser. Do not use it on matches with outliers: it is least squares.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 4`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        weights: optional non-negative weights :math:`(B, N)` of the squared algebraic residuals; zero means absent.
        mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`. Masked rows may
            hold any value, NaN too.
        normalizer: maps ``(points1, points2, weights)`` to the transforms :math:`(B, 3, 3)` of both views;
            :class:`~kornia_learnnorm.Hartley` when not given. :class:`~kornia_learnnorm.ReweightedWhitening` and the
            shipped weights of :class:`~kornia_learnnorm.LearnedNormalizer` are made for fundamental matrices.

    Returns:
        matrices with shape :math:`(B, 3, 3)` in the dtype of the points that map homogeneous pixels of image 1 to image
        2, :math:`x_2 \sim H x_1`, of unit Frobenius norm with the sign of
        :func:`~kornia_learnnorm.geometry.matrices.unit_matrix`; ``H / H[:, 2:, 2:]`` has OpenCV's scale. Where the
        correspondences do not determine an invertible :math:`H` (fewer than four, coincident or collinear points, four
        of which three are on a line) it is the identity and carries no gradient.

    Raises:
        TypeError: if the points are not floating-point tensors of one dtype, the mask is not boolean, or the normaliser
            cannot be called.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than four rows, shapes do not pair up, an unmasked value is not finite, or a
            weight is negative.

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, algorithm 4.2.

    Example:
        >>> points1 = torch.tensor([[[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]])
        >>> H_mat = find_homography(points1, 2 * points1 + 3)
        >>> (H_mat / H_mat[:, 2:, 2:])[0].diagonal().round(decimals=3)
        tensor([2., 2., 1.])
    """
    return LinearLayer(Homography(), normalizer).forward(points1, points2, weights, mask)


class TwoViewEstimate(NamedTuple):
    r"""Fundamental matrices of a batch of image pairs, and how well the correspondences determine them.

    Attributes:
        F_mat: fundamental matrices of rank 2 and unit Frobenius norm, :math:`x_2^\top F x_1 = 0`, (B, 3, 3).
        E_mat: :math:`K_2^\top F K_1` with unit Frobenius norm, (B, 3, 3), or None without cameras. Its singular values
            are :math:`(\sigma_1, \sigma_2, 0)`, not projected to equal ones.
        determined: whether the correspondences determine the matrix, ``gap > 1e-6``, (B,) bool. Where they do not
            (fewer than eight of positive weight, coincident, collinear, coplanar), the matrix is that of the base
            normaliser and carries no gradient. This is a rank test: a plane with 0.01 px of noise passes.
        gap: relative gap of the design matrix, from 0 to 1, which decides ``determined``, (B,); see
            :func:`~kornia_learnnorm.geometry.dlt.solve_rows`. Errors grow as its inverse.
    """

    F_mat: Tensor
    E_mat: Tensor | None
    determined: Tensor
    gap: Tensor


class EightPoint(LinearLayer):
    r"""The normalised eight-point algorithm as an nn.Module, with finite outputs and gradients on degenerate samples.

    Outputs and gradients are finite for points within 1e50 of the origin whose mean distance from their centroid is
    zero or at least 1e-50. A correspondence that is masked or has weight zero is ignored. A degenerate sample is solved
    with the base normaliser (``normalizer.base`` if it exists, otherwise Hartley's) and sends no gradient, neither to
    the points nor to the normaliser.

    Do not use it on matches with outliers: it is least squares. :class:`~kornia_learnnorm.RANSAC` rejects them.

    Args:
        normalizer: a module or callable ``(points1, points2, weights) -> (T1, T2)``; default Hartley's.
        rank2: how the singularity constraint is enforced, see :func:`kornia_learnnorm.find_fundamental`.

    Raises:
        ValueError: if ``rank2`` is neither ``"projection"`` nor ``"optimal"``.
        TypeError: if ``normalizer`` is neither a module nor a function, or the layer is compiled by ``torch.jit``;
            ``torch.compile`` and ``torch.export`` work.

    Example:
        >>> layer = EightPoint()
        >>> layer(torch.rand(2, 8, 2), torch.rand(2, 8, 2)).shape
        torch.Size([2, 3, 3])
        >>> points = torch.rand(2, 1, 2).expand(2, 8, 2)
        >>> layer.estimate(points, points).determined
        tensor([False, False])
    """

    def __init__(self, normalizer: Normalizer | None = None, rank2: Rank2Method = "projection") -> None:
        super().__init__(Fundamental(rank2), normalizer)
        self.rank2 = rank2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"rank2={self.rank2!r}"

    def estimate(
        self,
        points1: Tensor,
        points2: Tensor,
        *,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> TwoViewEstimate:
        r"""Return the fundamental matrices, which samples are not degenerate, and with cameras essential matrices.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64;
                calibrated coordinates work as well, and give essential matrices.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`, of any floating-point dtype.
            mask: optional, true for the rows that are correspondences, boolean with shape :math:`(B, N)`. Masked rows
                may hold any value, NaN too, and get a gradient of zero; without a mask NaN is an error.
            K1: optional cameras of the first view, :math:`(3, 3)`, :math:`(1, 3, 3)` or :math:`(B, 3, 3)`.
            K2: optional cameras of the second view; both or none.

        Returns:
            the matrices, in the dtype of the points.

        Raises:
            TypeError: if the points are not floating-point tensors of one dtype, weights or cameras not floating-point,
                or the mask not boolean.
            ShapeError: if a shape is wrong.
            ValueError: if there are fewer than eight rows, shapes do not pair up, an unmasked value is not finite, a
                weight is negative, or only one camera is given or one is not invertible.
        """
        with _inference_mode(self.normalizer):
            problem = prepare_problem(self.model, points1, points2, weights, mask)
            check_cameras(K1, K2, points1.shape[0])
            (F_mat,) = solve_where_determined(problem, self._solve, self._solve_undetermined)
        F_mat, gap = F_mat.to(points1.dtype, copy=not torch.is_grad_enabled()), problem.gap.clone()
        return TwoViewEstimate(F_mat, essential_matrix(F_mat, K1, K2), problem.determined, gap)


def essential_matrix(F_mat: Tensor, K1: Tensor | None, K2: Tensor | None) -> Tensor | None:
    r"""Return :math:`K_2^\top F K_1` with unit Frobenius norm, None without cameras."""
    if K1 is None or K2 is None:
        return None
    with without_autocast(F_mat):
        return unit_matrix(transform_fundamental(F_mat, K1.to(F_mat), K2.to(F_mat)))

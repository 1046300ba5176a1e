"""Whether the matches determine a fundamental matrix, or a homography is the answer."""

import math

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.homography import Homography
from kornia_learnnorm.two_view.parallax import measure_parallax
from kornia_learnnorm.two_view.predicted_error import MEDIAN_SQUARE, MIN_NOISE
from kornia_learnnorm.two_view.random_parts import MIN_SUPPORT
from kornia_learnnorm.two_view.result import ModelChoice, NoReliableMatrixError
from kornia_learnnorm.two_view.solver import MIN_MATCHES, Solution, TwoViewSolver

MIN_PLANE_SUPPORT = 0.9  # of the inliers of an essential matrix, which outliers agree with more easily
ASKED = "asked for"
MEDIAN_SQUARE_OF_TWO = 2 * math.log(2)  # median of the sum of two squared standard normal variables


def choose_model(
    solver: TwoViewSolver, model: str, size1: Size, size2: Size
) -> tuple[ModelChoice, Solution | None, Tensor | None]:
    """Return the choice, and the fundamental matrix and the homography (3, 3) where they were sought and found.

    ``"auto"`` chooses the homography if one, with a radial distortion, explains most inliers of the fundamental matrix,
    the parallax of the others is no more than chance (as in L. Moisan, B. Stival, IJCV 2004), and the homography has
    the smaller GRIC (with cameras, nine tenths of the essential matrix's inliers are enough instead). Random parts of
    the matches are then not searched for a better fundamental matrix. It also chooses the homography if this search
    fails: it finds no fundamental matrix, or one with fewer than three quarters of the homography's inliers, although
    some fundamental matrix fits all of these.
    """
    H_mat = None if model == "fundamental" else solver.homography(size2)
    agree = None if H_mat is None else int(solver.support(H_mat, "homography"))
    if model == "homography":
        if H_mat is None:
            text = f"fewer than {MIN_MATCHES} of {len(solver.scores)} matches agree on a homography within "
            raise NoReliableMatrixError("no_consensus", f"{text}{solver.threshold:g} px, or no more than by chance")
        F_mat = solver.solve().matrix  # its parallax tells whether the scene is a plane
        matches = solver.points1, solver.points2, F_mat, solver.threshold, size1, size2
        parallax = measure_parallax(*matches) if int(solver.support(F_mat)) >= MIN_MATCHES else None
        return ModelChoice(model, ASKED, parallax, homography_inliers=agree), None, H_mat
    found = solver.solve()
    choice = _compare(solver, found.matrix, H_mat, size1, size2)
    if choice.model == "fundamental" or choice.by_gric != "homography":
        try:
            found = solver.search(found, size2)
        except NoReliableMatrixError as error:
            if H_mat is None:
                raise
            return ModelChoice("homography", str(error), homography_inliers=agree), None, H_mat
        choice = _compare(solver, found.matrix, H_mat, size1, size2)
    return (choice if model == "auto" else choice._replace(reason=ASKED)), found, H_mat


def _compare(solver: TwoViewSolver, F_mat: Tensor, H_mat: Tensor | None, size1: Size, size2: Size) -> ModelChoice:
    """Return the choice between a fundamental matrix and a homography (3, 3)."""
    matches, threshold = (solver.points1, solver.points2), solver.threshold
    inliers = int(solver.support(F_mat))
    parallax = measure_parallax(*matches, F_mat, threshold, size1, size2)
    reason = parallax.describe(threshold)
    if H_mat is None:
        return ModelChoice("fundamental", reason, parallax, inliers)
    agree = int(solver.support(H_mat, "homography"))
    if inliers < MIN_SUPPORT * agree:
        reason = f"{agree} matches agree on it, only {inliers} on a fundamental matrix"
        return ModelChoice("homography", reason, parallax, inliers, agree)
    gric = compute_gric(*matches, F_mat, H_mat, threshold, solver.cameras is not None)
    # With cameras, a plane has two poses: its homography gives both, an essential matrix one, which may be the wrong.
    as_many = solver.cameras is not None and agree >= MIN_PLANE_SUPPORT * inliers
    model = "homography" if parallax.planar and (as_many or gric[1] < gric[0]) else "fundamental"
    if parallax.planar and model == "fundamental":
        reason += ", but GRIC prefers the fundamental matrix"
    return ModelChoice(model, reason, parallax, inliers, agree, *gric)


def compute_gric(
    points1: Tensor, points2: Tensor, F_mat: Tensor, H_mat: Tensor, threshold: float, calibrated: bool
) -> tuple[float, float]:
    """Return the geometric robust information criterion of a fundamental matrix (3, 3) and of a homography.

    The smaller one is the better model. Of matches (N, 2), the inliers of either matrix count, with squared Sampson
    distances of one and of two degrees of freedom; the noise is the larger one of those that the inliers of either
    show, since on a plane a fundamental matrix is free to fit their noise.

    Reference:
        P. Torr, A. Fitzgibbon, A. Zisserman, The problem of degeneracy in structure and motion recovery from
        uncalibrated image sequences, IJCV 1999.
    """
    x1, x2 = (convert_points_to_homogeneous(points).mT[None] for points in (points1, points2))
    models = (Fundamental(), F_mat), (Homography(), H_mat)
    squares1, squares2 = (model.squares(model.residual(M[None], x1, x2))[0] for model, M in models)
    inliers, moved = squares1 < threshold**2, squares2 < threshold**2
    kept = inliers | moved
    variances = squares1[inliers].median() / MEDIAN_SQUARE, squares2[moved].median() / MEDIAN_SQUARE_OF_TWO
    variance = torch.stack(variances).nan_to_num(0.0).amax().clamp(min=MIN_NOISE**2 * threshold**2)
    parameters = Essential.dof if calibrated else Fundamental.dof
    return _gric(squares1[kept] / variance, 3, parameters), _gric(squares2[kept] / variance, 2, Homography.dof)


def _gric(squares: Tensor, dimension: int, parameters: int) -> float:
    """Return the criterion of squared distances (N,) over the variance of a model of a dimension in four."""
    misfit = float(squares.clamp(max=2 * (4 - dimension)).sum())
    return misfit + math.log(4) * dimension * len(squares) + math.log(4 * len(squares)) * parameters

r"""The homography as a two-view model: two rows a point, no constraint, eight degrees of freedom.

:math:`H` maps points of view 1 to view 2, :math:`x_2 \sim H x_1`. Four points determine it exactly, whatever their
weights, unless three of them are on a line. On its manifold it is a matrix of unit norm, and a step is orthogonal to
it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from kornia_learnnorm.geometry.checks import check_choice, safe_divisor
from kornia_learnnorm.geometry.constrained_fit import Fit, Loss
from kornia_learnnorm.geometry.distances import Distance
from kornia_learnnorm.geometry.dlt import normal_equations
from kornia_learnnorm.geometry.matrices import cofactors, determinant, inverse
from kornia_learnnorm.models.two_view_model import TwoViewModel

IDENTITY = (3**-0.5, 0.0, 0.0, 0.0, 3**-0.5, 0.0, 0.0, 0.0, 3**-0.5)
MAX_DETERMINANT = 3**-1.5  # of a matrix of unit norm
MIN_DETERMINANT = 1e-9  # of a matrix of unit norm that counts as invertible
DEPTH_FLOOR = 1e-9  # smallest magnitude of a depth to divide by, over the size of the coordinates
COVARIANCE_FLOOR = 1e-4  # of the root mean square of the residuals' scale, added to each in learned layers


class Homography(TwoViewModel):
    r"""Homographies, :math:`x_2 \sim H x_1`.

    ``distance`` is the residual of a correspondence. ``"sampson"``, two numbers: with the residuals
    :math:`\epsilon` of :math:`x_2 \times H x_1 = 0` in its first two rows and their derivatives :math:`J` by the four
    coordinates, :math:`d^2 = \epsilon^\top (J J^\top)^{-1} \epsilon`, the first-order distance to the nearest exact
    correspondence. ``"symmetric"``, four numbers: the errors of both points mapped to the other view. Other names are a
    ValueError.

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, sections 4.1 and 4.2; O. Chum, T. Pajdla, P.
        Sturm, The geometric error for homographies, CVIU 2005, for the Sampson error.
    """

    name = "homography"
    min_points = 4
    dof = 8
    sample_size = 4
    preferred: tuple[float, ...] = IDENTITY
    confidence, max_batch, pool_size, prescored = 0.9999, 4096, 4, 256  # samples of four are cheap

    def __init__(self, distance: Distance = "sampson") -> None:
        check_choice("distance", distance, ("sampson", "symmetric"))
        self.distance, self.components = distance, 2 if distance == "sampson" else 4

    def rows(self, x1: Tensor, x2: Tensor) -> Tensor:
        r"""Return the first two rows of :math:`x_2 \times H x_1 = 0` of each correspondence, (B, 2 N, 9)."""
        zero, (u, v, w) = torch.zeros_like(x1), x2[..., None].unbind(-2)
        first, second = torch.cat([w * x1, zero, -u * x1], -1), torch.cat([zero, w * x1, -v * x1], -1)
        return torch.stack([first, second], -2).flatten(-3, -2)

    def row_weights(self, weights: Tensor) -> Tensor:
        """Return each weight twice."""
        return weights.repeat_interleave(2, -1)

    def null_vector(self, x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the null vector, and its relative gap or the relative determinant, whichever is smaller.

        Four points of which three are on a line in one view alone have a unique solution, but a singular one.
        """
        h, gap = super().null_vector(x1, x2, weights)
        volume = determinant(torch.unflatten(h.detach(), -1, (3, 3))).abs() / MAX_DETERMINANT
        return h, torch.minimum(gap, volume)

    def carry(self, M: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
        r"""Return :math:`T_2^{-1} H T_1`."""
        return inverse(T2) @ M @ T1

    def swap(self, M: Tensor) -> Tensor:
        r"""Return :math:`H^{-1}` up to scale."""
        return cofactors(M).mT

    def constrain(self, M: Tensor) -> Tensor:
        """Return the matrices themselves."""
        return M

    def fallback(self, M: Tensor) -> Tensor:
        """Return the identity."""
        return M.new_tensor(IDENTITY).view(3, 3).expand_as(M)

    def linearise(self, M: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return residuals with signs and their derivatives by the column-major entries."""
        if self.distance == "sampson":
            return _sampson(M, x1, x2, weights)
        G = inverse(M)
        (there, p1), (back, p2) = _transfer(M, x1, x2), _transfer(G, x2, x1)
        # A change dH changes the inverse by -G dH G, and so p2^T dG x2 is (-G^T p2)^T dH (G x2).
        parts = ((p1, x1.expand_as(p1[:, 0])), (-G.mT[:, None] @ p2, G @ x2))
        J = [(x[:, :, None, None] * p.transpose(1, 2)[:, None]).flatten(3).flatten(1, 2) for p, x in parts]
        return torch.cat([there, back], 1).flatten(1), torch.cat(J, 2)

    def robust_distance(self, M: Tensor, x1: Tensor, x2: Tensor, present: Tensor | None) -> tuple[Tensor, Tensor]:
        r"""Return squared Sampson distances and the inverses of the mean eigenvalues of :math:`J J^\top`."""
        squares, factor = self.sampson_squares(M[:, None], self.sampson_terms(x1, x2))
        return squares[:, 0], factor[:, 0]

    def state(self, M: Tensor) -> Any:
        """Return the matrices scaled to unit norm."""
        return UnitMatrix(M / torch.linalg.matrix_norm(M, keepdim=True))

    def solve_samples(self, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
        """Return the matrices of the samples of four points that two cameras can see on one side of a plane."""
        M, margin = solve_four_points(x1, x2)
        return M[margin > shift]

    def sampson_terms(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Return what :meth:`sampson_squares` needs of correspondences (*, 3, N), (*, 12, N)."""
        u, v, w = x2.unbind(-2)
        return torch.cat([x1, x2, torch.stack([w * w, -u * w, -v * w, u * u, u * v, v * v], -2)], -2)

    def sampson_squares(self, M: Tensor, terms: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return squared Sampson distances under matrices (*, K, 3, 3), (*, K, N), by matrix products.

        The second tensor, the inverse of the mean eigenvalue of :math:`J J^\top`, turns squared algebraic residuals
        into about as much.
        """
        parts = self.sampson_parts(M, terms)
        return squared_distances(parts), 2 / (parts[2] + parts[4])

    def sampson_parts(self, M: Tensor, terms: Tensor) -> tuple[Tensor, ...]:
        r"""Return the residuals p, q, then a, b, c of :math:`J J^\top = [[a, b], [b, c]]` and its determinant.

        Each is (*, K, N), for matrices (*, K, 3, 3).
        """
        x1, x2, products = torch.split(terms[..., None, :, :], [3, 3, 6], -2)
        uv, w, y = x2[..., :2, :], x2[..., 2:, :], M @ x1
        z = y[..., 2, :].square()
        p, q = (w * y[..., :2, :] - uv * y[..., 2:, :]).unbind(-2)
        d11, d12, d13, _, d22, d23, _, _, d33 = (M[..., :2] @ M[..., :2].mT).flatten(-2).unbind(-1)
        zero = torch.zeros_like(d11)
        form_a = [d11, 2 * d13, zero, d33, zero, zero]
        form_b = [d12, d23, d13, zero, d33, zero]
        form_c = [d22, zero, 2 * d23, zero, zero, d33]
        forms = torch.unflatten(torch.stack([*form_a, *form_b, *form_c], -1), -1, (3, 6))
        a, b, c = (forms @ products).unbind(-2)
        trace = a + c
        floor = COVARIANCE_FLOOR**2 * trace.detach().mean(-1, keepdim=True) + torch.finfo(M.dtype).tiny
        z = z + floor
        volume = (a * c - b.square()).clamp(min=0) + z * (trace + z)
        return p, q, a + z, b, c + z, volume

    def score_terms(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Return the points and, for Sampson distances, products of those of view 2."""
        return self.sampson_terms(x1, x2) if self.distance == "sampson" else super().score_terms(x1, x2)

    def score_squares(self, M: Tensor, terms: Tensor, threshold: float) -> Tensor:
        """Return squared distances over the threshold's square."""
        if self.distance == "symmetric":
            return super().score_squares(M, terms, threshold)
        return self.sampson_squares(M, terms)[0] / threshold**2

    def reweighted_fit(self, x1: Tensor, x2: Tensor, M: Tensor, losses: Sequence[Loss]) -> Fit | None:
        """Return matrices fitted by least squares of the Sampson distances; None for others."""
        if self.distance == "symmetric":
            return None
        # Steps are of points whose last coordinate is one; their unit is about the size of both images.
        unit = (x1[2, 0] * x2[2, 0]).sqrt()
        to_unit1, to_unit2 = (torch.diag(torch.stack([unit, unit, x[2, 0]])) / unit for x in (x1, x2))
        x1, x2 = (torch.cat([x[:2] / unit, torch.ones_like(x[2:])]) for x in (x1, x2))
        terms, products = self.sampson_terms(x1, x2)[None], (x1[:, None] * x1).flatten(0, 1)[None]
        fitted = self.state(inverse(to_unit2) @ M @ to_unit1).M[None]
        for loss in losses:
            parts = self.sampson_parts(fitted, terms)
            values, weights = loss(squared_distances(parts) * unit.square())
            fitted, gain = self.reweighted_step(fitted, terms, products, parts, weights)
        found, cost = fitted.isfinite().all(-1).all(-1)[0], values.sum(-1)[0]
        M = torch.where(found[:, None, None], self.state(to_unit2 @ fitted[0] @ inverse(to_unit1)).M, M)
        share = gain[0] * weights.sum(-1)[0] * unit.square() / cost
        return Fit(M, torch.where(found, cost, torch.inf), share)

    def reweighted_step(
        self, M: Tensor, terms: Tensor, products: Tensor, parts: tuple[Tensor, ...], weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        r"""Return matrices (B, K, 3, 3) after a step of weighted least squares, and what it gains of the mean, (B, K).

        ``products`` (B, 9, N) are those of the points of view 1, ``parts`` those of :meth:`sampson_parts`, weights
        (B, K, N). It is a Gauss-Newton step with the gradient of :math:`\sum_i w_i \epsilon_i^\top C_i^{-1}
        \epsilon_i`: with :math:`\lambda = C^{-1} \epsilon` it is that of :math:`\sum_i w_i (\epsilon_i^\top C_i^{-1}
        \epsilon_i - \lambda_i^\top C_i \lambda_i)` where :math:`C_i^{-1}` and :math:`\lambda_i` are held.
        """
        u, v = terms[:, None, 3], terms[:, None, 4]
        p, q, a, b, c, volume = parts
        first, second = (c * p - b * q) / volume, (a * q - b * p) / volume
        weights = weights / safe_divisor(weights.sum(2, keepdim=True))
        share = weights / volume
        w11, w12, w22 = share * c, -share * b, share * a
        w1, w2 = w11 * u + w12 * v, w12 * u + w22 * v
        depth = weights * (first.square() + second.square())
        rows = torch.stack([w11, w12, w22, -w1, -w2, w1 * u + w2 * v, depth], 2)
        S11, S12, S22, S1, S2, S3, depths = torch.unflatten(rows @ products.mT[:, None], 3, (3, 3)).unbind(2)
        moments = torch.cat([torch.cat(row, 3) for row in ([S11, S12, S1], [S12, S22, S2], [S1, S2, S3])], 2)
        L = torch.stack([first, second, -(u * first + v * second)], 2)
        L = (L * weights[:, :, None]) @ L.mT
        flat, last = torch.diag(M.new_tensor([1.0, 1.0, 0.0])), torch.diag(M.new_tensor([0.0, 0.0, 1.0]))
        held = L[..., :, None, :, None] * flat[:, None] + last[:, None, :, None] * depths[..., None, :, None, :]
        difference = moments - held.flatten(4, 5).flatten(2, 3)
        D = UnitMatrix(M.flatten(0, 1).mT).tangents()  # moments are those of row-major entries
        h = M.flatten(0, 1).flatten(1)[..., None]
        normal, gradient = normal_equations(moments.flatten(0, 1), difference.flatten(0, 1) @ h, D)
        step = torch.linalg.solve_ex(normal, gradient)[0]
        moved = h - D @ step
        unit: Tensor = moved / torch.linalg.vector_norm(moved, dim=1, keepdim=True)
        return unit.view_as(M), (step.mT @ gradient).view(M.shape[:2])

    def is_degenerate(self, state: Any) -> Tensor:
        """Return which matrices are singular."""
        return determinant(state.M).abs() < MIN_DETERMINANT


class UnitMatrix(NamedTuple):
    """Matrices of unit norm: a step is orthogonal to them."""

    M: Tensor  # (B, 3, 3)

    def matrix(self) -> Tensor:
        """Return the matrices themselves, (B, 3, 3)."""
        return self.M

    def tangents(self) -> Tensor:
        """Return an orthonormal basis (B, 9, 8) of the steps: a reflection takes a unit vector to the matrix."""
        m = self.M.mT.flatten(1)
        first = torch.eye(9, dtype=m.dtype, device=m.device)[0]
        v = normalize(m + torch.where(m[:, :1] < 0, -1.0, 1.0) * first, dim=-1)[..., None]
        return (torch.eye(9, dtype=m.dtype, device=m.device) - 2 * v @ v.mT)[..., 1:]

    def retract(self, step: Tensor) -> Self:
        """Return the state after a step, (B, 8)."""
        moved = self.M.mT.flatten(1) + (self.tangents() @ step[..., None])[..., 0]
        return type(self)(torch.unflatten(normalize(moved, dim=-1), -1, (3, 3)).mT)


def squared_distances(parts: tuple[Tensor, ...]) -> Tensor:
    """Return squared Sampson distances from what :meth:`Homography.sampson_parts` gives."""
    p, q, a, b, c, volume = parts
    return (c * p.square() - 2 * b * p * q + a * q.square()) / volume


def solve_four_points(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the matrices (K, 3, 3) of samples of four homogeneous points (K, 4, 3), and their margins (K,).

    With the first three points :math:`P` as columns, :math:`H = P_2 \, \mathrm{diag}(d_{2,k} / d_{1,k}) \, P_1^{-1}`,
    where :math:`d_k` is the determinant of the fourth point in place of the :math:`k`-th. The margin is a shift of a
    point, in the unit of the first two coordinates, below which no three points become collinear. It is zero where
    three points run clockwise in one view and not in the other: no two cameras see one side of a plane like that (P.
    Marquez-Neila, J. Lopez-Alberca, J. Buenaposada, L. Baumela, Speeding-up homography estimation in mobile devices,
    Journal of Real-Time Image Processing 2016).
    """
    points, x = torch.stack([x1, x2]), torch.stack([x1, x2])[..., :3, :]
    dual = cofactors(x)  # rows are orthogonal to two points each
    last = (dual @ points[..., 3, :, None])[..., 0]
    volumes = torch.cat([(dual[..., 0, :] * x[..., 0, :]).sum(-1, keepdim=True), last], -1)
    d1, d2 = last
    ratio = d2 * d1.roll(1, -1) * d1.roll(-1, -1)  # d2 / d1 times the product of all d1
    M = x[1].mT @ (ratio[..., None] * dual[0])
    M = M / safe_divisor(torch.linalg.matrix_norm(M, keepdim=True))
    longest = torch.cdist(points[..., :2], points[..., :2]).flatten(-2).amax(-1)
    heights = volumes.abs().amin(-1) / safe_divisor(longest * points[..., 2].amin(-1))
    return M, torch.where((volumes.prod(0) > 0).all(-1), heights.amin(0), 0.0)


def _transfer(M: Tensor, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors (B, 2, N) of points mapped to the other view, and p (B, 2, 3, N) of their changes p^T dM x1."""
    y = M @ x1
    least = DEPTH_FLOOR * torch.linalg.vector_norm(y, dim=1, keepdim=True) + torch.finfo(y.dtype).tiny
    scale = x2[:, 2:] / torch.where(y[:, 2:].abs() < least, least, y[:, 2:])
    image = y[:, :2] * scale
    eye = torch.eye(3, dtype=y.dtype, device=y.device)
    p = scale[:, None] * (eye[:2, :, None] - eye[2, :, None] * (image / x2[:, 2:])[:, :, None])
    return image - x2[:, :2], p


def _sampson(M: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    r"""Return the residuals :math:`L^{-1} \epsilon` with :math:`L L^\top = J J^\top` and their derivatives.

    :math:`J J^\top = [[a, b], [b, c]]` is the sum of :math:`G G^\top`, with the derivatives :math:`G` of
    :math:`\epsilon` by the first point, and of the squared depth.
    """
    uv, w, y = x2[:, :2], x2[:, 2:], M @ x1
    e, depth = w * y[:, :2] - uv * y[:, 2:], y[:, 2]
    G = w[:, None] * M[:, :2, :2, None] - uv[:, :, None] * M[:, 2:, :2, None]
    norms, square = G.square().sum(2), depth.square()
    floor: Tensor | float = torch.finfo(M.dtype).eps ** 2
    if weights is not None:
        floor = COVARIANCE_FLOOR**2 / 2 * ((norms.sum(1) + 2 * square) * weights).sum(-1, keepdim=True)
        floor = floor + torch.finfo(M.dtype).tiny
    square = square + floor
    a, c = (norms + square[:, None]).unbind(1)
    b, area = (G[:, 0] * G[:, 1]).sum(1), G[:, 0, 0] * G[:, 1, 1] - G[:, 0, 1] * G[:, 1, 0]
    # Cholesky's factor is [[sqrt a, 0], [q sqrt a, sqrt h]]; the determinant over a has no cancellation like this.
    q, h = b / a, (area.square() + square * (a + c - square)) / a
    k1, k2 = a.rsqrt(), h.rsqrt()
    first, second = e[:, 0] * k1, (e[:, 1] - q * e[:, 0]) * k2
    # Derivatives of both by the residuals and by a, b, c, (B, 2, N) each.
    by_c = second / (-2 * h)
    pull = k2 * e[:, 0] / a + q * by_c
    zero = torch.zeros_like(a)
    e1, e2 = torch.stack([k1, -k2 * q], 1), torch.stack([zero, k2], 1)
    by_abc = (first / (-2 * a), pull * q), (zero, -pull - q * by_c), (zero, by_c)
    da, db, dc = (torch.stack(pair, 1) for pair in by_abc)
    x = x1[:, None]
    row1 = e1[:, :, None] * x + pad(2 * da[:, :, None] * G[:, :1] + db[:, :, None] * G[:, 1:], (0, 0, 0, 1))
    row2 = e2[:, :, None] * x + pad(db[:, :, None] * G[:, :1] + 2 * dc[:, :, None] * G[:, 1:], (0, 0, 0, 1))
    u, v, w = x2[:, None, :, None].unbind(2)
    row3 = 2 * (depth[:, None] * (da + dc))[:, :, None] * x - u * row1 - v * row2
    J = torch.stack([w * row1, w * row2, row3], 1)  # (B, row, component, column, N)
    return torch.cat([first, second], 1), J.permute(0, 3, 1, 2, 4).flatten(3).flatten(1, 2)

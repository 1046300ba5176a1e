"""References in NumPy, comparisons that know about sign and scale, and checks of gradients and errors."""

import numpy as np
import torch
from kornia.core.exceptions import ShapeError
from scenes import raises, uniform
from torch import Tensor


def corner_error(M, H) -> float:
    """Largest distance of the corners of an image of 600 x 600 pixels, mapped by two batches of homographies."""
    corners = torch.tensor([[0.0, 0, 1], [600, 0, 1], [600, 600, 1], [0, 600, 1]], dtype=torch.float64).mT
    a, b = (X.detach() @ corners for X in (M, H))
    return float((a[..., :2, :] / a[..., 2:, :] - b[..., :2, :] / b[..., 2:, :]).norm(dim=-2).max())


def homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones_like(points[..., :1])], -1)


def mapped(T, points) -> np.ndarray:
    """Points after an affine transform."""
    return (homogeneous(np.asarray(points)) @ np.asarray(T).swapaxes(-1, -2))[..., :2]


def unit(F: np.ndarray) -> np.ndarray:
    return F / np.linalg.norm(F, axis=(-2, -1), keepdims=True)


def cross(t) -> np.ndarray:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def true_essential(scene) -> Tensor:
    """[t]_x R of unit norm, (B, 3, 3)."""
    E = [cross(t) @ R for R, t in zip(scene.R.numpy(), scene.t.numpy(), strict=True)]
    return torch.from_numpy(unit(np.stack(E)))


def null_matrices(points1, points2, T1, T2, weights=None) -> np.ndarray:
    """The last right singular vectors of the design matrices in the coordinates of the transforms."""
    T1, T2 = (np.asarray(T, dtype=np.float64).swapaxes(-1, -2) for T in (T1, T2))
    x1, x2 = homogeneous(np.asarray(points1, dtype=np.float64)) @ T1, homogeneous(np.asarray(points2, np.float64)) @ T2
    A = (x2[..., :, None] * x1[..., None, :]).reshape(*x1.shape[:2], 9)
    A = A if weights is None else A * np.sqrt(np.asarray(weights))[..., None]
    return np.linalg.svd(A, full_matrices=True)[2][:, -1].reshape(-1, 3, 3)


def eight_point(points1, points2, T1, T2, weights=None) -> np.ndarray:
    """The normalised eight-point algorithm by two singular value decompositions; the weights are of squares."""
    U, s, Vh = np.linalg.svd(null_matrices(points1, points2, T1, T2, weights))
    F = U[..., :2] * s[..., None, :2] @ Vh[..., :2, :]
    return unit(np.asarray(T2, dtype=np.float64).swapaxes(-1, -2) @ F @ np.asarray(T1, dtype=np.float64))


def numpy_hartley(points, weights=None) -> np.ndarray:
    T = []
    for k, p in enumerate(np.asarray(points, dtype=np.float64)):
        w = None if weights is None else np.asarray(weights[k])
        o = np.average(p, axis=0, weights=w)
        s = np.sqrt(2) / np.average(np.hypot(*(p - o).T), weights=w)
        T.append([[s, 0, -s * o[0]], [0, s, -s * o[1]], [0, 0, 1]])
    return np.array(T)


def numpy_whitening(points, weights=None) -> np.ndarray:
    T = []
    for k, p in enumerate(np.asarray(points, dtype=np.float64)):
        w = np.full(len(p), 1.0) if weights is None else np.asarray(weights[k])
        values, vectors = np.linalg.eigh(np.cov(p.T, aweights=w, ddof=0))
        M = vectors @ np.diag(values**-0.5) @ vectors.T
        T.append(np.block([[M, -M @ np.average(p, axis=0, weights=w)[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]]))
    return np.array(T)


def rank_three(points1, points2, weights=None) -> Tensor:
    """The DLT's solution in Hartley's coordinates, of rank 3, in pixels."""
    T1, T2 = numpy_hartley(points1, weights), numpy_hartley(points2, weights)
    return torch.from_numpy(unit(T2.swapaxes(-1, -2) @ null_matrices(points1, points2, T1, T2, weights) @ T1))


def epipolar_distances(points1, points2, F) -> np.ndarray:
    """The sum of both points' distances to their epipolar lines, line by line."""
    x1, x2 = homogeneous(np.asarray(points1)), homogeneous(np.asarray(points2))
    lines2, lines1 = x1 @ np.asarray(F).swapaxes(-1, -2), x2 @ np.asarray(F)
    residual = np.abs((x2 * lines2).sum(-1))
    return residual / np.hypot(*lines2[..., :2].T).T + residual / np.hypot(*lines1[..., :2].T).T


def numpy_sampson(points1, points2, F) -> np.ndarray:
    """Sampson distances in pixels, with signs, (*, N)."""
    x1, x2, F = homogeneous(np.asarray(points1)), homogeneous(np.asarray(points2)), np.asarray(F)
    lines2, lines1 = x1 @ F.swapaxes(-1, -2), x2 @ F
    return (x2 * lines2).sum(-1) / np.sqrt((lines1[..., :2] ** 2).sum(-1) + (lines2[..., :2] ** 2).sum(-1))


def least_squares(distances, q, step: float = 1e-6, iterations: int = 300) -> float:
    """Least sum of squares found from q by damped Gauss-Newton steps on central differences."""
    damping, cost = 1e-3, (distances(q) ** 2).sum()
    for _ in range(iterations):
        J = np.stack([(distances(q + s) - distances(q - s)) / (2 * step) for s in step * np.eye(len(q))], -1)
        H = J.T @ J
        damped = H + damping * np.diag(H.diagonal()) + 1e-12 * np.eye(len(q))
        new = q - np.linalg.solve(damped, J.T @ distances(q))
        new_cost = (distances(new) ** 2).sum()
        if abs(new_cost - cost) < 1e-13 * cost:
            break
        q, cost, damping = (new, new_cost, damping / 5) if new_cost < cost else (q, cost, damping * 5)
        damping = min(max(damping, 1e-12), 1e12)
    return cost


def up_to_sign(F, G) -> float:
    """Largest difference of two batches of matrices, each scaled to unit norm, whatever their signs."""
    F, G = unit(np.asarray(F, dtype=np.float64)), unit(np.asarray(G, dtype=np.float64))
    return float(np.minimum(np.abs(F - G).max((-2, -1)), np.abs(F + G).max((-2, -1))).max(initial=0))


def in_hartley(F, points1, points2, homography: bool = False) -> np.ndarray:
    """F, or H, of pixels in Hartley's coordinates, where all nine entries count."""
    T1, T2 = numpy_hartley(points1), numpy_hartley(points2)
    left = T2 if homography else np.linalg.inv(T2).swapaxes(-1, -2)
    return unit(left @ np.asarray(F, dtype=np.float64) @ np.linalg.inv(T1))


def hartley_difference(F, G, points1, points2, homography: bool = False) -> float:
    """Largest difference of two batches of matrices of pixels in Hartley's coordinates."""
    return up_to_sign(in_hartley(F, points1, points2, homography), in_hartley(G, points1, points2, homography))


def signless(F: Tensor) -> Tensor:
    """Smooth numbers of unit matrices that do not see the sign; a gradient check must not trip on it."""
    return (F.flatten(-2) @ uniform(9, 4, low=-1, seed=9).to(F)).square()


def _wrong_correspondences(least: int) -> list[tuple]:
    """Points, weights, and the error that every function of correspondences raises for them."""
    points, ones = uniform(2, 8, 2), torch.ones(2, 8)
    wrong = [
        (points.long(), points, None, TypeError, "points1 must be .* got torch.int64"),
        (points, points.int(), None, TypeError, "points2 must be .* got torch.int32"),
        (points.half(), points.half(), None, TypeError, "float32 or float64 tensor, got torch.float16"),
        (points.numpy(), points, None, TypeError, "points1 must be .* got <class 'numpy.ndarray'>"),
        (points, None, None, TypeError, "points2 must be .* got <class 'NoneType'>"),
        (points.float(), points, None, TypeError, "one dtype, got torch.float32 and torch.float64"),
        (points, points.to("meta"), None, ValueError, "must be on one device, got cpu and meta"),
        (points, points, -0.25 * ones, ValueError, r"weights must not be negative, got a minimum of -0\.25"),
        (points, points, ones.bool(), TypeError, "floating-point tensor, got torch.bool; a boolean tensor is a mask"),
        (points, points, [[1.0] * 8] * 2, TypeError, "weights must be a floating-point tensor, got <class 'list'>"),
    ]
    for shape in ([8, 2], [2, 8, 3], [2, 8, 1], [1, 2, 8, 2]):
        message = str(shape).replace("[", r"\[")
        wrong += [(x, torch.zeros(shape), None, ShapeError, message) for x in (torch.zeros(shape), points.float())]
    for shape in ([2, 9, 2], [3, 8, 2], [1, 8, 2]):
        message = rf"pair up, got shapes \[2, 8, 2\] and \{shape}"
        wrong.append((points, points.new_zeros(shape), None, ValueError, message))
    for shape in ([8], [2, 9], [2, 8, 1]):
        message = rf"weights must have shape \[2, 8\], got \{shape}"
        wrong.append((points, points, torch.ones(shape), ValueError, message))
    for number in (0, 1, least - 1):
        few = points[:, :number]
        wrong.append((few, few, None, ValueError, f"at least {least} correspondences are needed, got {number}"))
    for value in (torch.nan, torch.inf, -torch.inf):
        for k, (name, count) in enumerate([("points1", 2), ("points2", 2), ("weights", 1)]):
            values = [points.clone(), points.clone(), ones.clone()]
            values[k][1, 3] = value
            wrong.append((*values, ValueError, f"{name} must be finite, got {count} NaN or infinite"))
    return wrong


def check_gradients(function, *values: Tensor, eps: float = 1e-6, atol: float = 1e-5, rtol: float = 1e-3) -> None:
    """Check gradients of numbers (B, K) of B sets against central differences, all in one call, unlike gradcheck."""
    flat = torch.cat([value.detach().flatten(1) for value in values], 1).requires_grad_()

    def numbers(rows: Tensor) -> Tensor:
        parts = rows.split([value[0].numel() for value in values], 1)
        return function(*(part.reshape(-1, *value.shape[1:]) for part, value in zip(parts, values, strict=True)))

    gradients = [torch.autograd.grad(column.sum(), flat, retain_graph=True)[0] for column in numbers(flat).unbind(1)]
    steps = eps * torch.eye(flat.shape[1], dtype=flat.dtype)[:, None]
    plus, minus = (numbers((flat.detach() + step).flatten(0, 1)).detach() for step in (steps, -steps))
    differences = ((plus - minus) / (2 * eps)).view(flat.shape[1], len(flat), -1)
    torch.testing.assert_close(torch.stack(gradients, -1).movedim(1, 0), differences, atol=atol, rtol=rtol)


def derivative(function):
    """Return the gradient of a weighted sum of a function's numbers, for `check_gradients` of second derivatives."""

    def gradient(*values: Tensor) -> Tensor:
        values = [value if value.requires_grad else value.clone().requires_grad_() for value in values]
        numbers = function(*values)
        total = (numbers * torch.arange(1.0, 1 + numbers.shape[1])).sum()
        return torch.cat([g.flatten(1) for g in torch.autograd.grad(total, values, create_graph=True)], 1)

    return gradient


def check_refuses(call, least: int = 8) -> None:
    """Check that a function of correspondences and weights raises the right error for every kind of wrong ones."""
    for points1, points2, weights, error, message in _wrong_correspondences(least):
        raises(error, message, call, points1, points2, weights)


WRONG_MATRICES = [  # with two sets of points
    (None, TypeError, "F_mat must be a floating-point tensor, got <class 'NoneType'>"),
    (torch.ones(2, 3, 3, dtype=torch.int64), TypeError, "F_mat must be .* got torch.int64"),
    (torch.ones(3, 3), ShapeError, r"\[3, 3\]"),
    (torch.ones(2, 3, 2), ShapeError, r"\[2, 3, 2\]"),
    (torch.ones(3, 3, 3), ValueError, "got 3 matrices and 2 sets"),
    (torch.full((2, 3, 3), torch.nan), ValueError, "F_mat must be finite, got 18 NaN"),
    (torch.full((2, 3, 3), torch.inf), ValueError, "F_mat must be finite, got 18 NaN or infinite"),
    (torch.stack([torch.eye(3), torch.zeros(3, 3)]), ValueError, "F_mat must not be zero, got 1 zero"),
]

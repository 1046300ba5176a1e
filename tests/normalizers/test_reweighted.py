"""Reweighted whitening against its own algorithm in NumPy, and what it promises."""

import numpy as np
import pytest
import torch
from pairwise import pairwise
from scenes import SCENES, correspondences, epipolar_distances, homogeneous, numpy_hartley, numpy_whitening, uniform

from kornia_learnnorm import Hartley, ReweightedWhitening, Whitening, find_fundamental


def numpy_factor(x1, x2, F):
    """1 / |line in view 1| + 1 / |line in view 2|, each norm raised by a thousandth of their mean."""
    first, second = np.hypot(*(x2 @ F)[:, :2].T), np.hypot(*(x1 @ F.T)[:, :2].T)
    return 1 / (first + 1e-3 * first.mean()) + 1 / (second + 1e-3 * second.mean())


def numpy_reweighted(points1, points2, iterations, damping):
    """Iteratively reweighted least squares for sum |residual| of the rank-2 correction, sample by sample."""
    transforms = []
    H1, H2 = numpy_hartley(points1), numpy_hartley(points2)
    for p1, p2, h1, h2 in zip(points1.numpy(), points2.numpy(), H1, H2, strict=True):
        x1, x2 = homogeneous(p1) @ h1.T, homogeneous(p2) @ h2.T
        A = np.einsum("ni,nj->nij", x2, x1).reshape(-1, 9)
        F0 = np.linalg.svd(A, full_matrices=True)[2][-1].reshape(3, 3)
        w1 = w2 = numpy_factor(x1, x2, F0)
        (T1,), (T2,) = numpy_whitening(x1[None, :, :2], w1[None]), numpy_whitening(x2[None, :, :2], w2[None])
        b = T1.T @ np.linalg.svd(np.linalg.inv(T2).T @ F0 @ np.linalg.inv(T1))[2][2]
        a = best_line(x2, w2, F0.T, b)
        for k in range(iterations):
            if k:
                b, a = best_line(x1, w1, F0, a), best_line(x2, w2, F0.T, b)
            a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
            # det(F0 - s a b^T) = det(F0) (1 - s b^T F0^-1 a)
            factor = numpy_factor(x1, x2, F0 - np.outer(a, b) / (b @ np.linalg.solve(F0, a)))
            residual = factor * np.abs(x1 @ b) * np.abs(x2 @ a)
            shared = factor**2 / (residual + damping * residual.mean())
            w1, w2 = shared * (x2 @ a) ** 2, shared * (x1 @ b) ** 2
        (T1,), (T2,) = numpy_whitening(x1[None, :, :2], w1[None]), numpy_whitening(x2[None, :, :2], w2[None])
        transforms.append((T1 @ h1, T2 @ h2))
    return tuple(np.stack(T) for T in zip(*transforms, strict=True))


def best_line(x, w, F, a):
    """The b with the least sum of w (b^T x)^2 for which F - a b^T is singular: b^T F^-1 a = 1."""
    return np.linalg.solve(x.T @ (w[:, None] * x), np.linalg.solve(F, a))


def mean_distances(points1, points2, normalizer):
    F_mat = find_fundamental(points1, points2, normalizer=normalizer)
    return epipolar_distances(points1, points2, F_mat).mean(1)


class TestReweightedWhitening:
    @pairwise(name=SCENES, num_points=[8, 9, 50], options=[(0, 0.1), (1, 0.1), (3, 0.1), (2, 0.01), (2, 1.0)])
    def test_agrees_with_numpy(self, name, num_points, options, device):
        iterations, damping = options
        points1, points2 = correspondences(name, 20, num_points, seed=1)
        found = ReweightedWhitening(iterations, damping)(points1.to(device), points2.to(device))
        rtol, atol = (1e-6, 1e-8) if iterations else (1e-8, 1e-10)
        for T, expected in zip(found, numpy_reweighted(points1, points2, iterations, damping), strict=True):
            np.testing.assert_allclose(T.cpu().numpy(), expected, rtol=rtol, atol=atol)

    def test_more_iterations_lower_the_distance(self):
        points1, points2 = correspondences("random", 300)
        means = [mean_distances(points1, points2, ReweightedWhitening(k)).mean() for k in (0, 1, 2, 5, 10)]
        assert mean_distances(points1, points2, Hartley()).mean() > mean_distances(points1, points2, Whitening()).mean()
        assert mean_distances(points1, points2, Whitening()).mean() > means[0]
        assert means == sorted(means, reverse=True)

    @pytest.mark.parametrize(("name", "better", "ratio"), [("driving", 0.98, 0.6), ("handheld", 0.98, 0.8)])
    def test_beats_hartley(self, name, better, ratio):
        points1, points2 = correspondences(name, 500, noise=0.5)
        found, hartley = (mean_distances(points1, points2, n) for n in (ReweightedWhitening(), Hartley()))
        assert (found < hartley).mean() > better
        assert found.mean() < ratio * hartley.mean()
        assert np.median(found) < np.median(hartley)

    def test_gradients_of_undetermined_samples_do_not_explode(self):
        """View 1 on a line: the null vector, and with it every weight, is a matter of rounding."""
        line = uniform(20, 12, 1, high=600) * torch.tensor([1.0, 0.5])
        for iterations in (0, 1, 5):
            points = [line.clone().requires_grad_(), uniform(20, 12, 2, high=600, seed=1).requires_grad_()]
            T1, T2 = ReweightedWhitening(iterations)(*points)
            for gradient in torch.autograd.grad((T1 + T2).sum(), points):
                assert gradient.abs().max() < 1e3

    def test_values_do_not_depend_on_whether_gradients_are_wanted(self):
        line = uniform(20, 12, 1, high=600) * torch.tensor([1.0, 0.5])
        for points1 in (line, uniform(20, 12, 2, high=600)):
            points2 = uniform(20, 12, 2, high=600, seed=1)
            plain = ReweightedWhitening()(points1, points2)
            found = ReweightedWhitening()(points1.clone().requires_grad_(), points2)
            torch.testing.assert_close(found, plain, rtol=0, atol=0)

    @pytest.mark.parametrize(("iterations", "damping"), [(-1, 0.1), (3, 0.0), (3, -1.0)])
    def test_exceptions(self, iterations, damping):
        with pytest.raises(ValueError, match=rf"iterations .* damping > 0, got {iterations} and {damping}"):
            ReweightedWhitening(iterations, damping)

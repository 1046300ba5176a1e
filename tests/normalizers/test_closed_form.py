"""The closed-form normalisers against NumPy, and what reweighted whitening promises."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.epipolar import normalize_points
from pairwise import pairwise
from references import epipolar_distances, homogeneous, mapped, numpy_hartley, numpy_whitening
from scenes import SCENES, correspondences, uniform
from torch.autograd import gradcheck

from kornia_learnnorm import Hartley, PerView, ReweightedWhitening, Whitening, find_fundamental
from kornia_learnnorm.geometry.transforms import inverse_sqrt

CASES = {
    "hartley": (Hartley(), numpy_hartley, 1e-12, 1e-12),
    "whitening": (Whitening(), numpy_whitening, 1e-9, 1e-10),
    "kornia": (PerView(normalize_points), numpy_hartley, 1e-8, 0),  # Kornia adds 1e-8 to the mean distance
}


@pairwise(case=CASES, name=SCENES, num_points=[8, 50], weighted=[False, True])
def test_agrees_with_numpy(case, name, num_points, weighted, device):
    normalizer, reference, rtol, atol = CASES[case]
    points = correspondences(name, 20, num_points)
    weights = uniform(20, num_points) if weighted else None
    found = normalizer(*(p.to(device) for p in points), None if weights is None else weights.to(device))
    for p, T in zip(points, found, strict=True):
        np.testing.assert_allclose(T.cpu().numpy(), reference(p, weights), rtol=rtol, atol=atol)


class TestWhitening:
    @given(st.integers(0, 2**31), st.sampled_from([8, 40]), st.floats(-6, 6), st.sampled_from(["random", "driving"]))
    def test_covariance_becomes_the_identity(self, seed, num_points, log_scale, name):
        points1, points2 = (10**log_scale * p for p in correspondences(name, 5, num_points, seed))
        weights = uniform(5, num_points, low=0.05, seed=seed)
        for points, T in zip((points1, points2), Whitening()(points1, points2, weights), strict=True):
            for x, w, linear in zip(mapped(T, points), weights.numpy(), T[:, :2, :2], strict=True):
                assert np.average(x, axis=0, weights=w) == pytest.approx(0, abs=1e-7)
                np.testing.assert_allclose(np.cov(x.T, aweights=w, ddof=0), np.eye(2), atol=1e-5)
                assert torch.allclose(linear, linear.mT)  # symmetric: no rotation of its own
                assert (torch.linalg.eigvalsh(linear) > 0).all()

    @pytest.mark.parametrize("floor", [1e-6, 1e-3])
    def test_floor_of_collinear_points(self, floor):
        # Variance 2/3 * 9 = 6 along x and none along y: eigenvalues 6 (1 + floor) and 6 floor.
        points = torch.tensor([[[-3.0, 0.0], [0.0, 0.0], [3.0, 0.0]]], dtype=torch.float64)
        linear = Whitening(floor)(points, points)[0][0, :2, :2]
        expected = np.diag([(6 * (1 + floor)) ** -0.5, (6 * floor) ** -0.5])
        np.testing.assert_allclose(linear.numpy(), expected, rtol=1e-9)

    def test_gradients_where_the_variances_are_equal_or_nearly(self):
        square = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]]], dtype=torch.float64)
        assert gradcheck(lambda p: Whitening()(p, square)[0], [square.clone().requires_grad_()])
        for step in (1e-3, 1e-6, 1e-9, 1e-15):
            covariance = torch.tensor([[1 + step, step], [step, 1]], dtype=torch.float64).requires_grad_()
            (gradient,) = torch.autograd.grad((inverse_sqrt(covariance) * uniform(2, 2)).sum(), [covariance])
            assert gradient.abs().max() < 2  # half of the weights at most, and no division by the gap


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

"""Residuals of correspondences against formulas in NumPy and OpenCV."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from references import epipolar_distances, homogeneous, numpy_sampson
from scenes import ORIGIN, ROWS, SCENES, correspondences, plane, raises, scenes, uniform
from torch.autograd import gradcheck

import kornia_learnnorm as kln
from kornia_learnnorm import find_fundamental, symmetric_epipolar_distance, transfer_distance

POINTS, MATRICES = uniform(2, 8, 2), uniform(2, 3, 3)


def numpy_algebraic(points1, points2, F):
    x1, x2, F = homogeneous(points1.numpy()), homogeneous(points2.numpy()), F.numpy()
    return np.abs(np.einsum("bni,bij,bnj->bn", x2, F / np.linalg.norm(F, axis=(1, 2), keepdims=True), x1))


REFERENCES = {symmetric_epipolar_distance: epipolar_distances, kln.algebraic_distance: numpy_algebraic}
REFERENCES |= {kln.sampson_distance: lambda *values: np.abs(numpy_sampson(*values))}


@pytest.mark.parametrize("distance", REFERENCES)
class TestAll:
    @pytest.mark.parametrize("shape", [(0, 8), (1, 1), (3, 20)])
    def test_smoke(self, distance, shape, device, dtype):
        points1, points2 = (uniform(*shape, 2, high=600, seed=k).to(device, dtype) for k in (0, 1))
        found = distance(points1, points2, uniform(shape[0], 3, 3, seed=2).to(device, dtype))
        assert (found.shape, found.dtype, found.device.type) == (shape, dtype, device.type)
        assert (found >= 0).all()

    @pytest.mark.parametrize("name", SCENES)
    def test_agrees_with_numpy(self, distance, name, device):
        scene = scenes(name, 20, 30)
        found = distance(scene.points1.to(device), scene.points2.to(device), scene.F_mat.to(device)).cpu()
        expected = REFERENCES[distance](scene.points1, scene.points2, scene.F_mat)
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9, atol=1e-10)
        alone = distance(*(value[0] for value in scene[:2]), scene.F_mat[0])  # without a batch
        assert torch.allclose(alone, found[0])

    @given(st.integers(0, 2**31), st.sampled_from([1e-6, -1.0, 3.0, 1e6]))
    def test_scale_of_the_matrix_does_not_matter(self, distance, seed, factor):
        points1, points2, F_mat = (uniform(2, *s, seed=seed + k) for k, s in enumerate([(5, 2), (5, 2), (3, 3)]))
        expected = distance(points1, points2, F_mat)
        assert torch.allclose(distance(points1, points2, factor * F_mat), expected, rtol=1e-9)
        assert torch.allclose(distance(points2, points1, F_mat.mT), expected, rtol=1e-9)  # views swapped

    def test_exact_correspondences_have_none_and_no_gradient(self, distance):
        points1 = torch.tensor([[[1.0, 5.0], [2.0, 7.0]]]).requires_grad_()
        points2 = torch.tensor([[[9.0, 5.0], [-2.0, 7.0]]]).requires_grad_()
        F_mat = ROWS[None].clone().requires_grad_()
        found = distance(points1, points2, F_mat)
        assert found.count_nonzero() == 0
        for gradient in torch.autograd.grad(found.sum(), [points1, points2, F_mat]):
            assert gradient.count_nonzero() == 0

    def test_gradcheck(self, distance):
        values = [uniform(2, *s, low=-1, seed=k).requires_grad_() for k, s in enumerate([(5, 2), (5, 2), (3, 3)])]
        assert gradcheck(distance, values)

    @pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
    def test_autocast_changes_nothing(self, distance, half):
        points1, points2 = (p.float().requires_grad_() for p in correspondences("driving", 3, 20))
        F_mat = find_fundamental(points1, points2).detach()
        expected = distance(points1, points2, F_mat)
        with torch.autocast("cpu", half):
            found = distance(points1, points2, F_mat)
        assert torch.equal(found, expected)
        assert torch.equal(*(torch.autograd.grad(v.clamp(max=1e4).sum(), points1)[0] for v in (found, expected)))


@pytest.mark.parametrize("distance", [*REFERENCES, transfer_distance])
def test_exceptions(distance):
    for points1, points2, matrices, error, message in [
        (torch.rand(2, 8, 3), POINTS, MATRICES, ShapeError, r"\[2, 8, 3\]"),
        (POINTS, POINTS, MATRICES[:, 0], ShapeError, r"\[2, 3\]"),
        (POINTS, POINTS[:, :1], MATRICES, ValueError, r"\[2, 8, 2\] and \[2, 1, 2\]"),
        (POINTS, POINTS, uniform(3, 3, 3), ValueError, r"one batch, got shapes .* and \[3, 3, 3\]"),
        (POINTS.long(), POINTS, MATRICES, TypeError, "points1 must be .* got torch.int64"),
        (POINTS, POINTS.half(), MATRICES, TypeError, "points2 must be a float32 or float64 tensor, got torch.float16"),
        (POINTS, POINTS, None, TypeError, "[FH]_mat must be .* got <class 'NoneType'>"),
        (POINTS, POINTS, MATRICES.float(), TypeError, "one dtype"),
    ]:
        raises(error, message, distance, points1, points2, matrices)


@pytest.mark.long
def test_compile_as_one_graph():
    points = correspondences("driving", 3, 20)
    F_mat = find_fundamental(*points)

    def every(*arguments):
        return tuple(distance(*arguments) for distance in REFERENCES)

    compiled = torch.compile(every, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(*points, F_mat), every(*points, F_mat))


class TestSymmetricEpipolarDistance:
    def test_is_infinite_on_the_epipole_without_gradient(self):
        F_mat, points1 = ORIGIN[None].clone().requires_grad_(), torch.zeros(1, 1, 2).requires_grad_()
        found = symmetric_epipolar_distance(points1, torch.tensor([[[3.0, 4.0]]]), F_mat)
        assert found.isinf()
        for gradient in torch.autograd.grad(found.sum(), [F_mat, points1]):
            assert gradient.count_nonzero() == 0

    def test_is_infinite_on_the_epipole_up_to_rounding(self):
        """Three matches that share a point put the epipole on it; which side of it is a matter of rounding."""
        points1, points2 = correspondences("handheld", 20)
        points2[:, :3] = points2[:, :1]
        distance = symmetric_epipolar_distance(points1, points2, find_fundamental(points1, points2))
        assert distance[:, :3].isinf().all()
        assert distance[:, 3:].isfinite().all()


class TestTransferDistance:
    def test_agrees_with_numpy(self):
        points1, points2, H = plane(noise=2.0)
        there, back = (homogeneous(p.numpy()) @ M.mT.numpy() for p, M in ((points1, H), (points2, H.inverse())))
        errors = [x[..., :2] / x[..., 2:] - p.numpy() for x, p in ((there, points2), (back, points1))]
        expected = np.sqrt((np.concatenate(errors, -1) ** 2).sum(-1))
        np.testing.assert_allclose(transfer_distance(points1, points2, -3 * H), expected, rtol=1e-9)
        assert transfer_distance(points1.float(), points2.float(), H.float()).dtype == torch.float32
        one, shared = (transfer_distance(*(p[i] for p in (points1, points2)), H[0]) for i in (0, slice(1)))
        np.testing.assert_allclose([one, shared[0]], expected[[0, 0]], rtol=1e-9)
        points1[0, 1, 0] = H[1, 2, 2] = torch.nan
        unknown = transfer_distance(points1, points2, H).isnan()
        assert (unknown.sum(1)[:2].tolist(), unknown[0, 1], unknown[1].all()) == ([1, len(unknown[1])], True, True)

    def test_gradcheck(self):
        values = [v.requires_grad_() for v in (uniform(2, 5, 2), uniform(2, 5, 2, seed=1), 1 + uniform(2, 3, 3))]
        assert gradcheck(lambda p, q, H: transfer_distance(p, q, H + 2 * torch.eye(3)), values)

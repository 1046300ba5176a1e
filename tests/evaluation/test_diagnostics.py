"""Diagnostics of a normalisation against NumPy, and what does not change them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pairwise import pairwise
from references import epipolar_distances, homogeneous, null_matrices
from scenes import SCENES, correspondences, uniform

from kornia_learnnorm import Hartley, Identity, ReweightedWhitening, Whitening
from kornia_learnnorm.evaluation import diagnostics
from kornia_learnnorm.evaluation.diagnostics import diagnose


def numpy_diagnose(points1, points2, T1, T2) -> np.ndarray:
    """All five numbers (B, 5): eigenvalues of A^T A, and the eight-point algorithm in two steps."""
    T1, T2 = np.asarray(T1), np.asarray(T2)
    x1, x2 = (homogeneous(np.asarray(p)) @ T.swapaxes(1, 2) for p, T in ((points1, T1), (points2, T2)))
    A = (x2[..., :, None] * x1[..., None, :]).reshape(*x1.shape[:2], 9)
    d = np.linalg.eigvalsh(A.swapaxes(1, 2) @ A)[:, ::-1]
    U, s, Vh = np.linalg.svd(null_matrices(points1, points2, T1, T2))
    matrices = (T2.swapaxes(1, 2) @ (U * r[:, None]) @ Vh @ T1 for r in (s, s * [1, 1, 0]))
    before, after = (epipolar_distances(points1, points2, F).mean(1) for F in matrices)
    distances = [np.linalg.norm(x[..., :2], axis=-1).mean(1) for x in (x1, x2)]
    return np.stack([np.sqrt(d[:, 0] / d[:, 7]), s[:, 1] / s[:, 2], *distances, 1 - before / after], 1)


class TestDiagnose:
    @pairwise(batch_size=[0, 1, 3], num_points=[8, 20])
    def test_smoke(self, batch_size, num_points, device, dtype):
        points = [p.to(device, dtype) for p in correspondences("handheld", 3, num_points)]
        found = diagnose(*(p[:batch_size] for p in points), Hartley())
        assert isinstance(found, diagnostics.Diagnostics)
        for values in found:
            assert (values.shape, values.dtype, values.device.type) == ((batch_size,), torch.float64, device.type)
            assert torch.isfinite(values).all()

    @pairwise(name=SCENES, num_points=[8, 20], normalizer=[Identity(), Hartley(), Whitening(), ReweightedWhitening(3)])
    def test_agrees_with_numpy(self, name, num_points, normalizer, device):
        options = {} if name == "random" else {"noise": 0.5}
        points = correspondences(name, 10, num_points, **options)
        found = torch.stack(diagnose(*(p.to(device) for p in points), normalizer), 1).cpu().numpy()
        expected = numpy_diagnose(*points, *normalizer(*points))
        loose = isinstance(normalizer, Identity)  # In pixels, eigenvalues of A^T A lose twice the digits.
        np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=1e-2 if loose else 1e-5)
        np.testing.assert_allclose(found[:, 1:], expected[:, 1:], rtol=1e-3 if loose else 1e-6, atol=1e-6)

    @given(st.integers(0, 2**31), st.sampled_from([8, 9, 20]), st.floats(-2, 2), st.randoms())
    def test_order_scale_and_shift_do_not_matter_to_hartley(self, seed, num_points, log_scale, random):
        """One scale for both views, which the sum of their distances asks for; the share has no unit."""
        points = correspondences("handheld", 3, num_points, seed, noise=1.0)
        order, shifts = random.sample(range(num_points), num_points), uniform(2, 2, low=-2e3, high=2e3, seed=seed)
        expected = torch.stack(diagnose(*points, Hartley()))
        shuffled = torch.stack(diagnose(*(p[:, order] for p in points), Hartley()))
        torch.testing.assert_close(shuffled, expected, rtol=1e-6, atol=1e-6)
        moved = [10**log_scale * (p + o) for p, o in zip(points, shifts, strict=True)]
        torch.testing.assert_close(torch.stack(diagnose(*moved, Hartley())), expected, rtol=1e-5, atol=1e-5)

    def test_exceptions(self):
        with pytest.raises(ValueError, match="at least 8 correspondences are needed, got 7"):
            diagnose(torch.rand(2, 7, 2), torch.rand(2, 7, 2), Hartley())

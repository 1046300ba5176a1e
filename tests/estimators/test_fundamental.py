"""The eight-point algorithm against a reference in NumPy, OpenCV, and the properties that it must have."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pairwise import pairwise
from scenes import (
    SCENES,
    correspondences,
    eight_point,
    hartley_difference,
    numpy_hartley,
    numpy_whitening,
    uniform,
    up_to_sign,
)

from kornia_learnnorm import Hartley, Identity, Whitening, find_fundamental

# Each normaliser with its independent computation.
REFERENCES = {
    "identity": (Identity(), lambda points, weights=None: np.broadcast_to(np.eye(3), (len(points), 3, 3))),
    "hartley": (Hartley(), numpy_hartley),
    "whitening": (Whitening(), numpy_whitening),
}


class TestFindFundamental:
    @pairwise(name=SCENES, num_points=[8, 9, 50], reference=REFERENCES, weighted=[False, True])
    def test_agrees_with_numpy(self, name, num_points, reference, weighted, device):
        points1, points2 = correspondences(name, 20, num_points)
        weights = uniform(20, num_points, low=0.01, seed=5) if weighted else None
        normalizer, transform = REFERENCES[reference]
        on_device = [None if v is None else v.to(device) for v in (points1, points2, weights)]
        F_mat = find_fundamental(*on_device, normalizer).cpu()
        expected = eight_point(points1, points2, transform(points1, weights), transform(points2, weights), weights)
        # In pixels the design matrix has a condition number of 1e10, and either computation loses as many digits.
        pixels, hartley = (1e-7, 1e-7) if reference == "identity" else (1e-9, 1e-9)
        assert up_to_sign(F_mat, expected) < pixels
        assert hartley_difference(F_mat, expected, points1, points2) < hartley

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    @pytest.mark.parametrize("num_points", [8, 50])
    def test_agrees_with_opencv(self, name, num_points):
        cv2 = pytest.importorskip("cv2")
        points1, points2 = correspondences(name, 20, num_points)
        pairs = zip(points1.numpy(), points2.numpy(), strict=True)
        expected = np.stack([cv2.findFundamentalMat(a, b, cv2.FM_8POINT)[0] for a, b in pairs])
        F_mat = find_fundamental(points1, points2)
        assert hartley_difference(F_mat, expected, points1, points2) < 2e-4  # eigenvectors of A^T A: half of the digits

    @pytest.mark.parametrize("normalizer", [Hartley(), Whitening()])
    @given(st.integers(0, 2**31), st.sampled_from([8, 15]), st.lists(st.floats(-1, 1), min_size=6, max_size=6))
    def test_moves_with_similarities_or_affinities(self, normalizer, seed, num_points, entries):
        points1, points2 = correspondences("handheld", 4, num_points, seed)
        a, b, c, d, x, y = entries
        linear = [[a, -b], [b, a]] if isinstance(normalizer, Hartley) else [[a, b], [c, d]]
        S = torch.eye(3, dtype=torch.float64)
        S[:2, :2] += 0.45 * torch.tensor(linear, dtype=torch.float64)
        S[:2, 2] = 500 * torch.tensor([x, y], dtype=torch.float64)
        moved = points2 @ S[:2, :2].mT + S[:2, 2]
        F_mat = find_fundamental(points1, points2, normalizer=normalizer)
        pulled_back = S.mT @ find_fundamental(points1, moved, normalizer=normalizer)
        assert hartley_difference(F_mat, pulled_back, points1, points2) < 1e-6


@pytest.mark.parametrize("rank2", [None, True])
def test_wrong_rank2(rank2):
    with pytest.raises(ValueError, match=f"rank2 must be 'projection' or 'optimal', got {rank2}"):
        find_fundamental(torch.rand(2, 8, 2), torch.rand(2, 8, 2), rank2=rank2)

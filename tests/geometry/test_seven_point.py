"""The matrices of rank 2 in a span of two, against OpenCV's seven-point algorithm."""

import pytest
import torch
from scenes import correspondences, homogeneous, up_to_sign

from kornia_learnnorm.geometry.seven_point import fundamental_in_span


def null_spaces(points1, points2):
    """Bases of the matrices that fit seven correspondences exactly."""
    x1, x2 = (torch.from_numpy(homogeneous(p.numpy())) for p in (points1, points2))
    rows = (x2[..., :, None] * x1[..., None, :]).flatten(2)
    return torch.unflatten(torch.linalg.svd(rows)[2][:, 7:], -1, (3, 3))


def test_agrees_with_opencv():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    points1, points2 = ((p - 300) / 200 for p in correspondences("handheld", 20, 7))
    found, real = fundamental_in_span(null_spaces(points1, points2))
    assert torch.linalg.det(found[real]).abs().max() < 1e-12
    for k in range(20):
        expected = torch.from_numpy(cv2.findFundamentalMat(points1[k].numpy(), points2[k].numpy(), cv2.FM_7POINT)[0])
        expected = torch.unflatten(expected, 0, (-1, 3))
        expected = expected / torch.linalg.matrix_norm(expected, keepdim=True)
        assert len(expected) == real[k].sum()
        for F_mat in expected:
            assert min(up_to_sign(own[None], F_mat[None]) for own in found[k, real[k]]) < 1e-5

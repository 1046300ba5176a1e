"""Focal lengths against those of the cameras that made the matches, where they are determined and where not."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scenes import DTYPES, raises, scenes
from torch.autograd import gradcheck

from kornia_learnnorm.geometry.focal_length import focal_lengths


def inputs(name="handheld", number=20):
    """What focal_lengths takes, of scenes whose second camera has pixels of half the size, and the true ones."""
    scene, double = scenes(name, number), torch.tensor([2.0, 2.0, 1.0]).double().diag()
    F_mat, K1, K2 = double.inverse() @ scene.F_mat, scene.K1, double @ scene.K2
    return (F_mat, K1[:, :2, 2], K2[:, :2, 2]), (K1[:, 0, 0], K2[:, 0, 0])


@pytest.mark.parametrize(("dtype", "number"), [(dtype, number) for dtype in DTYPES for number in (0, 1, 20)])
def test_exact_matrices(dtype, number, device):
    values, truth = inputs(number=20)
    found = focal_lengths(*(value[:number].to(device, dtype) for value in values))
    assert found.determined.sum() >= number // 2
    for focal, expected in zip(found[:2], truth, strict=True):
        expected = torch.where(found.determined.cpu(), expected[:number], torch.nan).to(dtype)
        torch.testing.assert_close(focal.cpu(), expected, equal_nan=True, rtol=1e-3, atol=0)


@pytest.mark.parametrize("name", ["orbit", "driving"])
def test_axes_that_meet_and_forward_motion_determine_none(name):
    F_mat, *principal = inputs(name)[0]
    found = focal_lengths(F_mat.requires_grad_(), *principal)
    assert not found.determined.any()
    assert not torch.autograd.grad(found.focal1.nansum(), F_mat)[0].any()


@given(st.floats(0.1, 10), st.floats(-500, 500))
def test_swap_scale_and_translation_of_the_pixels(factor, shift):
    F_mat, *principal = inputs(number=5)[0]
    T = torch.tensor([[factor, 0, shift], [0, factor, -shift], [0, 0, 1]]).double().inverse()
    second, first = (point @ T.inverse()[:2, :2] + T.inverse()[:2, 2] for point in principal)
    focal2, focal1, _ = focal_lengths((T.mT @ F_mat @ T).mT, first, second)
    expected = [factor * focal for focal in focal_lengths(F_mat, *principal)[:2]]
    torch.testing.assert_close([focal1, focal2], expected, equal_nan=True, rtol=1e-6, atol=0)


def test_gradcheck():
    F_mat, *principal = inputs(number=3)[0]
    size = torch.tensor([500.0, 500, 1]).double().diag()  # entries of one magnitude
    values = [1e3 * size @ F_mat @ size, *(point / 500 for point in principal)]
    assert focal_lengths(*values).determined.all()
    assert gradcheck(lambda *x: focal_lengths(*x)[:2], [value.requires_grad_() for value in values], rtol=1e-2)


def test_exceptions():
    F_mat, first, second = inputs(number=2)[0]
    raises(TypeError, "F_mat must be a floating-point tensor", focal_lengths, None, first, second)
    raises(ShapeError, "principal2", focal_lengths, F_mat, first, second[0])
    raises(ValueError, "one of principal1 per matrix is needed, got 1 and 2", focal_lengths, F_mat, first[:1], second)

"""What every normaliser promises: shapes, no dependence on the view or absent points, finite values, errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import normalize_points
from pairwise import pairwise
from scenes import DTYPES, check_refuses, correspondences, paper, shaken, small, uniform

from kornia_learnnorm import Hartley, Identity, PerView, ReweightedWhitening, Whitening
from kornia_learnnorm.evaluation.search import SearchedNormalizer

CLOSED_FORM = {
    "identity": Identity,
    "hartley": Hartley,
    "whitening": Whitening,
    "kornia": lambda: PerView(normalize_points),
    "reweighted": ReweightedWhitening,
}
LEARNED = {"learned": lambda: shaken(small()), "paper": lambda: shaken(paper())}
DIRECT = CLOSED_FORM | LEARNED
ALL = DIRECT | {"searched": lambda: SearchedNormalizer(steps=2)}  # whose rounding errors grow with every step


@pairwise(name=ALL, batch_size=[0, 1, 4], num_points=[8, 30], weighted=[False, True], dtype=DTYPES)
def test_smoke(name, batch_size, num_points, weighted, dtype, device):
    points = [uniform(batch_size, num_points, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
    weights = uniform(batch_size, num_points, low=0.1, seed=2).to(device, dtype) if weighted else None
    for T in ALL[name]().to(device)(*points, weights):
        assert (T.shape, T.dtype, T.device.type) == ((batch_size, 3, 3), dtype, device.type)
        assert torch.isfinite(T).all()
        assert torch.equal(T[:, 2].cpu(), torch.tensor([[0, 0, 1]], dtype=dtype).expand(batch_size, 3))  # affine


@pytest.mark.parametrize("name", DIRECT)
def test_swapped_views_give_swapped_transforms(name):
    points1, points2 = correspondences("driving", 10, 12)
    normalizer, weights = ALL[name]().double(), uniform(10, 12, low=0.1)
    T1, T2 = normalizer(points1, points2, weights)
    torch.testing.assert_close(normalizer(points2, points1, weights), (T2, T1), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in DIRECT if name != "identity"])
def test_zero_weight_is_absence(name):
    normalizer, bound = ALL[name]().double(), 1e-8 if name in ("reweighted", "learned") else 1e-12  # null vectors
    points, weights = correspondences("handheld", 10, 9), uniform(10, 9, low=0.1)
    junk = uniform(10, 3, 2, low=-1e4, high=1e4)
    extended = [torch.cat(pair, 1) for pair in zip((*points, weights), (junk, -junk, 0 * junk[..., 0]), strict=True)]
    torch.testing.assert_close(normalizer(*extended), normalizer(*points, weights), rtol=bound, atol=bound)


@pytest.mark.parametrize("name", ["hartley", "whitening"])
def test_weights_that_are_all_zero_are_equal_weights(name):
    points, zeros = correspondences("handheld", 10, 9), torch.zeros(10, 9, dtype=torch.float64)
    torch.testing.assert_close(ALL[name]()(*points, zeros), ALL[name]()(*points), rtol=1e-12, atol=1e-8)


@pytest.mark.parametrize("name", ["hartley", "whitening", "reweighted", *LEARNED, "searched"])
def test_float32_is_solved_in_float64(name):
    normalizer, points = ALL[name](), [p.float() + 1e4 for p in correspondences("handheld", 20, 8)]  # far away
    expected = tuple(T.float() for T in normalizer(*(p.double() for p in points)))
    torch.testing.assert_close(normalizer(*points), expected, rtol=0, atol=0)


@pytest.mark.parametrize("name", CLOSED_FORM)
def test_has_no_state(name):
    assert not ALL[name]().state_dict()


@pairwise(
    name=["hartley", "whitening"],
    num_points=[8, 9, 100],
    value=[0.0, 5.0, 320.1, 1e6 / 3],  # of which no sum need be exact
    weighted=[False, True],
    dtype=DTYPES,
)
def test_coincident_points_keep_their_scale(name, num_points, value, weighted, dtype):
    points = torch.full((1, num_points, 2), value, dtype=dtype)
    weights = 10 ** uniform(1, num_points, low=-6, high=6, dtype=dtype) if weighted else None
    for T in ALL[name]()(points, points, weights):
        np.testing.assert_allclose(T[0].numpy(), [[1, 0, -value], [0, 1, -value], [0, 0, 1]], rtol=1e-5)


@pytest.mark.parametrize("name", ["reweighted", *LEARNED, "searched"])
def test_exceptions(name):
    check_refuses(ALL[name]())

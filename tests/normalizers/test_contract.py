"""What every normaliser promises: shapes, no dependence on order, view or absent points, finite values, errors."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.epipolar import normalize_points
from pairwise import pairwise
from references import check_refuses
from scenes import DTYPES, correspondences, paper, shaken, small, uniform

import kornia_learnnorm as kln
from kornia_learnnorm.evaluation.searched_normalizer import SearchedNormalizer

CLOSED_FORM = {"identity": kln.Identity, "hartley": kln.Hartley, "whitening": kln.Whitening}
CLOSED_FORM |= {"kornia": lambda: kln.PerView(normalize_points), "reweighted": kln.ReweightedWhitening}
LEARNED = {
    "own": lambda: shaken(small(features="own")),
    "both": lambda: shaken(small(features="both")),
    "epipolar": lambda: shaken(small()),
    "three parameters": lambda: shaken(small(num_parameters=3)),
    "paper": lambda: shaken(paper()),
}
DIRECT = CLOSED_FORM | LEARNED
ALL = DIRECT | {"searched": lambda: SearchedNormalizer(steps=2)}  # whose rounding errors grow with every step
SOLVED = ("reweighted", "epipolar", "three parameters")  # by a null vector, whose rounding the others do not have
WEIGHED = [name for name in DIRECT if name not in ("identity", "kornia")]  # weights have an effect


def check_same(found, expected, name, size=1e-12):
    tolerance = 1e-7 if name in SOLVED else size
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


@pairwise(name=ALL, batch_size=[0, 1, 4], num_points=[8, 30], weighted=[False, True], dtype=DTYPES)
def test_smoke(name, batch_size, num_points, weighted, dtype, device):
    points = [uniform(batch_size, num_points, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
    weights = uniform(batch_size, num_points, low=0.1, seed=2).to(device, dtype) if weighted else None
    for T in ALL[name]().to(device)(*points, weights):
        assert (T.shape, T.dtype, T.device.type) == ((batch_size, 3, 3), dtype, device.type)
        assert torch.isfinite(T).all()
        assert torch.equal(T[:, 2].cpu(), torch.tensor([[0, 0, 1]], dtype=dtype).expand(batch_size, 3))  # affine
        assert name != "identity" or (T.cpu() == torch.eye(3)).all()


@pytest.mark.parametrize("name", DIRECT)
@settings(max_examples=5)
@given(seed=st.integers(0, 2**31), num_points=st.sampled_from([8, 9, 20]), random=st.randoms())
def test_order_does_not_matter(name, seed, num_points, random):
    normalizer, points = ALL[name]().double(), correspondences("handheld", 3, num_points, seed)
    order, weights = random.sample(range(num_points), num_points), uniform(3, num_points, low=0.1, seed=seed)
    for values in (points, (*points, weights)):
        found, expected = normalizer(*(value[:, order] for value in values)), normalizer(*values)
        torch.testing.assert_close(found, expected, rtol=1e-4 if name in SOLVED else 1e-10, atol=1e-6)


@pairwise(name=DIRECT, num_points=[8, 20])
def test_swapped_views_give_swapped_transforms(name, num_points):
    points1, points2 = correspondences("driving", 10, num_points)
    normalizer, weights = ALL[name]().double(), uniform(10, num_points, low=0.1)
    T1, T2 = normalizer(points1, points2, weights)
    check_same(normalizer(points2, points1, weights), (T2, T1), name, 1e-9)


@pairwise(name=[name for name in DIRECT if name != "identity"], num_points=[8, 9, 20], size=[1.0, 1e4])
def test_zero_weight_is_absence(name, num_points, size):
    normalizer, points = ALL[name]().double(), correspondences("handheld", 10, num_points)
    # Eight equations are solved exactly whatever their weights, more of them by their squares.
    weights = torch.ones(10, 8).double() if name in SOLVED and num_points == 8 else uniform(10, num_points, low=0.1)
    junk = uniform(10, 3, 2, low=-size, high=size)
    extended = [torch.cat(pair, 1) for pair in zip((*points, weights), (junk, -junk, 0 * junk[..., 0]), strict=True)]
    check_same(normalizer(*extended), normalizer(*points, weights), name)


@pairwise(name=WEIGHED, num_points=[8, 9, 30], most=[1, 3], factor=[1e-3, 1.0, 1e3])
def test_whole_weights_are_repetitions_up_to_a_factor(name, num_points, most, factor):
    normalizer, points = ALL[name]().double(), correspondences("handheld", 10, num_points)
    counts = torch.arange(num_points) % (1 if num_points == 8 else most) + 1  # eight are solved whatever their weights
    repeated = [p.repeat_interleave(counts, 1) for p in points]
    check_same(normalizer(*points, factor * counts.double().expand(10, -1)), normalizer(*repeated), name, 1e-10)


@pytest.mark.parametrize("name", ["hartley", "whitening"])
def test_weights_that_are_all_zero_are_equal_weights(name):
    points, zeros = correspondences("handheld", 10, 9), torch.zeros(10, 9, dtype=torch.float64)
    torch.testing.assert_close(ALL[name]()(*points, zeros), ALL[name]()(*points), rtol=1e-12, atol=1e-8)


@pytest.mark.parametrize("name", ["hartley", "whitening", "reweighted", *LEARNED, "searched"])
def test_float32_is_solved_in_float64(name):
    normalizer, points = ALL[name](), [p.float() + 1e4 for p in correspondences("handheld", 20, 8)]  # far away
    expected = tuple(T.float() for T in normalizer(*(p.double() for p in points)))
    torch.testing.assert_close(normalizer(*points), expected, rtol=0, atol=0)


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


@pytest.mark.parametrize("name", ["reweighted", "epipolar", "paper", "searched"])
def test_exceptions(name):
    check_refuses(ALL[name]())

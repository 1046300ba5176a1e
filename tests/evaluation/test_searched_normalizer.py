"""The searched normaliser: never worse than its base, as good as a random search, and what it may not do."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pairwise import pairwise
from references import eight_point, epipolar_distances
from scenes import SCENES, correspondences, raises, shaken, uniform

from kornia_learnnorm import Hartley, ReweightedWhitening, Whitening
from kornia_learnnorm.evaluation.searched_normalizer import SearchedNormalizer
from kornia_learnnorm.geometry.transforms import spd_transform

BASES = {"hartley": Hartley(), "whitening": Whitening(), "reweighted": ReweightedWhitening(), "learned": shaken()}


def mean_distances(points1, points2, normalizer) -> np.ndarray:
    """Mean symmetric epipolar distance of every sample, by NumPy from the transforms on."""
    T1, T2 = normalizer(points1, points2)
    return epipolar_distances(points1, points2, eight_point(points1, points2, T1, T2)).mean(1)


def test_exceptions():
    raises(ValueError, "steps must be positive, got 0", SearchedNormalizer, steps=0)


@pairwise(base=BASES, scene=SCENES, num_points=[8, 20])
@torch.no_grad()
def test_never_worse_than_its_base(base, scene, num_points):
    points = correspondences(scene, 12, num_points)
    found = mean_distances(*points, SearchedNormalizer(BASES[base], steps=50))
    assert (found <= mean_distances(*points, BASES[base]) * (1 + 1e-6) + 1e-6).all()


@pytest.mark.parametrize("scene", ["driving", "handheld"])
def test_no_worse_than_a_random_search(scene):
    """Thousands of random parameters for one sample, each through the eight-point algorithm in NumPy."""
    points = correspondences(scene, 3)
    found = mean_distances(*points, SearchedNormalizer(Hartley()))
    random = np.random.default_rng(0)
    for p1, p2, least in zip(*points, found, strict=True):
        spread = 10 ** random.uniform(-2, 0.3, (1500, 1))
        bases = Hartley()(p1[None], p2[None])
        T1, T2 = (spd_transform(torch.from_numpy(spread * random.normal(size=(1500, 5)))) @ T for T in bases)
        p1, p2 = (p.expand(1500, 8, 2) for p in (p1, p2))
        assert least < epipolar_distances(p1, p2, eight_point(p1, p2, T1, T2)).mean(1).min()


def check_same(found, expected, tolerance=1e-4):
    """Rounding grows with every step, so few steps are compared."""
    for T, want in zip(found, expected, strict=True):
        assert ((T - want).norm(dim=(-2, -1)) / want.norm(dim=(-2, -1))).max() < tolerance


@pytest.mark.parametrize("num_points", [8, 20])
def test_samples_do_not_influence_each_other(num_points):
    points, normalizer = correspondences("handheld", 6, num_points), SearchedNormalizer(steps=10)
    together = normalizer(*points)
    for k in range(6):
        check_same(normalizer(*(p[k : k + 1] for p in points)), [T[k : k + 1] for T in together], 1e-6)
    spoilt = [torch.cat([torch.ones(1, num_points, 2), p]) for p in points]
    check_same([T[1:] for T in normalizer(*spoilt)], together, 1e-6)


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([8, 20]), st.sampled_from([1e-9, 1e-3, 1e6]), st.randoms())
def test_order_views_unit_and_absent_points_do_not_matter(seed, num_points, scale, random):
    points, normalizer = correspondences("handheld", 3, num_points, seed), SearchedNormalizer(steps=5)
    expected, order = normalizer(*points), random.sample(range(num_points), num_points)
    check_same(normalizer(*(p[:, order] for p in points)), expected)
    check_same(normalizer(*points[::-1])[::-1], expected)
    S = torch.diag(torch.tensor([scale, scale, 1.0])).double()
    check_same([T @ S for T in normalizer(*(scale * p for p in points))], expected)
    weights = uniform(3, num_points, low=0.5) if num_points > 8 else torch.ones(3, 8).double()
    check_same(normalizer(*points, torch.full_like(weights, 0.25)), expected)  # equal weights
    junk = [uniform(3, 4, 2, high=600, seed=k) for k in (1, 2)]
    extended = [torch.cat(p, 1) for p in zip((*junk, 0 * weights[:, :4]), (*points, weights), strict=True)]
    check_same(normalizer(*extended), normalizer(*points, weights))


class TestGradients:
    @pytest.mark.parametrize("learned", [False, True])
    def test_the_result_carries_none_and_the_points_stay_as_they_are(self, learned):
        base = shaken() if learned else ReweightedWhitening()
        values = [v.requires_grad_() for v in (*correspondences("handheld", 3), uniform(3, 8, low=0.5))]
        before = [v.detach().clone() for v in values]
        for T in SearchedNormalizer(base, steps=3)(*values):
            assert not T.requires_grad
        assert all(v.grad is None and torch.equal(v, b) for v, b in zip(values, before, strict=True))
        assert all(parameter.grad is None for parameter in base.parameters())

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
    def test_works_where_gradients_are_off_and_leaves_them_off(self, mode):
        points, normalizer = correspondences("handheld", 3), SearchedNormalizer(Hartley(), steps=10)
        expected = normalizer(*points)
        with mode():
            found = normalizer(*(p + 0 for p in points))
            assert not torch.is_grad_enabled()
        for T, want, H in zip(found, expected, Hartley()(*points), strict=True):
            assert torch.equal(T, want)
            assert not torch.allclose(T, H)


@pairwise(num_points=[8, 20], kind=["all equal", "collinear", "four places"], dtype=[torch.float32, torch.float64])
def test_finite_on_degenerate_samples(kind, num_points, dtype):
    t, places = uniform(4, num_points, 1, high=600), uniform(4, 4, 2, high=600)[:, torch.arange(num_points) % 4]
    kinds = {"all equal": 7 + 0 * places, "collinear": t * torch.tensor([1.0, 0.5]), "four places": places}
    points = kinds[kind].to(dtype)
    for weights in (None, torch.zeros(4, num_points)):
        assert torch.stack(SearchedNormalizer(steps=5)(points, points + 7, weights)).isfinite().all()

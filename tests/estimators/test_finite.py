"""Finite values and gradients on degenerate and extreme samples."""

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pairwise import pairwise
from scenes import DTYPES, LAYERS, refined, shaken, small, uniform

import kornia_learnnorm as kln
from kornia_learnnorm import EightPoint

NORMALIZERS = {  # with find_fundamental alone, which has no layer's safeguards
    "hartley": kln.Hartley,
    "whitening": kln.Whitening,
    "reweighted": kln.ReweightedWhitening,
    "learned": lambda: shaken(small()),
    "learned, reweighted": shaken,
}
HOMOGRAPHY = torch.tensor([[1.0, 0.1, 1e-4], [0.0, 1.1, 2e-4], [5.0, 3.0, 1.0]], dtype=torch.float64)


def base(num_points: int = 8, seed: int = 0, batch_size: int = 16) -> torch.Tensor:
    return uniform(batch_size, num_points, 2, high=600, seed=seed)


def direction(x: float, y: float) -> torch.Tensor:
    return torch.tensor([x, y], dtype=torch.float64)


def plane(points: torch.Tensor, homography: torch.Tensor = HOMOGRAPHY) -> torch.Tensor:
    x = torch.cat([points, torch.ones_like(points[..., :1])], -1) @ homography
    return x[..., :2] / x[..., 2:]


# Each makes both views of a batch of samples with N points.
SAMPLES = {
    "plain": lambda n: (base(n), base(n) + base(n, 1) / 30),
    "unrelated": lambda n: (base(n), base(n, 1)),
    "identical views": lambda n: (base(n), base(n)),
    "pure translation": lambda n: (base(n), base(n) + direction(3, 4)),
    "all zero": lambda n: (0 * base(n), 0 * base(n)),
    "all points equal": lambda n: (base(n)[:, :1].expand(-1, n, -1), base(n)[:, 1:2].expand(-1, n, -1)),
    "one view all equal": lambda n: (base(n)[:, :1].expand(-1, n, -1), base(n, 1)),
    "four places": lambda n: (base(n)[:, torch.arange(n) % 4], base(n, 1)[:, torch.arange(n) % 4]),
    "seven places": lambda n: (base(n)[:, torch.arange(n) % 7], base(n, 1)[:, torch.arange(n) % 7]),
    "collinear": lambda n: (base(n)[..., :1] * direction(1, 0.5), base(n)[..., :1] * direction(1, -0.3) + 7),
    "horizontal": lambda n: (base(n) * direction(1, 0), base(n, 1) * direction(1, 0)),
    "one view collinear": lambda n: (base(n)[..., :1] * direction(1, 0.5), base(n) + base(n, 1) / 200),
    "plane": lambda n: (base(n), plane(base(n))),
    "grid": lambda n: ((base(n) / 200).round() * 200, (base(n) / 200).round() * 200 + (base(n, 1) / 200).round()),
    **{f"scale {s:g}": lambda n, s=s: (s * base(n), s * (base(n) + base(n, 1) / 60)) for s in (1e-6, 1e-3, 1e3, 1e6)},
    "scales 1e-6 and 1e6": lambda n: (1e-6 * base(n), 1e6 * (base(n) + base(n, 1) / 60)),
    "offset 1e6": lambda n: (base(n) + 1e6, base(n) + 1e6 + base(n, 1) / 600),
    "one far point": lambda n: (base(n), torch.cat([base(n, 1)[:, 1:], 1e8 + base(n)[:, :1]], 1)),
}
WEIGHTS = {
    "random": lambda n: uniform(16, n, seed=5),
    "zeros": lambda n: uniform(16, n, seed=5) * (torch.arange(n) % 3 > 0),
    "one zero": lambda n: uniform(16, n, seed=5) * (torch.arange(n) > 0),
    "three left": lambda n: uniform(16, n, seed=5) * (torch.arange(n) >= n - 3),
    "all zero": lambda n: torch.zeros(16, n),
    "extreme": lambda n: 10 ** uniform(16, n, low=-6, high=6, seed=5),
}


def check(solve, parameters, points1, points2, weights=None):
    """Everything is finite: F, the loss, and the gradients of both in the points, weights and parameters."""
    values = [v.detach().clone().requires_grad_() for v in (points1, points2, weights) if v is not None]
    F_mat = solve(*values)
    assert torch.isfinite(F_mat).all()
    norms = np.linalg.norm(F_mat.detach().double().numpy(), axis=(1, 2))
    np.testing.assert_allclose(norms, 1, rtol=1e-6)
    assert solve is kln.find_homography or (np.linalg.svd(F_mat.detach().double().numpy())[1][:, 2] < 1e-6).all()
    direction = torch.randn(F_mat.shape, generator=torch.Generator().manual_seed(1)).to(F_mat)
    loss = kln.EpipolarLoss()(values[0], values[1], F_mat)
    assert torch.isfinite(loss)
    total = (F_mat * direction).sum() + loss
    for gradient in torch.autograd.grad(total, [*values, *parameters], allow_unused=True):
        assert gradient is None or torch.isfinite(gradient).all()


SOLVERS = {  # without a normaliser
    "homography": kln.find_homography,
    "optimal": partial(kln.find_fundamental, rank2="optimal"),
    "refined": partial(refined, steps=20),
    "refined, symmetric": partial(refined, steps=20, distance="symmetric", loss=kln.Cauchy(0.5)),
    "refined, truncated": partial(refined, steps=20, loss=kln.Truncated(3.0)),
}


def check_function(name, points1, points2, weights=None):
    normalizer = None if name in SOLVERS else NORMALIZERS[name]()
    solve = SOLVERS[name] if name in SOLVERS else partial(kln.find_fundamental, normalizer=normalizer)
    check(solve, [] if normalizer is None else normalizer.parameters(), points1, points2, weights)


@pairwise(name=[*NORMALIZERS, *SOLVERS], sample=SAMPLES, num_points=[8, 12], dtype=DTYPES)
def test_degenerate_and_extreme_samples(name, sample, num_points, dtype):
    points1, points2 = (points.to(dtype) for points in SAMPLES[sample](num_points))
    check_function(name, points1, points2)


@pairwise(
    name=["hartley", "whitening", "reweighted", "learned", "homography"],
    sample=["plain", "all points equal", "collinear", "one view collinear", "four places"],
    weights=WEIGHTS,
    num_points=[8, 12],
    dtype=DTYPES,
)
def test_with_weights(name, sample, weights, num_points, dtype):
    points1, points2 = (points.to(dtype) for points in SAMPLES[sample](num_points))
    check_function(name, points1, points2, WEIGHTS[weights](num_points).to(dtype))


@pairwise(name=NORMALIZERS, size=[1e-50, 1e50], num_points=[8, 12])
def test_sizes_that_the_layer_promises(name, size, num_points):
    layer = EightPoint(NORMALIZERS[name]())
    check(layer, layer.parameters(), size * base(num_points) / 600, size * base(num_points, 1) / 600)


@pytest.mark.parametrize("name", NORMALIZERS)
def test_many_correspondences(name, dtype):
    check_function(name, base(5000, 0, 2).to(dtype), base(5000, 1, 2).to(dtype))


@pytest.mark.parametrize("name", [*NORMALIZERS, "homography"])
@settings(max_examples=15)
@given(st.sampled_from([8, 9]), st.lists(st.integers(-2, 2), min_size=36, max_size=36))
@example(9, [int(n) - 1 for n in "112111211111120112112111121221111122"])
def test_small_whole_coordinates(name, num_points, coordinates):
    """Coordinates of which many coincide, so that every kind of degeneracy turns up."""
    points = torch.tensor(coordinates, dtype=torch.float64).view(2, 1, 9, 2)[:, :, :num_points]
    check_function(name, points[0], points[1])


def fuzzed(kind: str, nearness: float, num_points: int, size: int, seed: int):
    """A batch that is a share of ``nearness`` of its extent away from a degenerate one."""
    a, b = (uniform(size, num_points, 2, low=-1, seed=seed + k) for k in (0, 1))
    if kind == "coincident":
        points = a[:, :1].expand_as(a), b[:, :1].expand_as(b)
    elif kind == "collinear":
        points = a[..., :1] * b[:, :1], a[..., :1] * b[:, 1:2] + 0.3
    elif kind == "plane":
        points = a, plane(a, torch.eye(3).double() + uniform(3, 3, high=0.2, seed=seed))
    elif kind == "repeated":
        index = torch.arange(num_points) % (1 + seed % 8)
        points = a[:, index], b[:, index]
    elif kind == "far":
        points = a, torch.cat([b[:, 1:], 1e8 * b[:, :1]], 1)
    else:
        points = a, a if kind == "identical" else a @ torch.tensor([[0.6, 0.8], [-0.8, 0.6]]).double()
    noise = (uniform(size, num_points, 2, low=-nearness, high=nearness, seed=seed + k) for k in (2, 3))
    return [p + n for p, n in zip(points, noise, strict=True)]


FUZZ = {
    "kind": st.sampled_from(["coincident", "collinear", "plane", "identical", "repeated", "pure rotation", "far"]),
    "nearness": st.floats(-12, 0).map(lambda x: 10**x),
    "scale": st.floats(-6, 6).map(lambda x: 10**x),
    "offset": st.sampled_from([0.0, 1.0, 1e3, 1e6]),
    "num_points": st.sampled_from([8, 8, 9, 16]),
    "weighting": st.sampled_from([None, "random", "zeros", "extreme"]),
    "single": st.booleans(),
    "name": st.sampled_from([name for name in LAYERS if name != "whitening"]),
    "seed": st.integers(0, 2**20),
}


def fuzz(kind, nearness, scale, offset, num_points, weighting, single, name, seed, size) -> None:
    points = [scale * p + offset for p in fuzzed(kind, nearness, num_points, size, seed)]
    weights = None
    if weighting is not None:
        weights = uniform(size, num_points, seed=seed)
        weights = weights.round() * weights if weighting == "zeros" else weights
        weights = 10 ** (12 * weights - 6) if weighting == "extreme" else weights
    dtype = torch.float32 if single else torch.float64
    layer = LAYERS[name]()
    check(layer, layer.parameters(), *(None if value is None else value.to(dtype) for value in (*points, weights)))


class TestFiniteEverywhere:
    @pytest.mark.long
    @given(**FUZZ)
    def test_fuzz(self, **drawn):
        fuzz(size=100, **drawn)

    @pytest.mark.slow
    @settings(max_examples=500, derandomize=True)
    @given(**FUZZ)
    def test_hundred_thousand(self, **drawn):
        fuzz(size=200, **drawn)

"""What every network promises: no dependence on the order, the view or absent correspondences, zero until trained."""

from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pairwise import pairwise
from scenes import DTYPES, numpy_hartley, numpy_whitening, prepared, shaken, uniform

from kornia_learnnorm import CrossViewNetwork, LearnedNormalizer, PaperNetwork

UNTRAINED = {
    "own": lambda: CrossViewNetwork(width=16, depth=2, features="own"),
    "both": lambda: CrossViewNetwork(width=16, depth=2, features="both"),
    "epipolar": lambda: CrossViewNetwork(width=16, depth=2),
    "three parameters": lambda: CrossViewNetwork(width=16, depth=2, num_parameters=3),
    "paper": lambda: PaperNetwork(16, 3),
}
COUNTS = torch.tensor([1, 2, 3, 1, 2, 1, 1, 4, 1])


class Case:
    """A small network in float64 whose answers are not zero, and how exactly it computes them."""

    def __init__(self, name: str) -> None:
        self.network = shaken(LearnedNormalizer(network=UNTRAINED[name]())).network.double()
        self.solves = name in ("epipolar", "three parameters")  # a null vector, whose rounding the others do not have
        self.transform = numpy_hartley if name == "paper" else numpy_whitening

    def points(self, *args):
        return prepared(self.transform, *args)

    def agree(self, found, expected, atol=None) -> bool:
        atol = (1e-8 if self.solves else 1e-11) if atol is None else atol
        return all(torch.allclose(a, b, rtol=0, atol=atol) for a, b in zip(found, expected, strict=True))


@pytest.fixture(params=UNTRAINED)
def case(request):
    return Case(request.param)


@pairwise(name=UNTRAINED, batch_size=[0, 1, 3], num_points=[8, 9, 30], weighted=[False, True], dtype=DTYPES)
def test_untrained_answers_zero(name, batch_size, num_points, weighted, dtype, device):
    net = UNTRAINED[name]().to(device)
    points = [uniform(batch_size, num_points, 2, low=-1, seed=k).to(device, dtype) for k in (0, 1)]
    weights = uniform(batch_size, num_points, low=0.1).to(device, dtype) if weighted else None
    for params in net(*points, weights):
        assert params.shape == (batch_size, net.num_parameters)
        assert (params.dtype, params.device.type) == (dtype, device.type)
        assert params.count_nonzero() == 0


@pytest.mark.parametrize("name", UNTRAINED)
def test_untrained_can_start_to_learn(name):
    net = UNTRAINED[name]()
    torch.cat(net(*Case(name).points())).sum().backward()
    assert getattr(net, "set_network", net).head[-1].weight.grad.abs().sum() > 0
    assert all(torch.isfinite(parameter.grad).all() for parameter in net.parameters())


@settings(max_examples=12)
@given(st.integers(0, 2**31), st.sampled_from([8, 9, 20]), st.booleans(), st.randoms(), st.sampled_from([*UNTRAINED]))
def test_order_does_not_matter(seed, num_points, weighted, random, name):
    case, order = Case(name), random.sample(range(num_points), num_points)
    points = case.points("handheld", 3, num_points, seed)
    values = [*points, uniform(3, num_points, low=0.1, seed=seed)] if weighted else points
    shuffled = case.network(*(value[:, order] for value in values))
    assert case.agree(shuffled, case.network(*values), 1e-5 if case.solves else None)


@pairwise(name=UNTRAINED, scene=["driving", "handheld"], num_points=[8, 20], weighted=[False, True])
def test_swapped_views_swap_the_answers(name, scene, num_points, weighted):
    case = Case(name)
    points1, points2 = case.points(scene, 10, num_points)
    weights = uniform(10, num_points, low=0.1) if weighted else None
    answers = case.network(points1, points2, weights)
    assert not torch.allclose(*answers, atol=1e-3)
    assert case.agree(case.network(points2, points1, weights)[::-1], answers)


@pairwise(name=UNTRAINED, num_points=[8, 9, 20], size=[1.0, 20.0, 1e4])
def test_zero_weight_is_absence(name, num_points, size):
    case = Case(name)
    points = case.points("handheld", 10, num_points)
    weights = torch.ones(10, 8).double() if case.solves and num_points == 8 else uniform(10, num_points, low=0.5)
    junk = [uniform(10, 5, 2, low=-size, high=size, seed=seed) for seed in (1, 2)]
    extended = [torch.cat(p, 1) for p in zip((*junk, 0 * weights[:, :5]), (*points, weights), strict=True)]
    assert case.agree(case.network(*extended), case.network(*points, weights))


def test_whole_weights_are_repetitions(case):
    points = case.points("handheld", 10, 9)
    repeated = [p.repeat_interleave(COUNTS, 1) for p in points]
    assert case.agree(case.network(*points, COUNTS.double().expand(10, -1)), case.network(*repeated))


@pairwise(name=UNTRAINED, factor=[1e-3, 1.0, 1e3], num_points=[8, 12, 20])
def test_equal_weights_are_none(name, factor, num_points):
    case = Case(name)
    points = case.points("handheld", 10, num_points)
    weights = torch.full((10, num_points), factor).double()
    assert case.agree(case.network(*points, weights), case.network(*points))


def test_computes_in_its_own_dtype(case):
    points = case.points()
    double, single = case.network(*points), copy.deepcopy(case.network).float()(*points)
    assert all(params.dtype == torch.float64 for params in single)  # that of the points
    assert case.agree(single, double, 1e-4)
    assert not any(torch.equal(rounded, exact) for rounded, exact in zip(single, double, strict=True))

"""Where gradients are disabled, layers work in inference mode; what they return are ordinary tensors."""

import pytest
import torch
from scenes import correspondences
from torch.utils import _pytree as pytree

import kornia_learnnorm as kln

pytestmark = pytest.mark.numerical

LAYERS = {
    "fundamental": lambda: kln.LearnedEightPoint(width=8, depth=1).eval(),
    "essential": lambda: kln.LearnedRelativePose(width=8, depth=1).eval(),
    "homography": lambda: kln.LearnedHomography(width=8, depth=1).eval(),
    "linear": kln.EightPoint,
    "whitened": lambda: kln.EightPoint(kln.ReweightedWhitening()),
    "learned": lambda: kln.EightPoint(kln.LearnedNormalizer.from_pretrained()),
}


def inputs(name):
    """Points of two sets, one of which determines no matrix, and cameras where the layer needs them."""
    points = [torch.cat([p, torch.ones_like(p)]) for p in correspondences("handheld", 1, 40)]
    return points + 2 * [torch.eye(3).double()] * (name == "essential")


def check_ordinary(found, expected):
    """Tensors of both are the same, and those that were found can take part in training."""
    for value, other in zip(pytree.tree_leaves(found), pytree.tree_leaves(expected), strict=True):
        if other is not None:
            assert not value.is_inference()
            torch.testing.assert_close(value, other.detach())


@pytest.mark.parametrize("name", LAYERS)
def test_results_are_those_with_gradient(name):
    layer, given = LAYERS[name](), inputs(name)
    expected = layer.estimate(*given)
    with torch.no_grad():
        estimate, matrices = layer.estimate(*given), layer(*given)
    check_ordinary(matrices, expected[0])
    check_ordinary(estimate, expected)


def test_vmap_without_gradient_agrees():
    layer, (points1, points2) = LAYERS["fundamental"](), inputs("fundamental")
    with torch.no_grad():
        found = torch.vmap(lambda *points: layer(*(p[None] for p in points))[0])(points1, points2)
        torch.testing.assert_close(found, layer(points1, points2))


@pytest.mark.parametrize("name", ["fundamental", "essential", "homography"])
def test_large_batches_are_those_in_pieces(name, monkeypatch):
    layer, given = LAYERS[name](), inputs(name)
    points = [p.repeat(5, 1, 1) for p in given[:2]]
    scores = torch.linspace(0, 1, 40).expand(10, -1)
    with torch.no_grad():
        expected = layer.estimate(*points, *given[2:], scores=scores)
        monkeypatch.setattr("kornia_learnnorm.estimators.stages.MAX_MATCHES", 120)
        found = layer.estimate(*points, *given[2:], scores=scores)
    check_ordinary(found, expected)

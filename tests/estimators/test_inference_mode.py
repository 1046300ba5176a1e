"""Where gradients are disabled, learned layers work in inference mode; what they return are ordinary tensors."""

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
}


def inputs(name):
    """Points of two sets, one of which determines no matrix, and cameras where the layer needs them."""
    points = [torch.cat([p, torch.ones_like(p)]) for p in correspondences("handheld", 1, 40)]
    return points + 2 * [torch.eye(3).double()] * (name == "essential")


@pytest.mark.parametrize("name", LAYERS)
def test_results_are_those_with_gradient_and_take_part_in_training(name):
    layer, values = LAYERS[name](), inputs(name)
    expected = layer.estimate(*values)
    with torch.no_grad():
        found = layer.estimate(*values)
        matrices = layer(*values)
    values, others = ([v for v in pytree.tree_leaves(each) if v is not None] for each in (found, expected))
    for value, other in zip(values, others, strict=True):
        assert not value.is_inference()
        torch.testing.assert_close(value, other.detach())
    factor = torch.ones((), dtype=torch.float64, requires_grad=True)
    (factor * matrices).square().sum().backward()
    assert factor.grad.isfinite()


def test_vmap_without_gradient_agrees():
    layer, (points1, points2) = LAYERS["fundamental"](), inputs("fundamental")
    with torch.no_grad():
        found = torch.vmap(lambda *points: layer(*(p[None] for p in points))[0])(points1, points2)
        torch.testing.assert_close(found, layer(points1, points2))

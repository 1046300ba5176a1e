"""The eight-point algorithm as a layer: masks, zero weights, flags, finite gradients, precision, back ends."""

import copy
import pickle

import numpy as np
import pytest
import torch
from pairwise import pairwise
from references import check_gradients, derivative, in_hartley, signless, true_essential, unit, up_to_sign
from scenes import LAYERS, correspondences, raises, scenes, shaken, uniform
from torch.func import grad, hessian, jacfwd, jacrev, vmap
from torch.utils.checkpoint import checkpoint

import kornia_learnnorm as kln
from kornia_learnnorm import EightPoint, Hartley, ReweightedWhitening, Whitening, find_fundamental

SLOW = ["reweighted", "learned", "estimator"]  # to compile
COMPILED = [pytest.param(name, number, marks=pytest.mark.slow) for name in SLOW for number in (8, 12)]
COMPILED += [("optimal", 8), ("hartley", 12)]


@pytest.fixture(params=LAYERS)
def layer(request):
    return LAYERS[request.param]()


def coincident(n: int = 8):
    return uniform(3, 1, 2, high=500).expand(3, n, 2), uniform(3, 1, 2, high=500, seed=1).expand(3, n, 2)


class TestEightPoint:
    @pytest.mark.parametrize("normalizer", [kln.Identity(), Whitening(), shaken(), Hartley().forward])  # a function
    def test_is_find_fundamental(self, normalizer):
        points, weights = correspondences("driving", 5, 12), uniform(5, 12)
        assert torch.equal(EightPoint(normalizer)(*points), find_fundamental(*points, normalizer=normalizer))
        projection = find_fundamental(*points, weights, normalizer)
        optimal = find_fundamental(*points, weights, normalizer, "optimal")
        assert torch.equal(EightPoint(normalizer)(*points, weights), projection)
        assert torch.equal(EightPoint(normalizer, "optimal")(*points, weights), optimal)
        assert not torch.equal(projection, optimal)
        assert torch.equal(EightPoint()(*points), find_fundamental(*points))

    def test_round_trips(self):
        assert all(key.startswith("normalizer.") for key in EightPoint(shaken()).state_dict())
        layer, points = EightPoint(shaken()), correspondences()
        other = EightPoint(shaken(seed=1))
        assert not torch.equal(other(*points), layer(*points))
        other.load_state_dict(layer.state_dict())
        for again in (other, copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
            assert torch.equal(again(*points), layer(*points))


def test_a_normaliser_that_breaks_the_contract():
    for normalizer, error, message in [
        (Hartley, TypeError, "normalizer must be .* got <class"),
        ("hartley", TypeError, "normalizer must be .* got 'hartley'"),
        (lambda *_: (torch.eye(3), torch.eye(3)), ValueError, r"shape \(2, 3, 3\), got \[\(3, 3\)"),
        (lambda *_: torch.zeros(2, 3, 3), ValueError, r"shape \(2, 3, 3\), got .*Tensor"),
        (lambda *_: (torch.full((2, 3, 3), torch.nan),) * 2, ValueError, "not finite and invertible"),
        (lambda *_: (torch.zeros(2, 3, 3),) * 2, ValueError, "not finite and invertible"),
        (lambda *_: ((1 / torch.eye(3)).expand(2, 3, 3),) * 2, ValueError, "not finite and invertible"),
    ]:
        with pytest.raises(error, match=message):
            EightPoint(normalizer)(torch.rand(2, 8, 2), torch.rand(2, 8, 2))


class TestMask:
    @pairwise(name=LAYERS, rest=[0.0, 1e9, float("nan"), float("inf")], weighted=[False, True])
    def test_rows_count_as_absent(self, name, rest, weighted):
        layer = LAYERS[name]()
        points1, points2 = correspondences("handheld", 3, 12)
        weights = uniform(3, 12, low=0.1) if weighted else None
        tail = torch.full((3, 5, 2), rest, dtype=torch.float64)
        padded = [torch.cat([points, tail], 1).requires_grad_() for points in (points1, points2)]
        mask = torch.arange(17).expand(3, 17) < 12
        extra = None if weights is None else torch.cat([weights, tail[..., 0]], 1).requires_grad_()
        F_mat = layer(*padded, extra, mask)
        assert up_to_sign(F_mat.detach(), layer(points1, points2, weights).detach()) < 1e-6
        inputs = padded if extra is None else [*padded, extra]
        for gradient in torch.autograd.grad(signless(F_mat).sum(), inputs):
            assert gradient.isfinite().all()
            assert not gradient[:, 12:].any()

    def test_wrong_masks(self):
        for mask, error, message in [
            (torch.ones(3, 8), TypeError, r"mask must be a boolean tensor, got torch\.float32"),
            (np.ones((3, 8), bool), TypeError, "mask must be a boolean tensor, got <class 'numpy.ndarray'>"),
            (torch.ones(3, 8, dtype=torch.bool, device="meta"), ValueError, "on one device, got meta and cpu"),
            (torch.ones(3, 7, dtype=torch.bool), ValueError, r"shape \[3, 8\] as points1, got \[3, 7\]"),
        ]:
            raises(error, message, EightPoint(), *correspondences("handheld", 3), None, mask)
        whole = [p.long() for p in correspondences("handheld", 3)]
        raises(TypeError, r"points1 must be .*, got torch\.int64", EightPoint(), *whole, None, torch.ones(3, 8) > 0)


@pytest.mark.parametrize("size", [1e-40, 1e-29, 1e-20, 1e20, 1e38])
def test_only_ratios_of_weights_count(layer, size):
    points = [p.float() for p in correspondences("handheld", 3, 12)]
    weights = uniform(3, 12, low=0.5)
    extreme = (size * weights).float().requires_grad_()
    estimate = layer.estimate(*points, weights=extreme)
    assert estimate.determined.all() == (size > 1e-30)
    estimate.F_mat.abs().sum().backward()
    assert extreme.grad.isfinite().all()
    if size > 1e-30:
        assert up_to_sign(estimate.F_mat.detach(), layer(*points, weights.float()).detach()) < 1e-3


class TestDetermined:
    @pytest.mark.parametrize("num_points", [8, 12])
    def test_degenerate(self, layer, num_points):
        line = uniform(3, num_points, 1, high=500) * torch.tensor([1.0, 0.5])
        plane = uniform(3, num_points, 2, high=500)
        moved = plane @ torch.tensor([[1.1, 0.1], [-0.2, 0.9]], dtype=torch.float64) + 5
        for points1, points2 in (coincident(num_points), (line, 3 * line + 7), (plane, moved), (plane, plane)):
            estimate = layer.estimate(points1, points2)
            assert not estimate.determined.any()
            assert estimate.F_mat.isfinite().all()

    def test_fewer_than_eight(self, layer):
        points = correspondences("handheld", 6, 12)
        present = torch.arange(12) < torch.tensor([[0], [1], [5], [7], [9], [11]])
        for given in ({"weights": present.float()}, {"mask": present}):
            estimate = layer.estimate(*points, **given)
            assert estimate.determined.tolist() == [*4 * [False], *2 * [True]]
            assert estimate.F_mat.isfinite().all()
            assert np.linalg.matrix_rank(unit(estimate.F_mat.detach().numpy()), tol=1e-12).min() == 2

    def test_falls_back_on_the_base(self):
        points1, points2 = correspondences("handheld", 4)
        points2[2] = 0.9 * points1[2] + 20
        normalizer = shaken().double()  # in float32, the rounding of the network depends on the size of the batch
        F_mat = EightPoint(normalizer)(points1, points2).detach()
        base = find_fundamental(points1, points2, normalizer=normalizer.base)
        own = find_fundamental(points1, points2, normalizer=normalizer).detach()
        assert torch.allclose(F_mat[2], base[2], rtol=1e-9, atol=1e-12)
        assert torch.allclose(F_mat[[0, 1, 3]], own[[0, 1, 3]], rtol=1e-9, atol=1e-12)
        assert up_to_sign(own, base) > 1e-3

    def test_sends_no_gradient(self, layer):
        inputs = [value.clone().requires_grad_() for value in (*coincident(), uniform(3, 8))]
        gradients = torch.autograd.grad(layer(*inputs).sum(), [*inputs, *layer.parameters()], allow_unused=True)
        assert not any(gradient.any() for gradient in gradients if gradient is not None)

    def test_leaves_the_gradients_of_other_samples(self, layer):
        layer = layer.double()  # a larger batch rounds differently
        points1, points2 = correspondences("handheld", 4)
        bad1 = torch.cat([points1, coincident()[0]]).requires_grad_()
        good1 = points1.clone().requires_grad_()
        mixed = torch.autograd.grad(signless(layer(bad1, torch.cat([points2, coincident()[1]]))[:4]).sum(), bad1)[0]
        alone = torch.autograd.grad(signless(layer(good1, points2)).sum(), good1)[0]
        assert torch.allclose(mixed[:4], alone, rtol=1e-6, atol=1e-9)
        assert not mixed[4:].any()


def test_essential_matrix_of_cameras():
    scene = scenes("handheld", 5, 20, noise=0.0, outliers=0.0)
    estimate = EightPoint().estimate(scene.points1, scene.points2, K1=scene.K1, K2=scene.K2)
    assert up_to_sign(estimate.E_mat, true_essential(scene)) < 1e-6
    assert torch.allclose(torch.linalg.matrix_norm(estimate.E_mat), torch.ones(5).double())


@pytest.mark.parametrize(("name", "argument"), [("hartley", "weights"), ("estimator", "scores")])
def test_from_matches_is_the_layer_of_the_matched_points(name, argument):
    layer, (points1, points2) = LAYERS[name]().double(), correspondences("handheld", 2, 30)
    index = torch.stack([torch.randperm(30)[:20] for _ in range(2)])
    scores = [torch.rand(20, requires_grad=True) for _ in range(2)]
    estimate = layer.from_matches(points1, points2, [*torch.stack([index, index], -1)], scores)
    gathered = [points.gather(1, index[..., None].expand(-1, -1, 2)) for points in (points1, points2)]
    expected = layer(*gathered, **{argument: torch.stack(scores)})
    assert up_to_sign(estimate.F_mat.detach(), expected.detach()) < 1e-9
    signless(estimate.F_mat).sum().backward()
    assert all(score.grad.any() and score.grad.isfinite().all() for score in scores)


@pytest.mark.long
class TestGradients:
    @pytest.mark.parametrize("num_points", [8, 12])
    def test_first(self, layer, num_points):
        layer, present = layer.double(), torch.arange(num_points) < max(8, num_points - 2)

        def numbers(points1, points2, weights):
            return signless(layer(points1, points2, weights, present.expand(len(points1), -1)))

        weights = uniform(2, num_points, low=0.2)
        check_gradients(numbers, *correspondences("handheld", 2, num_points), weights, eps=1e-6, atol=1e-4)

    @pytest.mark.filterwarnings("ignore:.torch.jit")  # in forward mode
    @pytest.mark.parametrize(("name", "number"), [("whitening", 8), ("learned", 8), ("hartley", 9), ("whitening", 9)])
    def test_second(self, name, number):
        layer, weights = LAYERS[name]().double(), [uniform(1, 9, low=0.2)] if number == 9 else []
        gradient = derivative(lambda *values: signless(layer(*values)))
        values = *correspondences("handheld", 1, number), *weights
        check_gradients(gradient, *values, eps=1e-4, atol=1e-5, rtol=1e-2)
        for modes in ((jacfwd, jacrev), (hessian, lambda f: jacrev(jacrev(f)))):
            found = [mode(lambda x: layer(x, values[1])[..., 0, :].square().sum())(values[0]) for mode in modes]
            torch.testing.assert_close(*found, rtol=1e-5, atol=1e-8)


class TestPrecision:
    @pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
    def test_autocast_changes_only_the_network(self, half):
        points, K = correspondences("handheld", 4, 12), torch.tensor([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
        for layer in (EightPoint(), EightPoint(ReweightedWhitening()), EightPoint(rank2="optimal")):
            single, cameras = [p.float() for p in points], {"K1": K, "K2": K}
            with torch.autocast("cpu", half):
                inside = layer.estimate(*single, **cameras)
            assert all(map(torch.equal, inside, layer.estimate(*single, **cameras)))
        learned = EightPoint(shaken())
        with torch.autocast("cpu", half):
            inside = learned(*points)
        assert inside.dtype == torch.float64
        assert torch.linalg.svdvals(inside)[:, 2].max() < 1e-12
        assert up_to_sign(inside.detach(), learned(*points).detach()) < 1e-2

    @pytest.mark.parametrize("name", ["hartley", "whitening", "optimal", "shipped"])
    def test_float32_points_cost_their_rounding_only(self, name):
        """In Hartley's coordinates; the bound is stated in the documentation."""
        layer = LAYERS[name]()
        points = [p.float() for p in correspondences("handheld", 200, 12)]
        double = [p.double() for p in points]
        single_hat, double_hat = (in_hartley(layer(*given).detach(), *double) for given in (points, double))
        assert np.quantile(np.abs(single_hat - double_hat).max((1, 2)), 0.99) < 1e-5

    def test_weights_of_half_precision(self):
        points, weights = correspondences("handheld", 4, 12), uniform(4, 12)
        assert up_to_sign(EightPoint()(*points, weights.bfloat16()), EightPoint()(*points, weights)) < 1e-3


@pytest.mark.long
class TestBackEnds:
    @pytest.mark.parametrize(("name", "num_points"), COMPILED)
    def test_compile(self, name, num_points):
        torch.compiler.reset()
        layer = LAYERS[name]()
        F_mats, gradients = [], []
        for call in (layer, torch.compile(layer, fullgraph=True, backend="aot_eager")):
            points1, points2 = correspondences("handheld", 4, num_points)
            points1[2] = points1[2, :1]
            points = [points.requires_grad_(name != "optimal") for points in (points1, points2)]
            F_mats.append(call(*points))
            if name != "optimal":  # its backward compiles slowly
                gradients.append(torch.autograd.grad(signless(F_mats[-1]).sum(), points))
        assert up_to_sign(*(F_mat.detach() for F_mat in F_mats)) < 1e-9
        if gradients:
            torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-9)

    def test_functional_gradients(self, layer):
        layer, points = layer.double(), [p.requires_grad_() for p in correspondences("handheld", 3, 12)]

        def loss(x1, x2):
            return layer(x1, x2).square()[..., 0, :].sum()

        each = vmap(grad(lambda *x: loss(*(p[None] for p in x)), (0, 1)))(*points)
        plain = torch.autograd.grad(loss(*points), points)
        torch.testing.assert_close(each, plain, rtol=1e-5, atol=1e-9)
        first = jacrev(lambda x1: loss(x1, points[1][:1].detach()))(points[0][:1].detach())
        torch.testing.assert_close(first, plain[0][:1], rtol=1e-5, atol=1e-9)

    def test_checkpoint_and_deterministic_algorithms(self, layer):
        points1, points2 = correspondences("handheld", 3)
        plain = torch.autograd.grad(signless(layer(points1.requires_grad_(), points2)).sum(), points1)
        torch.use_deterministic_algorithms(True)
        try:
            F_mat = checkpoint(layer, points1, points2, use_reentrant=False)
            assert torch.equal(torch.autograd.grad(signless(F_mat).sum(), points1)[0], plain[0])
        finally:
            torch.use_deterministic_algorithms(False)

    @pytest.mark.filterwarnings("ignore:.torch.jit")
    def test_jit_is_refused(self, layer):
        raises(TypeError, r"cannot be compiled by torch\.jit", torch.jit.script, layer)
        raises(TypeError, r"cannot be compiled by torch\.jit", torch.jit.trace, layer, correspondences("handheld", 3))

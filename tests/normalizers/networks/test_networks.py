"""The networks of the paper and of this package against NumPy: gradients, and what each depends on."""

from functools import partial

import numpy as np
import pytest
import torch
from pairwise import pairwise
from references import numpy_hartley, numpy_whitening
from scenes import DTYPES, prepared, raises, shaken, small, uniform
from torch.autograd import gradcheck
from torch.nn.functional import layer_norm

from kornia_learnnorm import CrossViewNetwork, LearnedNormalizer, PaperNetwork
from kornia_learnnorm.normalizers.networks.crossview import ContextLayer, SetNetwork, set_maximum


def network(width: int = 16, depth: int = 3) -> PaperNetwork:
    """A small network in float64 whose answers are not zero."""
    return shaken(LearnedNormalizer(network=PaperNetwork(width, depth))).network.double()


normalized = partial(prepared, numpy_hartley)


def numpy_features(net, points, weights=None):
    """The normalised maxima of one view of one sample, from the formulas."""
    state = {name: value.numpy() for name, value in net.state_dict().items()}
    weights = np.ones(len(points)) if weights is None else weights
    points, weights = points[weights > 0], weights[weights > 0]
    share = weights / weights.sum()

    def linear(name, h):
        return h @ state[f"{name}.weight"].T + state[f"{name}.bias"]

    def instance_norm(h):
        centred = h - share @ h
        return centred / np.sqrt(share @ centred**2 + 1e-5)

    h = linear("stem", points)
    maxima = [h.max(0)]
    for k in range(net.depth):
        z = np.maximum(instance_norm(linear(f"blocks.{k}.first", h)), 0)
        h = h + np.maximum(instance_norm(linear(f"blocks.{k}.second", z)), 0)
        maxima.append(h.max(0))
    M = np.stack(maxima)
    return (M - M.mean(1, keepdims=True)) / np.sqrt(M.var(1, keepdims=True) + 1e-5)


def numpy_params(net, points, weights=None):
    state, M = {name: value.numpy() for name, value in net.state_dict().items()}, numpy_features(net, points, weights)
    kernel, bias = state["convolution.weight"][:, 0], state["convolution.bias"]
    rows, columns = range(M.shape[0] - 2), range(0, M.shape[1] - 2, 4)
    patches = np.array([[M[i : i + 3, j : j + 3] for j in columns] for i in rows])
    h = (np.einsum("kab,ijab->kij", kernel, patches) + bias[:, None, None]).ravel()
    for layer in (0, 2, 4):
        h = state[f"head.{layer}.weight"] @ h + state[f"head.{layer}.bias"]
        h = h if layer == 4 else np.maximum(h, 0)
    return h


class TestArchitecture:
    def test_number_of_parameters(self):
        block = 2 * (128 * 128 + 128)
        head = (8 * 11 * 32) * 256 + 256 + 256 * 256 + 256 + 256 * 3 + 3
        expected = (2 * 128 + 128) + 12 * block + (8 * 9 + 8) + head
        assert expected == 1_184_467
        assert sum(parameter.numel() for parameter in PaperNetwork().parameters()) == expected

    @pytest.mark.parametrize(("width", "depth", "num_parameters"), [(3, 2, 3), (16, 3, 5), (6, 4, 1), (7, 4, 1)])
    def test_other_sizes(self, width, depth, num_parameters):
        net = PaperNetwork(width, depth, num_parameters)
        assert (net.width, net.depth, net.num_parameters) == (width, depth, num_parameters)
        assert net(torch.rand(2, 8, 2), torch.rand(2, 8, 2))[0].shape == (2, num_parameters)

    @pytest.mark.parametrize(("width", "depth"), [(2, 12), (128, 1), (0, 0)])
    def test_exceptions(self, width, depth):
        raises(ValueError, f"width >= 3 and depth >= 2, got {width} and {depth}", PaperNetwork, width, depth)


@pairwise(size=[(16, 3), (128, 12)], name=["driving", "handheld"], num_points=[8, 30], weighted=[False, True])
def test_agrees_with_numpy(size, name, num_points, weighted, device):
    net, points = network(*size).to(device), normalized(name, 5, num_points)
    weights = uniform(5, num_points) * (torch.arange(num_points) % 4 > 0) if weighted else None
    on_device = [None if v is None else v.to(device) for v in (*points, weights)]
    features = net.global_features(on_device[0], on_device[2]).detach().cpu()
    answers = [params.detach().cpu() for params in net(*on_device)]
    net = net.cpu()
    for k in range(5):
        w = None if weights is None else weights[k].numpy()
        np.testing.assert_allclose(features[k].numpy(), numpy_features(net, points[0][k].numpy(), w), atol=1e-9)
        for params, p in zip(answers, points, strict=True):
            expected = numpy_params(net, p[k].numpy(), w)
            np.testing.assert_allclose(params[k].numpy(), expected, rtol=1e-8, atol=1e-10)


class TestGradients:
    @pytest.mark.parametrize("num_points", [8, 10])
    def test_gradcheck(self, num_points):
        net, weights = network(8, 2), uniform(1, num_points, low=0.2)
        points = normalized("orbit", 1, num_points)
        assert gradcheck(net, [p.clone().requires_grad_() for p in points])
        assert gradcheck(net, [p.clone().requires_grad_() for p in (*points, weights)])

    @pairwise(weights=[None, torch.zeros(3, 8), torch.eye(8)[:3]], spread=[0.0, 1e-8, 1.0], dtype=DTYPES)
    def test_finite_on_absent_and_coincident_points(self, weights, spread, dtype):
        net = network().to(dtype)
        values = [spread * uniform(3, 8, 2, low=-1, seed=k).to(dtype) + 1 for k in (0, 1)]
        values = [v.requires_grad_() for v in (*values, *([] if weights is None else [weights.to(dtype)]))]
        answers = net(*values)
        assert all(torch.isfinite(params).all() for params in answers)
        for gradient in torch.autograd.grad(torch.cat(answers).sum(), [*values, *net.parameters()]):
            assert torch.isfinite(gradient).all()


class TestSetMaximum:
    def test_gradient_goes_to_one_of_equal_points(self):
        """That of `amax` would go to all of them, and is NaN where Inductor rounds the maximum alone."""
        features = torch.ones(2, 4, 3, requires_grad=True)
        (gradient,) = torch.autograd.grad(set_maximum(features, None, 1).sum(), features)
        assert (gradient.sort(1, descending=True).values == torch.tensor([1.0, 0, 0, 0])[:, None]).all()

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore")  # Inductor's own
    def test_gradient_of_compiled_bfloat16(self):
        features = uniform(3, 8, 5, low=-1).bfloat16().requires_grad_()
        compiled = torch.compile(lambda h: set_maximum(layer_norm(h, (5,)), None, 1))
        (gradient,) = torch.autograd.grad(compiled(features).float().square().sum(), features)
        assert gradient.isfinite().all()


whitened = partial(prepared, numpy_whitening)


def crossview(**options) -> CrossViewNetwork:
    """A small network in float64 whose answers are not zero."""
    return shaken(small(**options)).network.double()


class TestSetNetwork:
    @pytest.mark.parametrize("weighted", [False, True])
    def test_parts_of_a_large_batch_change_nothing(self, weighted, monkeypatch):
        net, points, whole = SetNetwork(4, 6, 16, 2, outputs=3).double(), uniform(10, 8, 4), uniform(10, 6, seed=1)
        torch.nn.init.normal_(net.head[-1].weight)
        weights = uniform(10, 8, seed=2) if weighted else None
        expected = net(points, whole, weights).detach()
        monkeypatch.setattr("kornia_learnnorm.normalizers.networks.crossview.MAX_POINTS", 24)
        with torch.no_grad():
            torch.testing.assert_close(net(points, whole, weights), expected)

    def test_sums_of_residual_layers_keep_their_precision_under_autocast(self):
        with torch.autocast("cpu", torch.bfloat16):
            assert ContextLayer(16)(uniform(2, 8, 16).float(), None).dtype == torch.float32


class TestCrossViewNetwork:
    @pytest.mark.parametrize("bound", [0.5, 3.0])
    def test_answers_stay_within_the_bound(self, bound):
        net = CrossViewNetwork(width=8, depth=1, bound=bound).double()
        points1, points2 = whitened()
        for bias in (1e-4, 100.0):
            with torch.no_grad():
                net.set_network.head[-1].bias.fill_(bias)
            for params in net(points1, points2):
                np.testing.assert_allclose(params.detach().numpy(), bound * np.tanh(bias / bound), rtol=1e-12)

    @pytest.mark.parametrize(("features", "num_points"), [("epipolar", 8), ("epipolar", 11), ("both", 11), ("own", 8)])
    def test_gradcheck(self, num_points, features):
        net, points = crossview(features=features), [p.requires_grad_() for p in whitened("orbit", 1, num_points)]
        assert gradcheck(net, points, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


class TestFeatures:
    @pytest.mark.parametrize(("features", "sees"), [("own", False), ("both", True), ("epipolar", True)])
    @pytest.mark.parametrize("num_points", [8, 20])
    def test_the_other_view_and_who_corresponds_to_whom(self, features, sees, num_points):
        net, (points1, points2) = crossview(features=features), whitened("handheld", 6, num_points)
        params1, params2 = net(points1, points2)
        other = whitened("driving", 6, num_points, seed=1)[1]
        (found1, moved2), (moved1, found2) = net(points1, other), net(other, points2)
        for found, expected in [(found1, params1), (found2, params2)]:
            assert torch.allclose(found, expected, rtol=1e-12) is not sees
        for found, expected in zip(net(points1, points2.roll(1, 1)), (params1, params2), strict=True):
            assert torch.allclose(found, expected, rtol=1e-10) is not sees
        for moved, before in [(moved1, params1), (moved2, params2)]:
            assert not torch.isclose(moved, before, atol=1e-4).all(-1).any()

    @pytest.mark.parametrize("name", ["Own", None])
    def test_unknown(self, name):
        with pytest.raises(ValueError, match=f"features must be one of own, both, epipolar, got {name!r}"):
            CrossViewNetwork(features=name)

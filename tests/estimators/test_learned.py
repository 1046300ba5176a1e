"""The learned F, E and H: what they promise, small sets, files, errors; more of F is in test_eight_point.py."""

import json
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from pairwise import pairwise
from references import check_gradients, check_refuses, corner_error, numpy_sampson, signless, true_essential, up_to_sign
from scenes import DTYPES, inputs, plane, raises, rewrite_weights, roughened, scenes, seeded, shaken_estimator, uniform
from torch.autograd import gradcheck

import kornia_learnnorm as kln
from kornia_learnnorm.estimators import pose_stages
from kornia_learnnorm.estimators.learned_layer import inlier_probability
from kornia_learnnorm.estimators.network_features import masked_median
from kornia_learnnorm.geometry.problem import LinearProblem

CLASSES = {"fundamental": kln.LearnedEightPoint, "pose": kln.LearnedRelativePose, "homography": kln.LearnedHomography}
LAYERS = {
    "fundamental": lambda **options: shaken_estimator(**options).double(),
    "pose": lambda **options: roughened(kln.LearnedRelativePose, **options),
    "homography": lambda **options: roughened(kln.LearnedHomography, **options),
}
LEAST = {"fundamental": 8, "pose": 5, "homography": 4}  # correspondences
MATRICES = {"fundamental": {"F_mat": (3, 3)}, "homography": {"H_mat": (3, 3)}}
MATRICES |= {"pose": {"E_mat": (3, 3), "F_mat": (3, 3), "R": (3, 3), "t": (3,)}}
every = pytest.mark.parametrize("kind", LAYERS)
siblings = pytest.mark.parametrize("kind", ["pose", "homography"])


@pairwise(kind=LAYERS, batch_size=[0, 1, 3], more=[0, 1, 3, 55], given=["", "weights", "mask", "scores"], dtype=DTYPES)
def test_smoke(kind, batch_size, more, given, dtype, device):
    num_points, layer = LEAST[kind] + more, LAYERS[kind]().to(device)
    values = [value[:batch_size].to(device, dtype) for value in inputs(kind, max(batch_size, 1), num_points)]
    rows = uniform(batch_size, num_points).to(device)
    options = {"": {}, "mask": {"mask": rows > 0.1}}.get(given, {given: rows})
    found = layer.estimate(*values, **options)
    for name, shape in (MATRICES[kind] | {"gap": (), "weights": (num_points,)}).items():
        value = getattr(found, name)
        assert (value.shape, value.dtype) == ((batch_size, *shape), torch.float64 if name == "gap" else dtype)
        assert value.isfinite().all()
    assert len(found.stages) == 2
    assert torch.equal(layer(*values, **options), found[0])


@every
@settings(max_examples=5)
@given(st.sampled_from([0, 1, 35]), st.integers(0, 2**20), st.floats(1e-3, 1e3), st.floats(-1e3, 1e3))
@torch.no_grad()
def test_invariances(kind, more, seed, factor, shift):
    """To the order of the correspondences, a swap of the views, and one scale and translation of both images."""
    num_points, factor = (LEAST[kind] + more, factor) if kind != "pose" else (12 + more, 1.0)
    layer, (points1, points2, *cameras) = LAYERS[kind](), inputs(kind, 4, num_points, seed)
    order = torch.randperm(num_points, generator=seeded(seed))
    bound, least = (1e-5, 1e-6) if kind == "pose" else (1e-6, 1e-8)
    found = layer.estimate(points1, points2, *cameras)
    shuffled = layer.estimate(points1[:, order], points2[:, order], *cameras)
    assert up_to_sign(shuffled[0], found[0]) < bound
    assert torch.allclose(torch.linalg.matrix_norm(found[0]), torch.tensor(1.0).double())
    assert torch.allclose(shuffled.weights, found.weights[:, order], atol=least)
    assert up_to_sign(layer.model.swap(layer(points2, points1, *cameras[::-1])), found[0]) < bound
    T = torch.tensor([[factor, 0, factor * shift], [0, factor, factor * shift], [0, 0, 1]], dtype=torch.float64)
    moved = layer(factor * (points1 + shift), factor * (points2 + shift), *(T @ K for K in cameras))
    assert up_to_sign(moved if kind == "pose" else layer.model.carry(moved, T, T), found[0]) < 1e-5


@every
@settings(max_examples=3)
@given(st.floats(120, 240))
@torch.no_grad()
def test_networks_see_a_rotated_image_upright(kind, degrees):
    """Where it is the second in the canonical order, as in all of these but the first plane."""
    K = 2 * [torch.diag(torch.tensor([600.0, 600.0, 1.0]).double())] if kind == "pose" else []
    R = axis_angle_to_rotation_matrix(torch.deg2rad(torch.tensor([[0.0, 0.0, 180.0], [0.0, 0.0, degrees]]))).double()
    points1, points2 = (p[1:] - p[1:].mean(1, keepdim=True) for p in inputs(kind, 4, 100, scene="driving")[:2])
    found, other = (LAYERS[kind]().estimate(points1, points2 @ r[:2, :2].mT, *K) for r in R)
    assert torch.allclose(found.stages[0].logits, other.stages[0].logits, atol=1e-6)
    assert up_to_sign(R[0].mT @ found[0], R[1].mT @ other[0]) < 1e-5


@pytest.mark.parametrize(
    ("kind", "number"),
    [*(("fundamental", n) for n in (8, 9, 15, 16, 40)), ("pose", 12), *(("homography", n) for n in (7, 8, 40))],
)
def test_masked_rows_have_no_effect(kind, number):
    """They may hold anything, and few present matches are not searched, however many rows there are."""
    layer, (points1, points2, *cameras) = LAYERS[kind](), inputs(kind, 3, number)
    scores, mask = uniform(3, number), torch.arange(number + 20).expand(3, -1) < number
    tail = torch.full((3, 20, 2), torch.nan, dtype=torch.float64)
    padded = [torch.cat([p, tail], 1).requires_grad_() for p in (points1, points2)]
    found = layer(*padded, *cameras, mask=mask, scores=torch.cat([scores, tail[..., 0]], 1))
    assert up_to_sign(found.detach(), layer(points1, points2, *cameras, scores=scores).detach()) < 1e-6
    for gradient in torch.autograd.grad(signless(found).sum(), padded):
        assert gradient.isfinite().all()
        assert not gradient[~mask].any()


@pytest.mark.parametrize("number", [15, 40])
def test_weights_by_the_rule_of_bayes(number):
    """Normal distances of inliers, outliers uniform over the image; with few matches the logits alone."""
    points = inputs("fundamental", 3, number)
    points[1] = torch.cat([600 * uniform(3, 5, 2), points[1][:, 5:]], 1)
    weights = uniform(3, number, low=0.1)
    with torch.no_grad():
        found = LAYERS["fundamental"]().estimate(*points, weights=weights)
    logits = found.stages[-1].logits.numpy()
    prior = 1 / (1 + np.exp(-logits))
    both = torch.cat(points, 1).numpy()
    unit = np.linalg.norm(both - both.mean(1, keepdims=True), axis=-1).mean(1)[:, None]
    squares = (numpy_sampson(*points, found.F_mat) / unit) ** 2
    share = weights.numpy() * prior
    mean = np.exp((share * np.log(squares + 1e-10)).sum(1, keepdims=True) / share.sum(1, keepdims=True))
    variance = 3.562 * mean
    ratio = 4 * np.exp(-squares / (2 * variance)) / np.sqrt(2 * np.pi * variance) if number >= 16 else 1.0
    expected = prior * ratio / (prior * ratio + 1 - prior)
    np.testing.assert_allclose(found.weights, expected, rtol=1e-5, atol=1e-9)


@every
def test_weights_when_views_are_swapped(kind):
    layer, (points1, points2, *cameras) = LAYERS[kind](), inputs(kind, 3, 16)
    points2 = torch.cat([600 * uniform(3, 5, 2), points2[:, 5:]], 1)
    found, swapped = layer.estimate(points1, points2, *cameras), layer.estimate(points2, points1, *cameras[::-1])
    assert torch.allclose(swapped.weights, found.weights, atol=1e-6)


@every
def test_a_common_factor_of_the_weights_has_no_derivative(kind):
    weights = (uniform(3, 40, low=0.1) * torch.tensor([1e-9, 1.0]).repeat(20)).requires_grad_()
    for M, *_ in LAYERS[kind]().estimate(*inputs(kind, 3, 40), weights=weights).stages:
        (gradient,) = torch.autograd.grad(M.square() @ uniform(3, 1), weights, uniform(3, 3, 1), retain_graph=True)
        assert (gradient * weights).sum(1).abs().max() < 1e-6 * gradient.norm()
        assert gradient.abs().max() < 100 * gradient[:, 1::2].abs().max()


@pytest.mark.parametrize("kind", ["fundamental", "homography"])
def test_gradients_of_probabilities(kind):
    model, (points1, points2) = LAYERS[kind]().model, inputs(kind, 2, 20)
    problem = LinearProblem.from_points(points1, points2, None, model)
    M, logits = uniform(2, 3, 3).requires_grad_(), uniform(2, 20).requires_grad_()
    assert gradcheck(lambda *given: inlier_probability(model, problem, *given, problem.determined), (M, logits))


@pytest.mark.parametrize("kind", ["fundamental", "homography"])
@torch.no_grad()
def test_samples_find_the_matrix_where_the_weights_do_not(kind):
    """An untrained network gives all matches the same weight."""
    if kind == "homography":
        distance, (points1, points2, _) = kln.transfer_distance, plane(10, 200)
    else:
        distance, scene = kln.symmetric_epipolar_distance, scenes("handheld", 10, 200, noise=0.1)
        points1, points2 = scene.points1, scene.points2
    matched = torch.cat([600 * uniform(10, 60, 2, seed=3), points2[:, 60:]], 1)
    errors = []
    for samples in (0, 256):
        torch.manual_seed(0)
        layer = CLASSES[kind](width=16, depth=1, stages=1, samples=samples).double()
        errors.append(distance(points1, points2, layer(points1, matched)).median(1).values)
    assert (errors[1] < errors[0] / 4).double().mean() >= 0.8


@every
def test_sets_of_few_outliers_leave_stages_out(kind):
    """A set that needs its stages, in the same batch, changes nothing but the time."""
    layer, calls, points = CLASSES[kind].from_pretrained(), [], inputs(kind, 3, 200)
    for network in layer.networks:
        network.register_forward_hook(lambda *_: calls.append(1))
    points[1][2, :120] = uniform(120, 2, high=400.0)
    points[1][:2] += {"pose": 20.0}.get(kind, 0.0) * (uniform(2, 200, 2) - 0.5)
    layer(*points)
    alone, numbers = [], [len(calls)]
    for row in range(3):
        calls.clear()
        alone.append(layer(*(p[row : row + 1] for p in points)))
        numbers.append(len(calls))
    assert numbers == [len(layer.networks), 1, 1, len(layer.networks)]
    assert up_to_sign(layer(*points).detach(), torch.cat(alone).detach()) < 1e-6
    calls.clear()
    layer.train()(*(p[:2] for p in points))
    assert len(calls) == len(layer.networks)


@every
def test_the_rounding_of_an_exact_shift_has_no_large_gradient_and_finite_second_derivatives(kind):
    points, _, *cameras = (value.float() for value in inputs(kind, 1, 200))
    found = CLASSES[kind].from_pretrained()(points.requires_grad_(), points.detach() + 7, *cameras)
    (gradient,) = torch.autograd.grad(found[:, 0].sum(), points, create_graph=True)
    assert gradient.abs().max() < 1
    assert torch.autograd.grad(gradient.square().sum(), points)[0].isfinite().all()


class TestSmallSetsOfFundamentalMatrices:
    def test_eight_are_the_optimal_correction_or_with_outliers_hartleys_projection(self):
        points1, points2 = inputs("fundamental", 40, 8)
        points2[5:] += 30 * torch.randn(35, 8, 2, generator=seeded(), dtype=points2.dtype)
        optimal, hartley = (kln.find_fundamental(points1, points2, rank2=kind) for kind in ("optimal", "projection"))
        residual = kln.sampson_distance(points1, points2, optimal).square().mean(1).sqrt()
        both = torch.cat([points1, points2], 1)
        fits = residual < 0.01 * (both - both.mean(1, keepdim=True)).norm(dim=-1).mean(1)
        assert fits[:5].all()
        assert 0 < fits[5:].sum() < 35
        found = LAYERS["fundamental"]()(points1, points2).detach()
        assert up_to_sign(found[fits], optimal[fits]) < 1e-9
        assert up_to_sign(found[~fits], hartley[~fits]) < 1e-9

    def test_an_untrained_layer_is_hartleys(self):
        points = inputs("fundamental", 5, 20)
        layer = kln.LearnedEightPoint(width=16, depth=1, stages=1, refine_steps=0)
        assert up_to_sign(layer(*points).detach(), kln.find_fundamental(*points)) < 1e-6


def test_stages_without_refinement():
    points, scores = inputs("fundamental", 3, 30, scene="driving"), torch.rand(3, 30)
    layers = (shaken_estimator(stages=3, refine_steps=steps) for steps in (10, 0))
    refined, plain = (layer.estimate(*points, scores=scores) for layer in layers)
    assert up_to_sign(plain.F_mat.detach(), plain.stages[-1].F_mat.detach()) < 1e-3
    assert torch.equal(plain.stages[0].F_mat, refined.stages[0].F_mat)
    assert not torch.equal(plain.stages[1].F_mat, refined.stages[1].F_mat)  # it sees other residuals
    assert plain.E_mat is None


@pytest.mark.parametrize("num_points", [4, 5, 50, 400])
def test_finds_the_homography_without_noise(num_points):
    points1, points2, H = plane(8, num_points)
    layer = LAYERS["homography"](refine_steps=10)
    for weights in (None, uniform(8, num_points, low=0.1)):
        found = layer.estimate(points1, points2, weights=weights)
        assert found.determined.all()
        assert corner_error(found.H_mat, H) < 1e-4
    padded = [torch.cat([p, 600 - p[:, :3]], 1) for p in (points1, points2)]
    mask = torch.arange(num_points + 3).expand(8, -1) < num_points
    assert corner_error(layer(*padded, mask=mask), H) < 1e-4


DEGENERATE = {
    "coincident": lambda p: (p[:, :1].expand_as(p), p[:, :1].expand_as(p)),
    "four places": lambda p: (p[:, torch.arange(12) % 4], p[:, torch.arange(12) % 4] + 5),
    "collinear": lambda p: (p * torch.tensor([1, 0]).to(p), p * torch.tensor([1, 0]).to(p) + 3),
    "no motion": lambda p: (p, p),
    "zero": lambda p: (0 * p, 0 * p),
    "unrelated": lambda p: (p, p.flip(1)),
    "absent and far": lambda p: (torch.cat([p[:, 2:], 1e35 + 0 * p[:, :2]], 1), p.flip(1)),
    "huge": lambda p: (1e12 * p, 1e12 * (p.flip(1) + p)),
}
DETERMINED = {"pose": ["no motion", "unrelated", "absent and far", "huge"]}
DETERMINED["homography"] = ["four places", *DETERMINED["pose"]]


@siblings
@pytest.mark.parametrize("name", DEGENERATE)
def test_finite_on_degenerate_sets(kind, name):
    points = [p.clone().requires_grad_() for p in DEGENERATE[name](uniform(3, 12, 2, high=600))]
    layer = LAYERS[kind]().float()  # the numbers that overflow first
    found = layer.estimate(*points, *inputs(kind, 3, 12)[2:], weights=(points[0].detach().amax(-1) < 1e20).double())
    assert found.determined.any() == (name in DETERMINED[kind])
    matrices = [getattr(found, key) for key in MATRICES[kind]]
    loss = signless(found[0]).sum() + sum(value.sum() for value in matrices[1:]) + found.weights.sum()
    gradients = torch.autograd.grad(loss, [*points, *layer.parameters()], allow_unused=True)
    for value in (*matrices, *(g for g in gradients if g is not None)):
        assert value.isfinite().all()


CHECKED = [("fundamental", "handheld", 20, {}), ("pose", "orbit", 12, {"stages": 1, "samples": 0})]
CHECKED += [("homography", "", number, {"stages": 1}) for number in (12, 20)]
FITTED = [("fundamental", n, options) for n in (8, 9) for options in ({}, {"rank2": "optimal"}, {"refine_steps": 0})]
FITTED += [("pose", 20, {}), ("homography", 20, {})]


@pytest.mark.parametrize(("kind", "scene", "number", "options"), CHECKED)
def test_gradients(kind, scene, number, options):
    """With many steps derivatives are those of the optimum, wherever the fit began."""
    layer = LAYERS[kind](refine_steps=60, **options)
    points1, points2, *cameras = inputs(kind, 1, number, scene=scene)

    def numbers(points1, points2, scores):
        return signless(layer(points1, points2, *(K[0] for K in cameras), scores=scores))

    # Numbers of a homography of pixels are tiny in its last row.
    tolerances = {"eps": 1e-4, "atol": 1e-6} if kind == "homography" else {"eps": 1e-6, "atol": 1e-4}
    check_gradients(numbers, points1, points2, uniform(*points1.shape[:2]), rtol=1e-2, **tolerances)


@pytest.mark.parametrize(("kind", "number", "options"), FITTED)
def test_every_parameter_gets_a_gradient(kind, number, options):
    """Otherwise DistributedDataParallel waits for the gradients that are missing."""
    layer = LAYERS[kind](**options)
    signless(layer(*inputs(kind, 3, number))).sum().backward()
    gradients = torch.cat([parameter.grad.flatten() for parameter in layer.parameters()])
    assert gradients.isfinite().all()
    assert bool(gradients.any()) == (number > 8)


@every
@pytest.mark.parametrize("sets", [0, 3])
def test_every_parameter_gets_a_gradient_of_zero_from_undetermined_sets(kind, sets):
    layer, (points1, points2, *cameras) = CLASSES[kind].from_pretrained(), [x[:sets] for x in inputs(kind, 3, 20)]
    signless(layer(0 * points1, 0 * points2, *cameras)).sum().backward()
    assert not torch.cat([parameter.grad.flatten() for parameter in layer.parameters()]).any()


@pytest.mark.parametrize(
    ("kind", "few"), [*(("fundamental", n) for n in (0, 5, 8)), ("pose", 4), ("homography", 3), ("homography", 4)]
)
def test_scores_of_few_matches_get_a_gradient_of_zero(kind, few):
    points1, points2, *cameras = inputs(kind, 2, 30)
    matches = [torch.arange(number)[:, None].expand(number, 2) for number in (20, few)]
    scores = [torch.rand(len(pairs), dtype=torch.float64, requires_grad=True) for pairs in matches]
    found = LAYERS[kind]().from_matches(points1, points2, matches, scores, *cameras)
    assert found.determined.tolist() == [True, few >= LEAST[kind]]
    first, second = torch.autograd.grad(signless(found[0]).sum(), scores)
    assert first.any()
    assert not second.any()


@siblings
@pytest.mark.long
def test_vmap_and_compile_agree(kind, monkeypatch):
    """The traced graph is whole; how fast its code is, is another question. Export has a test of its own."""
    monkeypatch.setattr(pose_stages, "LOCAL_STEPS", 1)
    layer, values = LAYERS[kind](refine_steps=1, samples=4), inputs(kind, 2, 20)
    expected = layer(*values).detach()
    mapped = torch.func.vmap(lambda *rows: layer(*(row[None] for row in rows))[0])(*values)
    assert up_to_sign(mapped.detach(), expected) < 1e-6
    traced = torch.compile(layer, backend="eager", fullgraph=True)
    assert up_to_sign(traced(*values).detach(), expected) < 1e-6


@siblings
def test_autocast_leaves_the_solver_in_float64(kind):
    scene, (points1, points2, H) = scenes("orbit", 2, 40, noise=0.0), plane(2, 40)
    values = (points1, points2) if kind == "homography" else (scene.points1, scene.points2, scene.K1, scene.K2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = LAYERS[kind](refine_steps=10).float()(*values).detach()
    assert found.dtype == torch.float64
    if kind == "homography":
        assert corner_error(found, H) < 1e-4
    else:
        assert up_to_sign(found, true_essential(scene)) < 1e-6


class TestFiles:
    @every
    def test_round_trip(self, kind, tmp_path):
        layer = LAYERS[kind](**{"learn_transforms": False, "rank2": "optimal"} if kind == "fundamental" else {})
        layer.trained_on, file = ("one", "two@0:3"), tmp_path / "own.safetensors"
        layer.save_pretrained(file)
        loaded = type(layer).from_pretrained(file)
        assert (loaded.trained_on, loaded.extra_repr()) == (layer.trained_on, layer.extra_repr())
        assert not loaded.training
        values = inputs(kind, 2, 20)
        for other in (loaded, pickle.loads(pickle.dumps(loaded))):
            assert torch.equal(other(*values), layer(*values))
        for module in loaded.modules():  # as in a replica of nn.DataParallel, whose weights are no parameters
            module.__dict__.update({name: p if p is None else p.detach() for name, p in module._parameters.items()})
            module._parameters.clear()
        assert torch.equal(loaded(*values), layer(*values))
        for cls in {*CLASSES.values()} - {type(layer)}:
            raises(ValueError, f"model '{layer.model_name}', expected '{cls.model_name}'", cls.from_pretrained, file)

    @pytest.mark.parametrize("kind", ["fundamental", "homography"])
    def test_of_an_earlier_version(self, kind, tmp_path):
        def drop(_, metadata):
            architecture = json.loads(metadata["architecture"])
            del architecture["samples"]
            metadata["architecture"] = json.dumps(architecture)

        LAYERS[kind]().save_pretrained(tmp_path / "own.safetensors")
        rewrite_weights(tmp_path / "own.safetensors", drop)
        assert CLASSES[kind].from_pretrained(tmp_path / "own.safetensors").samples == 64

    def test_garbled_architecture_or_weights_of_a_normaliser(self, tmp_path):
        file, load = tmp_path / "own.safetensors", kln.LearnedEightPoint.from_pretrained
        shaken_estimator().save_pretrained(file)
        for text in ("", "[]", '{"widht": 3}', '{"width": 10000}', '{"stages": 0}', '{"rank2": "no"}'):
            rewrite_weights(file, lambda _, metadata, text=text: metadata.update(architecture=text))
            raises(ValueError, r"own\.safetensors describes no estimator of this version", load, file)
        raises(ValueError, r"crossview: .* LearnedEightPoint.* LearnedNormalizer", load, "crossview")
        raises(TypeError, "expected a name or a path of weights, got None", load, None)

    @siblings
    def test_starts_from_an_eight_point_estimator(self, kind):
        eight = kln.LearnedEightPoint.from_pretrained("robust-tiny")
        layer = CLASSES[kind].from_eight_point(eight).eval()
        points1, points2, *cameras = inputs(kind, 2, 60)
        scores = uniform(2, 60)
        first = eight.estimate(points1, points2, scores=scores).stages[0].logits
        found = layer.estimate(points1, points2, *cameras, scores=scores).stages[0].logits
        assert torch.allclose(found, first, atol=1e-5)


class TestExceptions:
    @every
    def test_correspondences_and_scores(self, kind):
        layer, cameras, points = LAYERS[kind](), [torch.eye(3)] * 2 if kind == "pose" else [], torch.rand(2, 12, 2)
        check_refuses(lambda *points: layer(*points[:2], *cameras, weights=points[2]), LEAST[kind])
        for scores, error, message in [
            (torch.rand(2, 9), ValueError, r"scores .*\[2, 12\], got \[2, 9\]"),
            (torch.full((2, 12), 1.5), ValueError, r"scores .* got 1\.5 to 1\.5"),
            (torch.full((2, 12), torch.nan), ValueError, r"scores .* got nan"),
            (torch.ones(2, 12, dtype=torch.int64), TypeError, r"scores .* got torch\.int64"),
        ]:
            raises(error, message, layer, points, points, *cameras, scores=scores)

    def test_cameras(self):
        points, K = torch.rand(2, 12, 2), torch.eye(3)
        for cameras, message in [
            ((None, K), "cameras K1 and K2 are needed"),
            ((torch.zeros(3, 3), K), "K1 must be finite and invertible"),
            ((K, K.expand(5, 3, 3)), "K2 must have shape"),
        ]:
            raises(ValueError, message, LAYERS["pose"](), points, points, *cameras)

    def test_options(self):
        shared = [({"width": 0}, "width must be"), ({"depth": 1.5}, "depth must be .* 1.5")]
        shared += [({name: -1}, f"{name} must be .* 0, got -1") for name in ("samples", "refine_steps")]
        own = [({"stages": 0}, "stages must be .* 1, got 0"), ({"rank2": "no"}, "rank2 must be")]
        own += [({"learn_transforms": "no"}, "learn_transforms must be .* got 'no'")]
        for kind, cls in CLASSES.items():
            for options, message in shared + own * (kind == "fundamental"):
                raises(ValueError, message, cls, **options)


def test_median_of_the_present_rows():
    values, present = uniform(6, 11, 3, low=-1), (uniform(6, 11, seed=1) < 0.6).double()
    found = masked_median(values, present)
    for k in range(6):
        held = values[k][present[k] > 0].sort(0).values
        assert torch.equal(found[k, 0], held[(len(held) - 1) // 2])
    assert torch.equal(masked_median(values, torch.ones(6, 11)), masked_median(values, None))
    assert not masked_median(values, torch.zeros(6, 11)).any()

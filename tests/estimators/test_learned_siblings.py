"""The learned relative pose and homography: truth, invariances, small and degenerate sets, gradients, files, errors."""

import json
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import essential_from_Rt
from pairwise import pairwise
from scenes import (
    DTYPES,
    check_gradients,
    check_refuses,
    corner_error,
    correspondences,
    plane,
    rewrite_weights,
    scenes,
    seeded,
    signless,
    true_essential,
    uniform,
    up_to_sign,
)
from torch.nn.functional import normalize

import kornia_learnnorm as kln
from kornia_learnnorm.estimators import camera_evidence, moments, pose_stages
from kornia_learnnorm.estimators.match_features import CommonFrame
from kornia_learnnorm.estimators.moments import Evidence
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental

pytestmark = pytest.mark.numerical


def roughened(layer):
    """A layer whose weights differ from one another, as after training."""
    layer, generator = layer.double().eval(), seeded(1)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
    return layer


def pose_layer(**options) -> kln.LearnedRelativePose:
    torch.manual_seed(0)
    return roughened(kln.LearnedRelativePose(**{"width": 16, "depth": 2, "stages": 2, "samples": 8} | options))


def homography_layer(**options) -> kln.LearnedHomography:
    torch.manual_seed(0)
    return roughened(kln.LearnedHomography(**{"width": 16, "depth": 2, "stages": 2, "samples": 8} | options))


def inputs(name="orbit", *args, **options):
    """Points and cameras of a scene."""
    scene = scenes(name, *args, **options)
    return [scene.points1, scene.points2, scene.K1, scene.K2]


def planar(batch_size, num_points):
    """Points of planes with some noise."""
    return [*plane(batch_size, num_points, noise=0.2)[:2]]


LAYERS = {"pose": pose_layer, "homography": homography_layer}
INPUTS = {"pose": inputs, "homography": lambda name, *args, **options: planar(*args, **options)}
SHAPES = {
    "pose": {"E_mat": (3, 3), "F_mat": (3, 3), "R": (3, 3), "t": (3,)},
    "homography": {"H_mat": (3, 3), "gap": ()},
}
both = pytest.mark.parametrize("kind", LAYERS)


@pairwise(
    kind=LAYERS,
    batch_size=[0, 1, 3],
    num_points=[5, 6, 8, 60],
    more=["plain", "weights", "mask", "scores"],
    dtype=DTYPES,
)
def test_smoke(kind, batch_size, num_points, more, dtype):
    values = [value.to(dtype) for value in INPUTS[kind]("orbit", max(batch_size, 1), num_points)]
    values = [value[:batch_size] for value in values]
    rows = uniform(batch_size, num_points)
    given = {"plain": {}, "mask": {"mask": rows > 0.1}}.get(more, {more: rows})
    found = LAYERS[kind]().estimate(*values, **given)
    for name, shape in (SHAPES[kind] | {"weights": (num_points,)}).items():
        value = getattr(found, name)
        assert (value.shape, value.dtype) == ((batch_size, *shape), torch.float64 if name == "gap" else dtype)
        assert value.isfinite().all()
    assert len(found.stages) == 2
    assert torch.equal(LAYERS[kind]()(*values, **given), found[0])


@pytest.mark.parametrize("num_points", [4, 5, 50, 400])
def test_finds_the_homography_without_noise(num_points):
    points1, points2, H = plane(8, num_points)
    layer = homography_layer(refine_steps=10)
    for weights in (None, uniform(8, num_points, low=0.1)):
        found = layer.estimate(points1, points2, weights=weights)
        assert found.determined.all()
        assert corner_error(found.H_mat, H) < 1e-4
    padded = [torch.cat([p, 600 - p[:, :3]], 1) for p in (points1, points2)]
    mask = torch.arange(num_points + 3).expand(8, -1) < num_points
    assert corner_error(layer(*padded, mask=mask), H) < 1e-4


@pytest.mark.parametrize("num_points", [6, 8, 50, 400])
@pytest.mark.parametrize("kind", ["orbit", "handheld", "driving"])
def test_finds_the_truth_without_noise(kind, num_points):
    scene = scenes(kind, 20, num_points, noise=0.0)
    with torch.no_grad():
        found = pose_layer().estimate(scene.points1, scene.points2, scene.K1, scene.K2)
    assert found.determined.all()
    gaps = torch.stack([(found.E_mat - s * true_essential(scene)).flatten(1).norm(dim=1) for s in (1, -1)]).amin(0)
    right = gaps < 1e-7
    assert right.double().mean() >= (0.8 if num_points == 6 else 1.0)  # six points can have two solutions
    assert (found.R - scene.R)[right].abs().max() < 1e-6
    assert (found.t - normalize(scene.t, dim=-1))[right].abs().max() < 1e-6
    assert up_to_sign(essential_from_Rt(*_origin(found), found.R, found.t[..., None]) / 2**0.5, found.E_mat) < 1e-9
    x1, x2 = (torch.cat([p, torch.ones_like(p[..., :1])], -1) for p in (scene.points1, scene.points2))
    assert (x2 * (x1 @ found.F_mat.mT)).sum(-1)[right].abs().max() < 1e-6


@pytest.mark.parametrize("kind", ["handheld", "driving"])
@pytest.mark.parametrize("calibrated", [False, True])
def test_steps_on_moments_end_at_the_optimum_of_the_distances(kind, calibrated):
    points1, points2, K1, K2 = inputs(kind, 5, 200)
    points1, points2 = (
        points + torch.randn(points.shape, generator=seeded(1)).to(points) for points in (points1, points2)
    )
    frame = CommonFrame.from_points(points1, points2, None)
    x1, x2 = (torch.cat([x, torch.ones_like(x[..., :1])], -1).mT.contiguous() for x in (frame.x1, frame.x2))
    scale = 2 * frame.T[:, 0, 0, None]
    model = Essential.of_cameras(K1, K2, frame.T, frame.T) if calibrated else Fundamental()
    F_mat = frame.inverse.mT @ scenes(kind, 5, 200).F_mat @ frame.inverse
    start, weights = model.state(F_mat / torch.linalg.matrix_norm(F_mat, keepdim=True)), torch.ones(5, 1, 200).double()
    found = moments.descend(Evidence.from_points(x1, x2), start, weights, lambda _: scale.square()[:, None], 60)
    for i, best in enumerate(found.matrix()):
        row = slice(i, i + 1)
        own = Essential(model.C1[row], model.C2[row]) if calibrated else model
        cost = RobustCost(own, x1[row], x2[row], weights[0], GemanMcClure(float(scale[i])))
        optimum = minimize(cost, own.state(best[None]), 100, 1e-10)[1].state.matrix()[0]
        assert up_to_sign(best, optimum) < 1e-5


def _origin(found):
    eye = torch.eye(3, dtype=torch.float64).expand_as(found.R)
    return eye, torch.zeros_like(found.t)[..., None]


def test_planes_and_outliers():
    """Points on a plane, of which a fifth has a wrong partner."""
    generator, K = seeded(3), torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], dtype=torch.float64)
    points1 = uniform(10, 100, 2, seed=3) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    rays = torch.linalg.solve(K, torch.cat([points1, torch.ones_like(points1[..., :1])], -1).mT).mT
    X = rays * (5 / (1 + 0.3 * rays[..., :1] - 0.2 * rays[..., 1:2]))
    R = torch.matrix_exp(torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.05], [-0.2, 0.05, 0]], dtype=torch.float64))
    t = torch.tensor([0.8, 0.1, 0.3], dtype=torch.float64)
    x2 = (X @ R.mT + t) @ K.mT
    points2 = x2[..., :2] / x2[..., 2:]
    points2[:, :20] = 600 * torch.rand(10, 20, 2, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        found = pose_layer(samples=64).estimate(points1, points2, K, K)
    assert (kln.sampson_distance(points1[:, 20:], points2[:, 20:], found.F_mat).amax(1) < 1e-3).double().mean() >= 0.8
    assert ((found.R - R).flatten(1).norm(dim=1) < 1e-3).any()  # a plane has two poses


@torch.no_grad()
def test_samples_find_the_homography_where_the_weights_do_not():
    """An untrained network gives all matches the same weight."""
    points1, points2, H = plane(10, 100, noise=0.1, outliers=0.3)
    torch.manual_seed(0)
    layers = [kln.LearnedHomography(width=16, depth=1, stages=1, samples=samples) for samples in (0, 256)]
    without, found = (
        torch.tensor([corner_error(*pair) for pair in zip(layer(points1, points2), H, strict=True)]) for layer in layers
    )
    assert (found < without / 4).double().mean() >= 0.8


@pytest.mark.parametrize("number", [7, 8, 40])
@torch.no_grad()
def test_padding_of_a_homography_has_no_effect(number):
    """Few present matches are not searched, however many rows there are."""
    points1, points2 = planar(3, number)
    layer, mask = homography_layer(), torch.arange(number + 20).expand(3, -1) < number
    padded = [torch.cat([p, p[:, :1].expand(-1, 20, -1)], 1) for p in (points1, points2)]
    assert up_to_sign(layer(*padded, mask=mask), layer(points1, points2)) < 1e-6


@settings(max_examples=8)
@given(num_points=st.sampled_from([12, 30, 300]), seed=st.integers(0, 2**20), shift=st.floats(-1e3, 1e3))
@torch.no_grad()
def test_invariances(num_points, seed, shift):
    """To the order of the correspondences, a swap of the views, and moved pixels with moved cameras."""
    layer, (points1, points2, K1, K2) = pose_layer(), inputs("handheld", 4, num_points, seed=seed)
    found, order = layer.estimate(points1, points2, K1, K2), torch.randperm(num_points, generator=seeded(seed))
    shuffled = layer.estimate(points1[:, order], points2[:, order], K1, K2)
    assert up_to_sign(shuffled.E_mat, found.E_mat) < 1e-5
    assert torch.allclose(shuffled.weights, found.weights[:, order], atol=1e-6)
    swapped = layer.estimate(points2, points1, K2, K1)
    assert up_to_sign(swapped.E_mat.mT, found.E_mat) < 1e-5
    move = torch.eye(3, dtype=torch.float64)
    move[:2, 2] = shift
    moved = layer(points1 + shift, points2 + shift, move @ K1, move @ K2)
    assert up_to_sign(moved, found.E_mat) < 1e-5


@settings(max_examples=5)
@given(num_points=st.sampled_from([4, 5, 30]), seed=st.integers(0, 2**20), shift=st.floats(-1e3, 1e3))
@torch.no_grad()
def test_invariances_of_a_homography(num_points, seed, shift):
    """Moved pixels move the matrix along: it has no cameras."""
    layer, (points1, points2) = homography_layer(), planar(4, num_points)
    found, order = layer.estimate(points1, points2), torch.randperm(num_points, generator=seeded(seed))
    assert up_to_sign(layer(points1[:, order], points2[:, order]), found.H_mat) < 1e-6
    assert up_to_sign(layer.model.swap(layer(points2, points1)), found.H_mat) < 1e-6
    T = torch.tensor([[0.5, 0, shift], [0, 0.5, shift], [0, 0, 1]], dtype=torch.float64)
    moved = layer(points1 / 2 + shift, points2 / 2 + shift)
    assert up_to_sign(layer.model.carry(moved, T, T), found.H_mat) < 1e-5


@both
def test_masked_rows_do_not_count(kind):
    layer, (points1, points2, *cameras) = LAYERS[kind](), INPUTS[kind]("orbit", 3, 20)
    mask = torch.arange(20).expand(3, 20) < 12
    hidden = [torch.where(mask[..., None], p, torch.nan).requires_grad_() for p in (points1, points2)]
    found = layer(*hidden, *cameras, mask=mask)
    assert up_to_sign(found.detach(), layer(points1[:, :12], points2[:, :12], *cameras).detach()) < 1e-6
    signless(found).sum().backward()
    for points in hidden:
        assert points.grad[~mask].eq(0).all()
        assert points.grad.isfinite().all()


DEGENERATE = {
    "coincident": lambda p: (p[:, :1].expand_as(p), p[:, :1].expand_as(p)),
    "four places": lambda p: (p[:, torch.arange(12) % 4], p[:, torch.arange(12) % 4] + 5),
    "collinear": lambda p: (p * torch.tensor([1, 0]).to(p), p * torch.tensor([1, 0]).to(p) + 3),
    "no motion": lambda p: (p, p),
    "zero": lambda p: (0 * p, 0 * p),
    "unrelated": lambda p: (p, p.flip(1)),
}
DETERMINED = {"pose": ["no motion", "unrelated"], "homography": ["four places", "no motion", "unrelated"]}


@pytest.mark.parametrize("kind", ["fundamental", "pose"])
def test_sets_of_few_outliers_leave_stages_out(kind):
    """A set that needs its stages, in the same batch, changes nothing but the time."""
    cls = {"fundamental": kln.LearnedEightPoint, "pose": kln.LearnedRelativePose}[kind]
    layer, calls = cls.from_pretrained(), []
    for network in layer.networks:
        network.register_forward_hook(lambda *_: calls.append(1))
    scene = scenes("handheld", 3, 200, noise=0.5)
    points = (scene.points1, scene.points2) + ((scene.K1, scene.K2) if kind == "pose" else ())
    points[1][2, :120] = uniform(120, 2, high=400.0)
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


def turned_in(points, K, share):
    """Points moved towards the principal point, in the corners by a share of their distance."""
    offsets = points - K[:, None, :2, 2]
    squares = offsets.square().sum(-1, keepdim=True)
    return K[:, None, :2, 2] + offsets * (1 - share * squares / squares.amax(1, keepdim=True))


def test_cameras_are_left_where_matches_contradict_them():
    """The matrix is essential still, its gradient finite, the pose better than with the cameras; right ones stay."""
    layer, errors = kln.LearnedRelativePose.from_pretrained(), []
    scene = scenes("handheld", 8, 400, noise=0.3)
    cameras = scene.K1, scene.K2
    moved = [turned_in(p, K, 0.1) for p, K in zip((scene.points1, scene.points2), cameras, strict=True)]
    for least in (0.0, torch.inf):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(camera_evidence, "MIN_EFFECT", max(least, camera_evidence.MIN_EFFECT))
            found = layer.estimate(*moved, *cameras)
            errors.append(pose_error(found.R, found.t, scene.R, scene.t))
            values = torch.linalg.svdvals(found.E_mat.detach())
            assert torch.allclose(values[:, 0], values[:, 1], rtol=1e-9)
    assert errors[0].median() < 0.8 * errors[1].median()
    moved[0].requires_grad_()
    gradient = torch.autograd.grad(layer(*moved, *cameras)[:, 0].sum(), moved[0])[0]
    assert torch.isfinite(gradient).all()
    assert (gradient.abs().amax((1, 2)) > 0).all()
    points = scene.points1, scene.points2
    kept = layer(*points, *cameras)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_evidence, "MIN_EFFECT", torch.inf)
        assert torch.equal(kept, layer(*points, *cameras))


def test_contradiction_is_that_of_an_f_test():
    """The gain of two more parameters is that of least squares, computed from the distances' derivatives."""
    scene = scenes("handheld", 1, 300, noise=0.3)
    points = [convert_points_to_homogeneous(p / 200).mT for p in (scene.points1, scene.points2)]
    T = torch.diag(torch.tensor([1 / 200, 1 / 200, 1.0], dtype=torch.float64))[None]
    model = Essential.of_cameras(scene.K1, scene.K2, T, T)
    evidence, weights = Evidence.from_points(*points), torch.ones(1, 300, dtype=torch.float64)
    start = model.calibrated(true_essential(scene))
    scale = torch.full((1, 1), 0.02, dtype=torch.float64)
    state = minimize(RobustCost(model, *points, weights, GemanMcClure(0.02)), start, 50, 1e-9)[1].state
    F_mat = state.matrix()
    distance, J = Fundamental().linearise(F_mat, *points)
    inner = (1 + (distance / scale).square()) ** -2
    rows, right = J[0].mT * inner[0, :, None].sqrt(), distance[0] * inner[0].sqrt()
    costs = []
    for tangents in (state.tangents()[0], Fundamental().state(F_mat).tangents()[0]):
        A = rows @ tangents
        costs.append((right - A @ torch.linalg.lstsq(A, right[:, None]).solution[:, 0]).square().sum())
    gain = (costs[0] - costs[1]) * inner.sum() / (inner.square() * distance.square()).sum() / (inner.sum() - 7)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_evidence, "SIGNIFICANCE", 1.0)
        patch.setattr(camera_evidence, "MIN_PRECISION", 0.0)
        for factor in (0.97, 1.03):
            patch.setattr(camera_evidence, "MIN_EFFECT", float(factor * gain))
            found = camera_evidence.contradict_cameras(evidence, state, weights, scale.square())
            assert found.tolist() == [factor < 1]


@both
@pytest.mark.parametrize("name", DEGENERATE)
def test_finite_on_degenerate_sets(kind, name):
    points = [p.clone().requires_grad_() for p in DEGENERATE[name](uniform(3, 12, 2, high=600))]
    layer = LAYERS[kind]()
    found = layer.estimate(*points, *INPUTS[kind]("orbit", 3, 12)[2:])
    assert found.determined.any() == (name in DETERMINED[kind])
    matrices = [getattr(found, key) for key in SHAPES[kind]]
    loss = signless(found[0]).sum() + sum(value.sum() for value in matrices[1:]) + found.weights.sum()
    gradients = torch.autograd.grad(loss, [*points, *layer.parameters()], allow_unused=True)
    for value in (*matrices, *(g for g in gradients if g is not None)):
        assert value.isfinite().all()


@both
def test_gradients(kind):
    """With many steps derivatives are those of the optimum."""
    layer = LAYERS[kind](stages=1, refine_steps=60, samples=0 if kind == "pose" else 8)
    points1, points2, *cameras = INPUTS[kind]("orbit", 1, 12)

    def numbers(points1, points2, scores):
        return signless(layer(points1, points2, *(K[0] for K in cameras), scores=scores))

    # Numbers of a homography of pixels are tiny in its last row.
    points, eps = (points1, points2), 1e-6 if cameras else 1e-4
    check_gradients(numbers, *points, uniform(1, 12), eps=eps, atol=1e-4 if cameras else 1e-6, rtol=1e-2)


@both
def test_every_parameter_gets_a_gradient(kind):
    layer = LAYERS[kind]()
    found = layer.estimate(*INPUTS[kind]("orbit", 3, 20))
    (signless(found[0]).sum() + sum(signless(stage[0]).sum() for stage in found.stages)).backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in layer.parameters())


@both
def test_matches_of_networks(kind):
    points1, points2, *cameras = INPUTS[kind]("orbit", 2, 30)
    few = 4 if kind == "pose" else 3
    matches = [torch.arange(20)[:, None].expand(20, 2), torch.arange(few)[:, None].expand(few, 2)]
    scores = [torch.rand(len(pairs), dtype=torch.float64, requires_grad=True) for pairs in matches]
    found = LAYERS[kind]().from_matches(points1, points2, matches, scores, *cameras)
    assert found.determined.tolist() == [True, False]
    first, second = torch.autograd.grad(signless(found[0]).sum(), scores)
    assert first.any()
    assert not second.any()


@both
@pytest.mark.long
def test_vmap_and_compile_agree(kind, monkeypatch):
    """The traced graph is whole; how fast its code is, is another question. Export has a test of its own."""
    monkeypatch.setattr(pose_stages, "LOCAL_STEPS", 1)
    layer, values = LAYERS[kind](refine_steps=2), INPUTS[kind]("orbit", 2, 20)
    expected = layer(*values).detach()
    mapped = torch.func.vmap(lambda *rows: layer(*(row[None] for row in rows))[0])(*values)
    assert up_to_sign(mapped.detach(), expected) < 1e-6
    traced = torch.compile(layer, backend="eager", fullgraph=True)
    assert up_to_sign(traced(*values).detach(), expected) < 1e-6


def test_autocast_leaves_the_solver_in_float64():
    layer, values = pose_layer().float(), inputs("orbit", 2, 40, noise=0.0)
    points1, points2, H = plane(2, 40)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, homography = layer(*values), homography_layer(refine_steps=10).float()(points1, points2)
    assert found.dtype == homography.dtype == torch.float64
    assert up_to_sign(found.detach(), true_essential(scenes("orbit", 2, 40, noise=0.0))) < 1e-6
    assert corner_error(homography, H) < 1e-4


@both
def test_files(kind, tmp_path):
    layer, own = LAYERS[kind](), {"pose": "essential", "homography": "homography"}[kind]
    layer.trained_on = ("one",)
    layer.save_pretrained(tmp_path / "own.safetensors")
    loaded = type(layer).from_pretrained(tmp_path / "own.safetensors")
    assert (loaded.trained_on, loaded.extra_repr(), loaded.training) == (("one",), layer.extra_repr(), False)
    values = INPUTS[kind]("orbit", 2, 20)
    assert torch.equal(loaded(*values), layer(*values))
    assert torch.equal(pickle.loads(pickle.dumps(loaded))(*values), layer(*values))
    with pytest.raises(ValueError, match=rf"model '{own}', expected 'fundamental'"):
        kln.LearnedEightPoint.from_pretrained(tmp_path / "own.safetensors")


def test_homography_of_an_earlier_version(tmp_path):
    """Before, there were no samples."""

    def drop(_, metadata):
        architecture = json.loads(metadata["architecture"])
        del architecture["samples"]
        metadata["architecture"] = json.dumps(architecture)

    homography_layer().save_pretrained(tmp_path / "own.safetensors")
    rewrite_weights(tmp_path / "own.safetensors", drop)
    assert kln.LearnedHomography.from_pretrained(tmp_path / "own.safetensors").samples == 64


@both
def test_starts_from_an_eight_point_estimator(kind):
    eight = kln.LearnedEightPoint.from_pretrained("robust-tiny")
    layer = type(LAYERS[kind]()).from_eight_point(eight).eval()
    points1, points2, *cameras = INPUTS[kind]("orbit", 2, 60)
    scores = uniform(2, 60)
    first = eight.estimate(points1, points2, scores=scores).stages[0].logits
    found = layer.estimate(points1, points2, *cameras, scores=scores).stages[0].logits
    assert torch.allclose(found, first, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"K1": None}, ValueError, "cameras K1 and K2 are needed"),
        ({"K1": torch.zeros(3, 3)}, ValueError, "K1"),
        ({"K2": torch.eye(3).expand(5, 3, 3)}, Exception, "K2"),
        ({"points1": torch.rand(2, 4, 2), "points2": torch.rand(2, 4, 2)}, ValueError, "at least 5 .*, got 4"),
        ({"points1": torch.rand(2, 7, 2)}, ValueError, "pair up"),
        ({"points1": torch.full((2, 8, 2), torch.nan)}, ValueError, "finite"),
        ({"scores": torch.full((2, 8), 2.0)}, ValueError, "scores .* got 2 to 2"),
        ({"weights": torch.full((2, 8), -1.0)}, ValueError, "weights"),
    ],
)
def test_wrong_input(change, error, message):
    given = dict(zip(("points1", "points2"), (p.float() for p in correspondences("orbit", 2, 8)), strict=True))
    with pytest.raises(error, match=message):
        pose_layer()(**given | {"K1": torch.eye(3), "K2": torch.eye(3)} | change)


def test_wrong_input_of_a_homography():
    check_refuses(homography_layer(), least=4)
    points = torch.rand(2, 8, 2)
    with pytest.raises(ValueError, match=r"scores .* got 2 to 2"):
        homography_layer()(points, points, scores=torch.full((2, 8), 2.0))
    for name in ("refine_steps", "samples"):
        with pytest.raises(ValueError, match=f"{name} must be"):
            kln.LearnedHomography(**{name: -1})


def test_wrong_options():
    for options, message in [({"samples": -1}, "samples must be"), ({"width": 0}, "width must be")]:
        with pytest.raises(ValueError, match=message):
            kln.LearnedRelativePose(**options)

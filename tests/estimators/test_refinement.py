"""Levenberg-Marquardt against Gauss-Newton in NumPy on numerical derivatives; invariances are in test_contract.py."""

import numpy as np
import pytest
import references as ref
import torch
from hypothesis import given
from hypothesis import strategies as st
from pairwise import pairwise
from scenes import SCENES, correspondences, raises, scenes, uniform
from torch.autograd import gradcheck

import kornia_learnnorm as kln
from kornia_learnnorm import find_fundamental, refine_essential, refine_fundamental
from kornia_learnnorm.estimators.optimize import UNROLLED_SCALE, refine_unrolled
from kornia_learnnorm.estimators.robust_losses import Cauchy, GemanMcClure, Huber, Truncated, squared_loss
from kornia_learnnorm.models.fundamental import Fundamental

# Distances in pixels, those of Sampson with signs.
DISTANCES = {"sampson": ref.numpy_sampson, "symmetric": ref.epipolar_distances}
LOSSES = [squared_loss, Huber(0.5), Cauchy(0.5), GemanMcClure(2.0), Truncated(3.0)]
both = pytest.mark.parametrize("calibrated", [False, True])


def problem(calibrated: bool, name: str = "handheld", batch_size: int = 3, num_points: int = 40, **options):
    """A function that refines matrices of a scene's points, points and cameras, and matrices to start from."""
    scene = scenes(name, batch_size, num_points, **{"noise": 0.5} | options)
    points = scene.points1, scene.points2
    if calibrated:
        return refine_essential, (points, (scene.K1, scene.K2)), ref.true_essential(scene)
    return refine_fundamental, (points, ()), find_fundamental(*points)


def disturbed(M, size: float = 0.02, seed: int = 7) -> torch.Tensor:
    return M + size * uniform(*M.shape, low=-1, seed=seed)


def near_in_hartley(F, points, size: float, seed: int = 7) -> torch.Tensor:
    """Matrices of pixels that differ from F in Hartley's coordinates, where all nine entries count."""
    T1, T2 = (torch.from_numpy(ref.numpy_hartley(p)) for p in points)
    return T2.mT @ disturbed(torch.from_numpy(ref.in_hartley(F, *points)), size, seed) @ T1


def fundamental_chart(F, points1, points2):
    """Matrices [a b a*s + b*t] about F by eight numbers (epipole by two ratios), and those of F."""
    T1, T2 = (ref.numpy_hartley(p[None])[0] for p in (points1, points2))
    F = ref.unit(np.linalg.inv(T2).T @ F @ np.linalg.inv(T1))
    # Turn the epipole of view 1 to the third axis, where the last column of F vanishes and the chart is centred.
    V = np.linalg.svd(F)[2].T

    def chart(q):
        return T2.T @ np.column_stack([q[:6].reshape(3, 2), q[:6].reshape(3, 2) @ q[6:]]) @ V.T @ T1

    return chart, np.concatenate([(F @ V)[:, :2].reshape(6), np.zeros(2)])


def essential_chart(R, t, K1, K2):
    """Matrices of pixels about those of a pose by a rotation vector and two angles of t, and five zeros."""
    t = t / np.linalg.norm(t)
    side = np.linalg.svd(t[None])[2][1:]

    def chart(q):
        angle = np.linalg.norm(q[:3]) + 1e-300
        k = ref.cross(q[:3] / angle)
        turned = (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k) @ R
        return np.linalg.inv(K2).T @ ref.cross(t + q[3:] @ side) @ turned @ np.linalg.inv(K1)

    return chart, np.zeros(5)


@both
@pytest.mark.parametrize("batch_size", [0, 1, 5])
def test_smoke(calibrated, batch_size, device, dtype):
    points = [uniform(batch_size, 20, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
    K = torch.tensor([[500.0, 0, 300], [0, 510, 200], [0, 0, 1]], device=device)
    refine, cameras = (refine_essential, (K, K)) if calibrated else (refine_fundamental, ())
    found = refine(*points, uniform(batch_size, 3, 3).to(device), *cameras, max_iterations=5)
    assert [value.dtype for value in found] == [*(3 + calibrated) * [dtype], torch.int64, torch.bool]
    assert [value.shape for value in found] == [*(1 + calibrated) * [(batch_size, 3, 3)], *4 * [(batch_size,)]]
    assert all(value.device.type == device.type for value in found)


@pairwise(name=["driving", "handheld", "orbit"], kind=DISTANCES, num_points=[12, 40], calibrated=[False, True])
def test_agrees_with_numpy(name, kind, num_points, calibrated):
    scene = scenes(name, 3, num_points, noise=0.5)
    refine, (points, cameras), start = problem(calibrated, name, 3, num_points)
    found = refine(*points, start, *cameras, distance=kind, max_iterations=200)
    arguments = (scene.R, scene.t, *cameras) if calibrated else (start, *points)
    step = 1e-7 if calibrated else 1e-6
    for row, (*own, x1, x2) in enumerate(zip(*(value.numpy() for value in (*arguments, *points)), strict=True)):
        chart, q = (essential_chart if calibrated else fundamental_chart)(*own)
        expected = ref.least_squares(lambda q, c=chart, x=(x1, x2): DISTANCES[kind](*x, c(q)), q, step)
        assert found.cost[row].item() == pytest.approx(expected, rel=1e-6)
    assert found.converged.all()


@both
@pairwise(kind=DISTANCES, loss=LOSSES)
def test_costs_are_those_of_the_matrices(calibrated, kind, loss):
    refine, (points, cameras), start = problem(calibrated, batch_size=10, num_points=15)
    weights = uniform(10, 15)
    found = refine(*points, start, *cameras, weights, distance=kind, loss=loss)
    before = torch.linalg.inv(cameras[1]).mT @ start @ torch.linalg.inv(cameras[0]) if calibrated else start
    for F_mat, cost in ((before, found.cost_before), (found.F_mat, found.cost)):
        squares = torch.from_numpy(DISTANCES[kind](*points, F_mat) ** 2)
        np.testing.assert_allclose(cost, (weights * loss(squares)[0]).sum(-1), rtol=1e-7)
    assert (found.cost <= found.cost_before).all()


def test_essential_matrices():
    refine, (points, (K1, K2)), start = problem(True)
    found = refine(*points, disturbed(start).requires_grad_(), K1, K2)
    np.testing.assert_allclose(np.linalg.svd(found.E_mat)[1], np.tile([0.5**0.5, 0.5**0.5, 0], (3, 1)), atol=1e-12)
    assert ref.up_to_sign(found.F_mat, torch.linalg.inv(K2).mT @ found.E_mat @ torch.linalg.inv(K1)) < 1e-10
    assert not any(value.requires_grad for value in found)


@pairwise(kind=DISTANCES, loss=LOSSES)
def test_nothing_near_the_optimum_costs_less(kind, loss):
    _, (points, _), start = problem(False, "orbit", 10, 30)
    found = refine_fundamental(*points, start, None, kind, loss, 300)
    assert found.converged.all()
    for seed in range(5):
        near = near_in_hartley(found.F_mat, points, 1e-3, seed)
        assert (refine_fundamental(*points, near, None, kind, loss, 0).cost > found.cost * (1 - 1e-9)).all()


@pytest.mark.parametrize(
    ("calibrated", "kind", "num_points"),
    [*((False, kind, number) for kind in DISTANCES for number in (8, 20)), *((True, "sampson", n) for n in (5, 6, 20))],
)
def test_exact_points(calibrated, kind, num_points):
    name = "handheld" if calibrated else "orbit"
    refine, (points, cameras), start = problem(calibrated, name, 20, num_points, noise=0.0)
    near = disturbed(start, 1e-3) if calibrated else near_in_hartley(start, points, 1e-4)
    for M in (start, near):
        found = refine(*points, M, *cameras, distance=kind, max_iterations=200)
        assert (found.cost < 1e-16).all()
        if num_points > 6:
            assert found.converged.all()
            assert not calibrated or ref.up_to_sign(found.E_mat, start) < 1e-7


@pytest.mark.parametrize("loss", LOSSES[1:])
def test_robust_losses_see_past_outliers(loss):
    scene = scenes("orbit", 20, 60, noise=0.2, outliers=0.1)
    F0 = find_fundamental(scene.points1, scene.points2, torch.where(scene.inliers, 1.0, 1e-9))
    squares, robust = (refine_fundamental(scene.points1, scene.points2, F0, loss=x) for x in (squared_loss, loss))
    distances = (ref.epipolar_distances(*scene[:2], found.F_mat)[scene.inliers.numpy()] for found in (squares, robust))
    without, found = map(np.median, distances)
    assert found < 0.5 * without


@given(st.integers(0, 2**31), *map(st.sampled_from, ([8, 9, 30], [*SCENES], [*DISTANCES], LOSSES, range(13))))
def test_cost_never_rises_and_rank_two_holds(seed, num_points, name, kind, loss, max_iterations):
    points1, points2 = correspondences(name, 5, num_points, seed)
    F0 = find_fundamental(points1, points2)
    found = refine_fundamental(points1, points2, F0, None, kind, loss, max_iterations)
    assert (found.cost <= found.cost_before).all()
    assert (found.iterations <= max_iterations).all()
    assert np.linalg.norm(found.F_mat.numpy(), axis=(1, 2)) == pytest.approx(1, abs=1e-14)
    for F in (found.F_mat.numpy(), ref.in_hartley(found.F_mat, points1, points2)):
        assert (np.linalg.svd(F)[1][:, 2] < 1e-12).all()


@pytest.mark.parametrize("scale", [1e-3, 7.0, 1e3])
def test_order_views_and_unit_do_not_matter_to_essential_matrices(scale):
    refine, (points, K), start = problem(True)
    start, order = disturbed(start), torch.randperm(40, generator=torch.Generator().manual_seed(0))
    found, shuffled = (refine(*p, start, *K) for p in (points, [p[:, order] for p in points]))
    assert ref.up_to_sign(found.E_mat, shuffled.E_mat) < 1e-7
    assert ref.up_to_sign(found.E_mat, refine(*points[::-1], start.mT, *K[::-1]).E_mat.mT) < 1e-7
    T = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
    scaled = refine(*(scale * p for p in points), start, *(T @ camera for camera in K))
    assert ref.up_to_sign(found.E_mat, scaled.E_mat) < 1e-7
    np.testing.assert_allclose(scaled.cost, scale**2 * found.cost)


@both
@pairwise(num_points=[20, 3000], weighted=[False, True])  # points as one part and as several
def test_matrices_may_share_points(calibrated, num_points, weighted):
    refine, (points, cameras), start = problem(calibrated, batch_size=1, num_points=num_points)
    weights, cameras = uniform(1, num_points, low=0.1) if weighted else None, [K[0] for K in cameras]
    starts = disturbed(start.repeat(8, 1, 1), 0.02 if calibrated else 1e-6)
    many = [None if value is None else value.expand(8, *value.shape[1:]) for value in (*points, weights)]
    options = {"loss": Cauchy(1.0), "max_iterations": 8}
    shared = refine(*points, starts, *cameras, weights, **options)
    copied = refine(*many[:2], starts, *cameras, many[2], **options)
    assert ref.up_to_sign(shared.F_mat, copied.F_mat) < 1e-7
    assert torch.equal(shared.iterations, copied.iterations)


@pytest.mark.parametrize("loss", [squared_loss, Cauchy(0.5)])
def test_tolerance_trades_steps_for_cost(loss):
    _, (points, _), start = problem(False, "driving", 20, 100)
    loose, tight = (refine_fundamental(*points, start, loss=loss, tolerance=t) for t in (1e-3, 1e-7))
    assert loose.converged.all()
    assert (loose.iterations <= tight.iterations).all()
    assert loose.iterations.sum() < 0.5 * tight.iterations.sum()
    assert (loose.cost <= tight.cost * 1.002).double().mean() > 0.9


@pytest.mark.parametrize("loss", [Huber(1.0), Cauchy(1.0), GemanMcClure(1.0)])
def test_converges_among_outliers(loss):
    scene = scenes("handheld", 40, 100, noise=1.0)
    points2 = scene.points2.clone()
    points2[:, :40] += uniform(40, 40, 2, low=-60, high=60)
    assert refine_fundamental(scene.points1, points2, scene.F_mat, loss=loss).converged.sum() > 36


def test_returns_the_start_where_no_step_is_possible():
    _, (points, _), start = problem(False, batch_size=5, num_points=12)
    found = refine_fundamental(*points, start, loss=lambda squares: (squares, torch.full_like(squares, torch.nan)))
    assert ref.up_to_sign(found.F_mat, start) < 1e-12
    assert torch.equal(found.cost, found.cost_before)
    assert not found.converged.any()


class TestGradients:
    @pairwise(kind=DISTANCES, loss=[squared_loss, Cauchy(0.3)])
    def test_at_the_optimum(self, kind, loss):
        scene = scenes("orbit", 1, 14, noise=1.0)
        points = [(points / 300 - 1).requires_grad_() for points in scene[:2]]
        F0 = find_fundamental(*points).detach()
        optimum = refine_fundamental(*points, F0, distance=kind, loss=loss, max_iterations=500)
        assert optimum.converged.all()
        start = optimum.F_mat.detach()
        weights = uniform(1, 14, low=0.9, high=1.1, seed=3).requires_grad_()

        def refined(points1, points2, weights):
            return ref.signless(refine_fundamental(points1, points2, start, weights, kind, loss, 500).F_mat)

        # A central difference of the iteration stops within 1e-7 of the gradient's zero.
        assert gradcheck(refined, [*points, weights], eps=1e-5, atol=1e-3, rtol=1e-3, fast_mode=True)

    def test_shared_points_take_the_gradients_of_all(self):
        points = correspondences("orbit", 1, 14, noise=1.0)
        F0 = find_fundamental(*points).repeat(3, 1, 1)
        gradients = []
        for count in (1, 3):
            values = [value.repeat(count, 1, 1).requires_grad_() for value in points]
            found = refine_fundamental(*values, F0, max_iterations=60)
            assert found.converged.all()
            gradients.append([g.sum(0) for g in torch.autograd.grad(ref.signless(found.F_mat).sum(), values)])
        torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-8)

    def test_without_gradients_the_result_is_the_same(self):
        points1, points2 = correspondences("orbit", 5, 12)
        F0 = find_fundamental(points1, points2).requires_grad_()
        plain = refine_fundamental(points1, points2, F0)
        tracked = refine_fundamental(points1.requires_grad_(), points2, F0)
        assert not plain.F_mat.requires_grad  # the start sends none
        assert ref.up_to_sign(plain.F_mat, tracked.F_mat.detach()) < 1e-12
        assert not tracked.cost.requires_grad

    def test_none_where_it_did_not_converge(self):
        points1, points2 = (points.requires_grad_() for points in correspondences("driving", 5, 8))
        found = refine_fundamental(points1, points2, find_fundamental(points1, points2).detach(), max_iterations=1)
        (gradient,) = torch.autograd.grad(ref.signless(found.F_mat).sum(), points1)
        assert not found.converged.any()
        assert (gradient == 0).all()


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_of_losses(loss):
    squares = uniform(50, high=20).requires_grad_()
    value, weight = loss(squares)
    torch.testing.assert_close(weight.detach(), torch.autograd.grad(value.sum(), squares)[0])
    assert [part.item() for part in loss(torch.zeros(1))] == [0, 1]


@pytest.mark.parametrize("kind", [Huber, Cauchy, GemanMcClure, Truncated])
def test_scale_must_be_positive(kind):
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        raises(ValueError, f"scale must be positive and finite, got {scale}", kind, scale)
    raises(TypeError, "scale must be a number of pixels, got '1'", kind, "1")


POINTS, EYE = uniform(2, 10, 2), torch.eye(3, dtype=torch.float64)
WRONG_OPTIONS = [
    ({"loss": "huber"}, TypeError, "loss must be a function or an instance .* got 'huber'"),
    ({"distance": "foo"}, ValueError, "distance must be"),
    ({"max_iterations": 2.5}, TypeError, "max_iterations must be a whole number, got 2.5"),
    ({"max_iterations": -1}, ValueError, "max_iterations and tolerance must be >= 0, got -1 and 1e-07"),
    *(({"tolerance": x}, ValueError, f"tolerance must be >= 0, got 50 and {x}") for x in (-0.5, float("nan"))),
]
WRONG_OF_ESSENTIAL = [
    ({"points1": POINTS[:, :4], "points2": POINTS[:, :4]}, ValueError, "at least 5 correspondences .* got 4"),
    ({"points2": POINTS[:1]}, ValueError, "must pair up"),
    ({"E_mat": EYE[None]}, ValueError, "one matrix per set of points is needed, got 1 matrices and 2 sets"),
    ({"E_mat": None}, TypeError, "E_mat must be a floating-point tensor"),
    ({"K1": None}, ValueError, "K1 and K2 must be given together, got only K2"),
    ({"K1": EYE.repeat(3, 1, 1)}, ValueError, r"K1 must have shape .* or \[2, 3, 3\] or .*, got \[3, 3, 3\]"),
]


def test_wrong_arguments():
    """Of the points, weights and matrices that refine_fundamental gets see test_contract.py."""
    given = {"points1": POINTS, "points2": POINTS, "E_mat": EYE.repeat(2, 1, 1), "K1": EYE, "K2": EYE}
    for wrong, error, message in WRONG_OPTIONS:
        raises(error, message, refine_fundamental, POINTS, POINTS, EYE.repeat(2, 1, 1), **wrong)
    for wrong, error, message in WRONG_OPTIONS + WRONG_OF_ESSENTIAL:
        raises(error, message, refine_essential, **given | wrong)


@pytest.mark.parametrize("num_points", [12, 40])
def test_is_the_optimum_at_its_scale(num_points):
    """Dividing a set's points by its scale gives Geman and McClure's loss at one pixel."""
    points1, points2 = ((p - 300) / 200 for p in correspondences("handheld", 6, num_points, noise=0.3))
    F_mat, weights = find_fundamental(points1, points2), uniform(6, num_points, low=0.2)
    x1, x2 = (torch.from_numpy(ref.homogeneous(p.numpy())) for p in (points1, points2))
    found = refine_unrolled(Fundamental(), x1.mT, x2.mT, F_mat, weights, 60)
    distance = kln.sampson_distance(points1, points2, F_mat)
    mean = ((weights * (distance**2 + 1e-10).log() / 2).sum(1) / weights.sum(1)).exp()
    effective = (weights.sum(1) ** 2 / (weights**2).sum(1)).clamp(min=8)
    scale = (UNROLLED_SCALE * mean * (effective / (effective - 7)).sqrt())[:, None, None]
    T = torch.diag_embed(torch.cat([scale[:, 0], scale[:, 0], torch.ones_like(scale[:, 0])], -1))
    options = {"loss": kln.GemanMcClure(1.0), "max_iterations": 200}
    expected = kln.refine_fundamental(points1 / scale, points2 / scale, T @ F_mat @ T, weights, **options).F_mat
    T = torch.linalg.inv(T)
    assert ref.up_to_sign(found, T @ expected @ T) < 1e-4

"""The learned relative pose: truth, planes, steps on moments, and cameras that the matches contradict."""

import pytest
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import essential_from_Rt
from kornia.geometry.linalg import transform_points
from pairwise import pairwise
from references import true_essential, up_to_sign
from scenes import distorted, roughened, scenes, seeded, uniform
from torch.nn.functional import normalize

import kornia_learnnorm as kln
from kornia_learnnorm.estimators import camera_evidence, moments, pose_stages
from kornia_learnnorm.estimators.moments import Evidence
from kornia_learnnorm.estimators.network_features import CommonFrame
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental


@pairwise(kind=["orbit", "handheld", "driving"], num_points=[6, 8, 50, 400])
def test_finds_the_truth_without_noise(kind, num_points):
    scene = scenes(kind, 20, num_points, noise=0.0)
    with torch.no_grad():
        found = roughened(kln.LearnedRelativePose).estimate(scene.points1, scene.points2, scene.K1, scene.K2)
    assert found.determined.all()
    gaps = torch.stack([(found.E_mat - s * true_essential(scene)).flatten(1).norm(dim=1) for s in (1, -1)]).amin(0)
    right = gaps < 1e-7
    assert right.double().mean() >= (0.8 if num_points == 6 else 1.0)  # six points can have two solutions
    assert (found.R - scene.R)[right].abs().max() < 1e-6
    assert (found.t - normalize(scene.t, dim=-1))[right].abs().max() < 1e-6
    origin = torch.eye(3, dtype=torch.float64).expand_as(found.R), torch.zeros_like(found.t)[..., None]
    assert up_to_sign(essential_from_Rt(*origin, found.R, found.t[..., None]) / 2**0.5, found.E_mat) < 1e-9
    x1, x2 = (convert_points_to_homogeneous(p) for p in (scene.points1, scene.points2))
    assert (x2 * (x1 @ found.F_mat.mT)).sum(-1)[right].abs().max() < 1e-6


@pairwise(kind=["handheld", "driving"], calibrated=[False, True])
def test_steps_on_moments_end_at_the_optimum_of_the_distances(kind, calibrated):
    scene = scenes(kind, 5, 200)
    points = [p + torch.randn(p.shape, generator=seeded(1)).to(p) for p in (scene.points1, scene.points2)]
    frame = CommonFrame.from_points(*points, None)
    x1, x2 = (convert_points_to_homogeneous(x).mT.contiguous() for x in (frame.x1, frame.x2))
    scale = 2 * frame.T[:, 0, 0, None]
    model = Essential.of_cameras(scene.K1, scene.K2, frame.T, frame.T) if calibrated else Fundamental()
    F_mat = frame.inverse.mT @ scene.F_mat @ frame.inverse
    start, weights = model.state(F_mat / torch.linalg.matrix_norm(F_mat, keepdim=True)), torch.ones(5, 1, 200).double()
    found = moments.descend(Evidence.from_points(x1, x2), start, weights, lambda _: scale.square()[:, None], 60)
    for i, best in enumerate(found.matrix()):
        row = slice(i, i + 1)
        own = Essential(model.C1[row], model.C2[row]) if calibrated else model
        cost = RobustCost(own, x1[row], x2[row], weights[0], GemanMcClure(float(scale[i])))
        assert up_to_sign(best, minimize(cost, own.state(best[None]), 100, 1e-10)[1].state.matrix()[0]) < 1e-5


def test_planes_and_outliers():
    """Points on a plane, of which a fifth has a wrong partner."""
    generator, K = seeded(3), torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], dtype=torch.float64)
    points1 = uniform(10, 100, 2, seed=3) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    rays = torch.linalg.solve(K, convert_points_to_homogeneous(points1).mT).mT
    X = rays * (5 / (1 + 0.3 * rays[..., :1] - 0.2 * rays[..., 1:2]))
    R = torch.matrix_exp(torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.05], [-0.2, 0.05, 0]], dtype=torch.float64))
    t = torch.tensor([0.8, 0.1, 0.3], dtype=torch.float64)
    x2 = (X @ R.mT + t) @ K.mT
    points2 = x2[..., :2] / x2[..., 2:]
    points2[:, :20] = 600 * torch.rand(10, 20, 2, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        found = roughened(kln.LearnedRelativePose, samples=64).estimate(points1, points2, K, K)
    assert (kln.sampson_distance(points1[:, 20:], points2[:, 20:], found.F_mat).amax(1) < 1e-3).double().mean() >= 0.8
    assert ((found.R - R).flatten(1).norm(dim=1) < 1e-3).any()  # a plane has two poses


def test_few_inliers_are_searched_again(monkeypatch):
    layer, right = kln.LearnedRelativePose.from_pretrained(), []
    scene = scenes("handheld", 24, 300, noise=0.5, outliers=0.9)
    for share in (0.4, 0.0):
        monkeypatch.setattr(pose_stages, "FEW_INLIERS", share)
        with torch.no_grad():
            found = layer.estimate(scene.points1, scene.points2, scene.K1, scene.K2)
        right.append((pose_error(found.R, found.t, scene.R, scene.t) < 5).double().mean())
    assert right[0] > right[1] + 0.2


def test_normalised_coordinates():
    scene, eye = scenes("handheld", 20, 300, noise=0.5, outliers=0.5), torch.eye(3, dtype=torch.float64)[None]
    points = (transform_points(torch.linalg.inv(scene.K1), points) for points in (scene.points1, scene.points2))
    with torch.no_grad():
        found = kln.LearnedRelativePose.from_pretrained().estimate(*points, eye, eye)
    assert (pose_error(found.R, found.t, scene.R, scene.t) < 5).double().mean() > 0.8


def test_cameras_are_left_where_matches_contradict_them():
    """The matrix is essential still, the pose better than with the cameras; right ones stay."""
    layer, errors = kln.LearnedRelativePose.from_pretrained(), []
    scene = scenes("handheld", 8, 400, noise=0.3)
    points, cameras = (scene.points1, scene.points2), (scene.K1, scene.K2)
    moved = [distorted(p, K, -0.1) for p, K in zip(points, cameras, strict=True)]
    never = (camera_evidence, "MIN_EFFECT", torch.inf), (camera_evidence, "MIN_KEPT", torch.inf)
    for limit in ((camera_evidence, "MIN_KEPT", 0.3), *never):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(*limit)
            found = layer.estimate(*moved, *cameras)
            errors.append(pose_error(found.R, found.t, scene.R, scene.t))
            values = torch.linalg.svdvals(found.E_mat.detach())
            assert torch.allclose(values[:, 0], values[:, 1], rtol=1e-9)
    assert errors[0].median() < 0.8 * errors[1].median()
    assert torch.equal(errors[1], errors[2])  # a pose without cameras has to fit the correspondences
    kept = layer(*points, *cameras)
    few, alike = [p[:, :40] for p in moved], torch.ones(8, 40)
    assert up_to_sign(layer(*few, *cameras, alike * 1e3).detach(), layer(*few, *cameras, alike).detach()) < 1e-4
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_evidence, "MIN_EFFECT", torch.inf)
        assert torch.equal(kept, layer(*points, *cameras))


def test_derivatives_by_points_and_cameras_are_those_of_differences():
    layer, scene = kln.LearnedRelativePose.from_pretrained(), scenes("handheld", 8, 300, noise=0.3)
    layer.refine_steps, factor = 60, torch.rand(3, 3, generator=seeded(), dtype=torch.float64)
    exact, K = (scene.points1, scene.points2), (scene.K1, scene.K2)
    for points in (exact, [distorted(p, C, -0.1) for p, C in zip(exact, K, strict=True)]):
        values = [value.expand(8, -1, -1).clone().requires_grad_() for value in (*points, *K)]
        change = [1e-4 * torch.randn(value.shape, generator=seeded(1), dtype=value.dtype) for value in values]
        change[2][:, 2] = change[3][:, 2] = 0.0
        gradients = torch.autograd.grad((layer(*values) * factor).sum(), values)
        for part in (slice(0, 2), slice(2, 4)):
            slope = sum((g * d).sum((1, 2)) for g, d in zip(gradients[part], change[part], strict=True))
            ends = [[*values], [*values]]
            for end, sign in zip(ends, (1, -1), strict=True):
                end[part] = [v + sign * d for v, d in zip(values[part], change[part], strict=True)]
            above, below = (layer(*end).detach() for end in ends)
            assert (2 * slope / ((above - below) * factor).sum((1, 2)) - 1).abs().median() < 0.05


def test_contradiction_is_that_of_an_f_test():
    """The gain of two more parameters is that of least squares, computed from the distances' derivatives."""
    scene = scenes("handheld", 1, 300, noise=0.3)
    points = [convert_points_to_homogeneous(p / 200).mT for p in (scene.points1, scene.points2)]
    T = torch.diag(torch.tensor([1 / 200, 1 / 200, 1.0], dtype=torch.float64))[None]
    model = Essential.of_cameras(scene.K1, scene.K2, T, T)
    evidence, weights = Evidence.from_points(*points), torch.ones(1, 300, dtype=torch.float64)
    start, scale = model.calibrated(true_essential(scene)), torch.full((1, 1), 0.02, dtype=torch.float64)
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

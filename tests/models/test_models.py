"""The homography against Kornia, and steps on the manifolds of all models."""

import numpy as np
import pytest
import torch
from kornia.geometry import homography as by_kornia
from kornia.geometry.epipolar import normalize_points
from pairwise import pairwise
from references import check_gradients, corner_error, signless
from scenes import plane, raises, uniform

import kornia_learnnorm as kln
from kornia_learnnorm import GemanMcClure
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.essential import Essential, nearest_essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.models.homography import Homography, solve_four_points

NORMALIZERS = [None, kln.Identity(), kln.Whitening(), kln.ReweightedWhitening(), kln.LearnedNormalizer()]


def homogeneous(points, w):
    return torch.cat([points, torch.full_like(points[..., :1], w)], -1)


@pytest.mark.parametrize("distance", ["sampson", "symmetric"])
def test_residuals_and_derivatives(distance):
    """With third coordinates other than one, as in the optimiser, distances are those of the first two."""
    model, M = Homography(distance), torch.eye(3, dtype=torch.float64) + 0.2 * uniform(4, 3, 3, low=-1)
    p1, p2 = (uniform(4, 6, 2, low=-1, seed=k) for k in (1, 2))
    x1, x2 = homogeneous(p1, 1.3).mT, homogeneous(p2, 0.8).mT
    T1, T2 = (torch.diag(torch.tensor([1, 1, w], dtype=torch.float64)) for w in (1.3, 0.8))
    residual, J = model.linearise(M, x1, x2)
    assert residual.shape == (4, model.components * 6)
    kornias = by_kornia.sampson_homography_distance if distance == "sampson" else by_kornia.symmetric_transfer_error
    reference = kornias(p1, p2, model.carry(M, T1, T2))
    torch.testing.assert_close(model.squares(residual), reference, rtol=1e-9, atol=1e-12)
    check_gradients(lambda M: model.residual(M, x1[:1], x2[:1]), M)
    (G,) = torch.autograd.grad(model.residual(M.requires_grad_(), x1, x2)[:, 3].sum(), M)
    torch.testing.assert_close(J[..., 3], G.mT.flatten(1))
    terms = model.score_terms(x1[0], x2[0])
    scores = model.score_squares(M.detach(), terms, 2.0)
    torch.testing.assert_close(scores, model.squares(model.residual(M.detach(), x1[:1], x2[:1])) / 4)
    if distance == "sampson":
        torch.testing.assert_close(model.robust_distance(M, x1, x2, None)[0], reference, rtol=1e-5, atol=1e-6)


def test_minimal_samples():
    points1, points2, H = plane(3, 8)
    x1, x2 = (homogeneous(p, 1.0).unflatten(1, (2, 4)).flatten(0, 1) for p in (points1, points2))
    M, margin = solve_four_points(x1, x2)
    assert corner_error(M, H.repeat_interleave(2, 0)) < 1e-6
    assert (margin > 1).all()
    line, mirrored = x1.clone(), x2.clone()
    line[:, 2] = (line[:, 0] + line[:, 1]) / 2
    mirrored[::2, :2] = mirrored[::2, [1, 0]]  # two partners swapped: seen from no camera
    assert (solve_four_points(line, x2)[1] < 1e-9).all()
    twisted = solve_four_points(x1, mirrored)[1]
    assert torch.equal(twisted > 0, by_kornia.sample_is_valid_for_homography(x1[..., :2], mirrored[..., :2]))
    assert len(Homography().solve_samples(line, x2, 0.01)) == 0


@pairwise(normalizer=NORMALIZERS, number=[4, 12])
def test_any_normalizer_finds_the_truth(normalizer, number):
    points1, points2, H = plane(3, number)
    found = kln.find_homography(points1, points2, normalizer=normalizer)
    assert corner_error(found, H) < 1e-6
    torch.testing.assert_close(found.norm(dim=(1, 2)), torch.ones(3, dtype=torch.float64))
    assert by_kornia.oneway_transfer_error(points1, points2, found).max() < 1e-12


def test_agrees_with_kornia():
    points1, points2, _ = plane(noise=1.0)
    weights, normalizer = uniform(3, 40, low=0.1), kln.PerView(lambda points, weights: normalize_points(points))
    theirs = by_kornia.find_homography_dlt(points1, points2, weights, solver="svd")
    assert corner_error(kln.find_homography(points1, points2, weights, normalizer=normalizer), theirs) < 1e-3


def test_masked_rows_do_not_count():
    points1, points2, H = plane(3, 12)
    mask = (torch.arange(12) < 6).expand(3, 12)
    hidden = [torch.where(mask[..., None], p, torch.nan).requires_grad_() for p in (points1, points2)]
    found = kln.find_homography(*hidden, mask=mask)
    assert corner_error(found.detach(), H) < 1e-6
    signless(found).sum().backward()
    assert all(p.grad.isfinite().all() and p.grad[~mask].eq(0).all() for p in hidden)


@pairwise(views=[(0, 1), (0,), (1,)], number=[4, 5])
def test_three_on_a_line(number, views):
    """All but one point on a line: in both views H is not unique, in one alone it is singular."""
    points = [*plane(3, number)[:2]]
    for k in views:
        share = torch.linspace(0, 1, number - 1, dtype=torch.float64)[:, None]
        points[k][:, 1:] = points[k][:, 1:2] * share + points[k][:, 2:3] * (1 - share)
    points = [p.requires_grad_() for p in points]
    found = kln.find_homography(*points)
    assert found.isfinite().all()
    if number == 4 or len(views) == 2:
        torch.testing.assert_close(found, torch.eye(3, dtype=torch.float64).expand(3, 3, 3) / 3**0.5)
    for gradient in torch.autograd.grad(signless(found).sum(), points, allow_unused=True):
        assert gradient is None or gradient.isfinite().all()


@pytest.mark.parametrize("number", [4, 9])
def test_gradients(number):
    points1, points2, _ = plane(2, number, noise=0.3)
    check_gradients(lambda p, q: signless(kln.find_homography(p / 300, q / 300)), points1, points2, eps=1e-4, atol=1e-7)


def test_ransac():
    points1, points2, H = plane(1, 200, noise=0.3, outliers=0.6)
    points1, points2 = points1[0], points2[0]
    for options in ({}, {"distance": "symmetric", "inl_th": 2.0}):
        result = kln.RANSAC(model="homography", seed=0, **options).estimate(points1, points2, uniform(200, low=0.1))
        assert corner_error(result.F_mat[None], H) < 1
        assert result.E_mat is None
    four = kln.RANSAC(model="homography", seed=0).estimate(points1[80:84], points2[80:84])
    assert not four.inliers.any()  # as many inliers as a sample say nothing
    line = torch.linspace(0, 500, 30, dtype=torch.float64)[:, None].expand(30, 2)
    assert not kln.RANSAC(model="homography", seed=0)(line, line + 5)[1].any()


def test_wrong_options():
    points, eye = uniform(20, 2), torch.eye(3)
    with pytest.raises(ValueError, match=r"K1 and K2 .* got model homography"):
        kln.RANSAC(model="homography")(points, points, K1=eye, K2=eye)
    raises(ValueError, r"'fundamental' or 'homography', got 'affine'", kln.RANSAC, model="affine")
    raises(ValueError, r"'sampson' or 'symmetric', got 'one-way'", Homography, "one-way")
    raises(ValueError, r"at least 4 .* got 3", kln.RANSAC(model="homography"), points[:3], points[:3])


def states(kind: str, batch_size: int = 4):
    matrices = [uniform(batch_size, 3, 3, low=-1, seed=k) for k in range(3)]
    if kind == "calibrated":
        return Essential(*matrices[1:]).calibrated(matrices[0])
    return (Fundamental() if kind == "rank 2" else Homography()).state(matrices[0])


@pytest.mark.parametrize(("kind", "size"), [("rank 2", 7), ("calibrated", 5), ("any rank", 8)])
class TestManifold:
    def test_tangents(self, kind, size):
        state = states(kind)
        D = state.tangents()
        assert D.shape == (4, 9, size)
        for k in range(size):
            step = torch.zeros(4, size, dtype=torch.float64)
            step[:, k] = 1e-6
            slope = (state.retract(step).matrix() - state.retract(-step).matrix()) / 2e-6
            np.testing.assert_allclose(D[..., k], slope.mT.flatten(1), atol=1e-8)
        assert (torch.linalg.matrix_rank(D) == size).all()

    def test_steps_stay_on_the_manifold(self, kind, size):
        state = states(kind).retract(uniform(4, size, low=-1, seed=5))
        matrix = state.essential() if kind == "calibrated" else state.matrix()
        values = torch.linalg.svdvals(matrix)
        assert torch.allclose(values.norm(dim=-1), torch.ones(4, dtype=torch.float64))
        assert kind == "any rank" or (values[:, 2] < 1e-14).all()
        if kind == "calibrated":
            assert torch.allclose(values[:, 0], values[:, 1])


def test_calibrated():
    E, C1, C2 = (uniform(4, 3, 3, low=-1, seed=k) for k in range(3))
    state = Essential(C1, C2).calibrated(E)
    U, _, Vh = np.linalg.svd(E.numpy())
    nearest = U[..., :2] @ Vh[..., :2, :] / 2**0.5
    np.testing.assert_allclose(state.essential(), nearest, atol=1e-14)
    np.testing.assert_allclose(nearest_essential(E), nearest, atol=1e-14)
    F = C2.numpy().swapaxes(1, 2) @ nearest @ C1.numpy()
    scale = np.linalg.norm(C1, axis=(1, 2)) * np.linalg.norm(C2, axis=(1, 2))
    np.testing.assert_allclose(state.matrix(), F / scale[:, None, None], atol=1e-14)


def test_reweighted_fit_of_a_homography():
    """It ends where Levenberg and Marquardt's steps do, in coordinates as RANSAC's; a matrix that is none stays."""
    points1, points2, H = plane(noise=0.5, outliers=0.2)
    x1, x2 = homogeneous(points1[0] - 300, 250.0).mT, homogeneous(points2[0] - 300, 90.0).mT
    T1, T2 = (torch.tensor([[1, 0, -300], [0, 1, -300], [0, 0, w]]).double() for w in (250, 90))
    model, loss = Homography(), GemanMcClure(3.0)
    start = unit_matrix(model.carry(H[:1], T1.inverse(), T2.inverse()) + 0.001 * uniform(3, 3, 3, low=-1))
    fit = model.reweighted_fit(x1, x2, torch.cat([start, torch.full_like(start[:1], torch.nan)]), 12 * [loss])
    cost = RobustCost(model, x1[None], x2[None], torch.ones_like(x1[:1]), loss)
    before, best = minimize(cost, model.state(start), 100, 1e-7)
    assert best.converged.all()
    assert (best.cost < before).all()
    optimum, found = (model.carry(M, T1, T2) for M in (best.state.matrix(), fit.F_mat[:3]))
    assert corner_error(optimum, H[:1]) < 2
    assert corner_error(found, optimum) < 1e-6
    torch.testing.assert_close(fit.cost[:3], best.cost, rtol=1e-6, atol=0)
    assert (fit.gain[:3] < 1e-9).all()
    assert fit.cost[3].isinf()
    assert fit.F_mat[3].isnan().all()

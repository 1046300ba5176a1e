"""What every estimate of F promises: shapes, no dependence on order, scale or absent points, finite values, errors."""

from functools import partial
from itertools import product

import numpy as np
import pytest
import references as ref
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pairwise import pairwise
from scenes import DTYPES, SCENES, correspondences, paper, raises, refined, scenes, shaken, small, uniform

import kornia_learnnorm as kln
from kornia_learnnorm import Hartley, Whitening, find_fundamental, find_homography, optimal_rank2, refine_fundamental
from kornia_learnnorm.estimators.robust_losses import squared_loss

LOSSES = {"squared": squared_loss, "Huber": kln.Huber(0.5), "Cauchy": kln.Cauchy(0.5)}
LOSSES |= {"Geman-McClure": kln.GemanMcClure(2.0), "truncated": kln.Truncated(3.0)}
NORMALIZERS = {"identity": kln.Identity(), "whitening": Whitening(), "reweighted": kln.ReweightedWhitening()}
LINEAR = {name: partial(find_fundamental, normalizer=normalizer) for name, normalizer in NORMALIZERS.items()}
LINEAR |= {"projection": find_fundamental, "optimal": partial(find_fundamental, rank2="optimal")}
ALL = LINEAR | {"refined": refined, "refined, symmetric": partial(refined, distance="symmetric")}
ALL |= {f"refined, {name}": partial(refined, loss=loss) for name, loss in LOSSES.items()}
ALL |= {"homography": find_homography}
SEEDS = st.integers(0, 2**31)
CONTRACT = ["projection", "optimal", "refined", "refined, symmetric", "homography"]


@pairwise(name=CONTRACT, batch_size=[0, 1, 5], num_points=[8, 9, 50, 500], weighted=[False, True], dtype=DTYPES)
def test_smoke(name, batch_size, num_points, weighted, dtype, device):
    points = [uniform(batch_size, num_points, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
    weights = uniform(batch_size, num_points, seed=2).to(device, dtype) if weighted else None
    F_mat = ALL[name](*points, weights)
    assert (F_mat.shape, F_mat.dtype, F_mat.device.type) == ((batch_size, 3, 3), dtype, device.type)
    assert torch.isfinite(F_mat).all()


@pytest.mark.parametrize(
    ("name", "num_points", "kind"),
    [*product(LINEAR, [8, 20, 50], ["orbit"]), ("projection", 50, "driving"), ("projection", 50, "handheld")],
)
def test_finds_the_truth_without_noise(name, num_points, kind):
    scene = scenes(kind, 50, num_points, noise=0.0)
    F_mat = ALL[name](scene.points1, scene.points2)
    assert ref.up_to_sign(F_mat, scene.F_mat) < 1e-7
    assert ref.hartley_difference(F_mat, scene.F_mat, *scene[:2]) < 1e-7


@pairwise(name=LINEAR, scene=SCENES, num_points=[8, 20], dtype=DTYPES)
def test_rank_and_norm(name, scene, num_points, dtype):
    points, eps = [p.to(dtype) for p in correspondences(scene, 50, num_points)], torch.finfo(dtype).eps
    F_mat = ALL[name](*points)
    assert np.linalg.norm(F_mat.double().numpy(), axis=(1, 2)) == pytest.approx(1, abs=4 * eps)
    assert (np.linalg.svd(F_mat.double().numpy())[1][:, 2] < 10 * eps).all()
    if dtype == torch.float64:  # two values apart from zero where all entries count
        values = np.linalg.svd(ref.in_hartley(F_mat, *points))[1]
        assert (values[:, 1] > 1e-4).all()
        assert (values[:, 2] < 1e-12).all()


@pytest.mark.parametrize("name", ["projection", "optimal", "refined", "refined, symmetric"])
def test_swapped_views_give_the_transpose(name):
    scene, bound = ("orbit", 1e-7) if name.startswith("refined") else ("driving", 1e-10)
    points, weights = correspondences(scene, 20, 12), uniform(20, 12)
    F_mat, mirrored = ALL[name](*points, weights), ALL[name](*points[::-1], weights)
    assert ref.hartley_difference(mirrored.mT, F_mat, *points) < bound


@pytest.mark.parametrize("name", ["projection", "optimal", "refined", "homography"])
def test_batch_is_many_single_calls(name):
    points = correspondences("random", 6, 12)
    alone = [ALL[name](*(p[k : k + 1] for p in points)) for k in range(6)]
    assert ref.up_to_sign(ALL[name](*points), torch.cat(alone)) < {"optimal": 1e-10, "refined": 1e-7}.get(name, 1e-12)


ORDERED = [("projection", [*SCENES], 1e-7), ("optimal", [*SCENES], 1e-6)]
ORDERED += [("refined", ["handheld", "orbit"], 1e-6), ("homography", ["handheld", "orbit"], 1e-7)]


@pytest.mark.parametrize(("name", "scenes", "bound"), ORDERED)
@given(seed=SEEDS, num_points=st.sampled_from([8, 9, 17]), random=st.randoms(), data=st.data())
def test_order_does_not_matter(name, scenes, bound, seed, num_points, random, data):
    points = correspondences(data.draw(st.sampled_from(scenes)), 4, num_points, seed)
    order = random.sample(range(num_points), num_points)
    shuffled, expected = ALL[name](*(p[:, order] for p in points)), ALL[name](*points)
    assert ref.hartley_difference(shuffled, expected, *points, name == "homography") < bound


@pytest.mark.parametrize("name", [name for name in CONTRACT if name != "projection"])
@settings(max_examples=10)
@given(log_scale=st.floats(-3, 3), num_points=st.sampled_from([8, 15]))
def test_moves_with_the_scale_of_the_pixels(name, log_scale, num_points):
    points, scale = correspondences("orbit", 4, num_points), 10**log_scale
    S, homography = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64)), name == "homography"
    back = (S.inverse() if homography else S) @ ALL[name](*(scale * p for p in points)) @ S
    assert ref.hartley_difference(back, ALL[name](*points), *points, homography) < 1e-7


@pytest.mark.parametrize("factor", [-7.0, 1e-3, 1e6])
def test_scale_of_the_start_does_not_matter(factor):
    points = correspondences("orbit", 4, 15)
    start = ref.rank_three(*points)
    assert ref.hartley_difference(*(optimal_rank2(F, *points) for F in (factor * start, start)), *points) < 1e-7
    found, expected = (refine_fundamental(*points, F, max_iterations=5).F_mat for F in (factor * start, start))
    assert ref.hartley_difference(found, expected, *points) < 1e-7


@pairwise(name=[*LINEAR, *(f"refined, {loss}" for loss in LOSSES), "homography"], num_points=[8, 20])
def test_zero_weight_means_absent(name, num_points):
    points, weights = correspondences("orbit", 5, num_points), uniform(5, num_points, low=0.5)
    junk = [uniform(5, 4, 2, low=-5000, high=5000, seed=seed) for seed in (3, 4)]
    every = [torch.cat(pair, 1) for pair in zip((*points, weights), (*junk, torch.zeros(5, 4)), strict=True)]
    assert ref.hartley_difference(ALL[name](*every), ALL[name](*points, weights), *points, name == "homography") < 1e-7


@pytest.mark.parametrize(("name", "bound"), [("projection", 1e-8), ("optimal", 1e-9), ("homography", 1e-9)])
@given(seed=SEEDS, counts=st.lists(st.integers(0, 3), min_size=12, max_size=12))
def test_whole_weights_are_repetitions(name, bound, seed, counts):
    counts = torch.tensor([2, 1, 3, 1, 1, 1, 1, 1, 1, *counts])  # at least nine are present
    points = correspondences("handheld", 3, 21, seed)
    repeated = [p.repeat_interleave(counts, 1) for p in points]
    found, expected = ALL[name](*points, counts.double().expand(3, -1)), ALL[name](*repeated)
    assert ref.hartley_difference(found, expected, *repeated, name == "homography") < bound


@pairwise(kind=["on the epipoles", "all zero"], correction=["optimal", *LOSSES], distance=["sampson", "symmetric"])
def test_points_on_the_epipoles_are_finite_in_value_and_gradient(kind, correction, distance):
    """Of given matrices; other degenerate points are in test_finite.py."""
    points1, points2 = correspondences("handheld", 5, 12)
    F_mat = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]], dtype=torch.float64).repeat(5, 1, 1)
    points1[:, 0] = points2[:, 1] = points1[:, 2] = points2[:, 2] = 0.0
    if kind == "all zero":
        F_mat = torch.tensor([[1e-3, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64).repeat(5, 1, 1)
        points1, points2 = torch.zeros_like(points1), torch.zeros_like(points2)
    start, *values = (v.requires_grad_() for v in (F_mat, points1, points2, torch.ones(5, 12, dtype=torch.float64)))
    if correction == "optimal":
        found = optimal_rank2(start, *values)
    else:
        refinement = refine_fundamental(*values[:2], start.detach(), values[2], distance, LOSSES[correction])
        assert (refinement.cost <= refinement.cost_before).all()
        found = refinement.F_mat
    assert torch.isfinite(found).all()
    assert (torch.linalg.svdvals(found)[:, 2] < 1e-10).all()
    for gradient in torch.autograd.grad(ref.signless(found).sum(), [start, *values], allow_unused=True):
        assert gradient is None or torch.isfinite(gradient).all()


EYE = torch.eye(3).expand(2, 3, 3)
REFUSING = [(find_fundamental, 8), (kln.EightPoint(), 8), (find_homography, 4)]
REFUSING += [(lambda *points: optimal_rank2(EYE, *points), 8)]
REFUSING += [(lambda points1, points2, weights: refine_fundamental(points1, points2, EYE, weights), 8)]


@pytest.mark.parametrize(("estimate", "least"), REFUSING)
def test_wrong_correspondences(estimate, least):
    ref.check_refuses(estimate, least)


@pytest.mark.parametrize(("F_mat", "error", "message"), ref.WRONG_MATRICES)
def test_wrong_matrices(F_mat, error, message):
    points = torch.rand(2, 8, 2)
    raises(error, message, optimal_rank2, F_mat, points, points)
    raises(error, message, refine_fundamental, points, points, F_mat)


# Each normaliser with its independent computation.
REFERENCES = {
    "identity": (kln.Identity(), lambda points, weights=None: np.broadcast_to(np.eye(3), (len(points), 3, 3))),
    "hartley": (Hartley(), ref.numpy_hartley),
    "whitening": (Whitening(), ref.numpy_whitening),
}


def scaling(a, *_):  # from a thousandth to a thousand times the size
    return [[10 ** (6 * a), 0], [0, 10 ** (6 * a)]]


class TestFindFundamental:
    @pairwise(name=SCENES, num_points=[8, 9, 50], reference=REFERENCES, weighted=[False, True])
    def test_agrees_with_numpy(self, name, num_points, reference, weighted, device):
        points1, points2 = correspondences(name, 20, num_points)
        weights = uniform(20, num_points, low=0.01, seed=5) if weighted else None
        normalizer, transform = REFERENCES[reference]
        on_device = [None if v is None else v.to(device) for v in (points1, points2, weights)]
        F_mat = find_fundamental(*on_device, normalizer).cpu()
        expected = ref.eight_point(points1, points2, transform(points1, weights), transform(points2, weights), weights)
        # In pixels the design matrix has a condition number of 1e10, and either computation loses as many digits.
        pixels, hartley = (1e-7, 1e-7) if reference == "identity" else (1e-9, 1e-9)
        assert ref.up_to_sign(F_mat, expected) < pixels
        assert ref.hartley_difference(F_mat, expected, points1, points2) < hartley

    @pairwise(name=["driving", "handheld", "orbit"], num_points=[8, 50])
    def test_agrees_with_opencv(self, name, num_points):
        cv2 = pytest.importorskip("cv2")
        points1, points2 = correspondences(name, 20, num_points)
        pairs = zip(points1.numpy(), points2.numpy(), strict=True)
        expected = np.stack([cv2.findFundamentalMat(a, b, cv2.FM_8POINT)[0] for a, b in pairs])
        # OpenCV's eigenvectors of A^T A have half of the digits.
        assert ref.hartley_difference(find_fundamental(points1, points2), expected, points1, points2) < 2e-4

    @pytest.mark.parametrize(
        ("make", "linear", "bound"),
        [
            (Hartley, lambda a, b, c, d: [[1 + a, -b], [b, 1 + a]], 1e-6),
            (Whitening, lambda a, b, c, d: [[1 + a, b], [c, 1 + d]], 1e-6),
            (lambda: kln.ReweightedWhitening(2), scaling, 1e-6),
            (lambda: shaken(small()), scaling, 1e-4),
            (lambda: shaken(paper().double()), scaling, 1e-6),
        ],
    )
    @given(SEEDS, st.sampled_from([8, 9, 20]), st.tuples(*2 * [st.tuples(*6 * [st.floats(-0.45, 0.45)])]))
    @torch.no_grad()
    def test_moves_with_the_pixels(self, make, linear, bound, seed, num_points, entries):
        """By a similarity of either view, an affinity, or a scale and a shift, as far as the normaliser follows."""
        normalizer, points = make(), correspondences("handheld", 4, num_points, seed)
        S = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
        for k, (a, b, c, d, x, y) in enumerate(entries):
            S[k, :2, :2], S[k, :2, 2] = torch.tensor(linear(a, b, c, d)), 1000 * torch.tensor([x, y])
        moved = [p @ s[:2, :2].mT + s[:2, 2] for p, s in zip(points, S, strict=True)]
        pulled_back = S[1].mT @ find_fundamental(*moved, normalizer=normalizer) @ S[0]
        assert ref.hartley_difference(pulled_back, find_fundamental(*points, normalizer=normalizer), *points) < bound


@pytest.mark.parametrize("rank2", [None, True])
def test_wrong_rank2(rank2):
    with pytest.raises(ValueError, match=f"rank2 must be 'projection' or 'optimal', got {rank2}"):
        find_fundamental(torch.rand(2, 8, 2), torch.rand(2, 8, 2), rank2=rank2)

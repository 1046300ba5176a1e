"""RANSAC against ground truth and Kornia's, and on the input that makes robust estimators hang."""

import time
from itertools import count

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.geometry import ransac as kornia_ransac
from kornia.geometry.linalg import transform_points
from pairwise import pairwise
from references import epipolar_distances, up_to_sign
from scenes import one_scene, raises, shaken, uniform

import kornia_learnnorm as kln
from kornia_learnnorm import RANSAC
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.geometry.distinct_points import distinct_points
from kornia_learnnorm.metrics.inliers import f1_score


def pair(name: str = "handheld", num_points: int = 400, noise: float = 0.3, outliers: float = 0.4, seed: int = 0):
    """Correspondences (N, 2) of one pair, its matrix, and which are no outliers."""
    scene = one_scene(name, num_points, seed, noise=noise, outliers=outliers)
    return scene.points1, scene.points2, scene.F_mat, scene.inliers


def cameras_of(scene, calibrated: bool) -> dict[str, torch.Tensor]:
    return {"K1": scene.K1, "K2": scene.K2} if calibrated else {}


def failed(result) -> bool:
    F_mat, inliers = result
    return not bool(F_mat.any()) and not bool(inliers.any())


both = pytest.mark.parametrize("calibrated", [False, True])


class TestResult:
    @both
    @pytest.mark.parametrize("refine", [True, False])
    def test_shapes(self, calibrated, refine, device, dtype):
        scene = one_scene("handheld", 100, noise=0.3, outliers=0.4)
        cameras = {name: K.to(device) for name, K in cameras_of(scene, calibrated).items()}
        ransac, points = RANSAC(seed=0, refine=refine), [p.to(device, dtype) for p in (scene.points1, scene.points2)]
        F_mat, inliers = ransac(*points, **cameras)
        assert (F_mat.shape, F_mat.dtype, F_mat.device.type) == ((3, 3), dtype, device.type)
        assert (inliers.shape, inliers.dtype, inliers.device.type) == ((100,), torch.bool, device.type)
        assert F_mat.norm().item() == pytest.approx(1)
        assert torch.linalg.svdvals(F_mat.double())[2] < 1e-7
        found = ransac.estimate(*points, **cameras)
        assert torch.equal(found.F_mat, F_mat)
        assert torch.equal(found.inliers, inliers)
        if calibrated:
            assert found.E_mat.dtype == dtype
            values = torch.linalg.svdvals(found.E_mat.double()).tolist()
            assert values == pytest.approx([0.5**0.5, 0.5**0.5, 0.0], abs=1e-6)
            assert torch.equal(inliers, kln.sampson_distance(*points, F_mat) <= 1)

    @pairwise(normalizer=[None, kln.Whitening(), shaken()], rank2=[None, "projection", "optimal"])
    def test_any_normalizer(self, normalizer, rank2):
        points1, points2, F_true, _ = pair(num_points=200)
        F_mat, _ = RANSAC(normalizer, rank2=rank2, seed=0)(points1, points2)
        inlying = epipolar_distances(points1, points2, F_true.numpy()) < 1
        assert np.median(epipolar_distances(points1, points2, F_mat.numpy())[inlying]) < 1

    @pytest.mark.parametrize(
        ("distance", "reference"), [("sampson", kln.sampson_distance), ("symmetric", kln.symmetric_epipolar_distance)]
    )
    def test_estimate(self, distance, reference):
        points1, points2 = pair()[:2]
        result = RANSAC(seed=0, distance=distance, inl_th=1.5).estimate(points1, points2)
        distances = reference(points1, points2, result.F_mat)
        assert ((distances <= 1.5) != result.inliers).sum() <= 1  # a distance next to the threshold
        expected = (1 - (distances / 1.5).square()).clamp(min=0).sum()
        assert result.score == pytest.approx(expected.item(), rel=1e-6)
        assert result.num_samples >= 64
        assert result.E_mat is None  # without cameras

    def test_rank2_means_what_it_says(self):
        """The default depends on whether there is a normaliser; what is given never changes."""
        assert [RANSAC().rank2, RANSAC(kln.Whitening()).rank2] == ["optimal", "projection"]
        assert isinstance(RANSAC(rank2="projection").normalizer, kln.Hartley)
        points, options = pair()[:2], {"seed": 0, "refine": False}
        given, default = (RANSAC(n, rank2="projection", **options)(*points)[0] for n in (kln.Hartley(), None))
        assert torch.equal(given, default)
        assert not torch.equal(given, RANSAC(**options)(*points)[0])


NAMED = ["driving", "handheld", "orbit"]
POINTS, NAN = uniform(20, 2), float("nan")
LINE = torch.linspace(0, 300, 60, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0])


class TestExceptions:
    def test_options(self):
        for wrong, error, message in [
            *(({"inl_th": n}, ValueError, f"inl_th .* to 1e12, got {n!s:.2}") for n in (0, NAN, 1e30)),
            *(({"max_samples": n}, ValueError, f"max_samples must be .* at least 1, got {n}") for n in (0, 1.5)),
            ({"rank2": "foo"}, ValueError, "'projection' or 'optimal', got 'foo'"),
            ({"rank2": "optimal", "model": "homography"}, ValueError, "rank2 .* 'optimal' for a homography"),
            *(({"distance": d}, ValueError, f"'sampson' or 'symmetric', got {d!r:.7}") for d in ("foo", len)),
            ({"max_seconds": 0.0}, ValueError, "max_seconds"),
            *(({"confidence": n}, ValueError, rf"confidence .* \(0, 1\], got {n}") for n in (1.5, 0.0)),
            ({"seed": 2**64}, ValueError, r"seed .* \[0, 2\^63\), got 18446744073709551616"),
            *(({"seed": seed}, TypeError, f"seed must be .* got {seed!r}") for seed in ("a", True)),
            *(({"normalizer": n}, TypeError, end) for n, end in (("a", "got 'a'$"), ("homography", "model="))),
            ({"inl_th": "1"}, TypeError, "inl_th must be a number, got '1'"),
            ({"model": kln.Hartley()}, TypeError, r"model must be a name or a TwoViewModel, got Hartley"),
        ]:
            raises(error, message, RANSAC, **wrong)

    @both
    def test_correspondences(self, calibrated):
        cameras, least = ({"K1": torch.eye(3), "K2": torch.eye(3)}, 5) if calibrated else ({}, 8)
        for points1, points2, change, error, message in [
            (POINTS.long(), POINTS, {}, TypeError, "points1 must be .* got torch.int64"),
            (POINTS[None], POINTS[None], {}, ShapeError, r"\[1, 20, 2\]"),
            (POINTS, POINTS[1:], {}, ValueError, r"\[20, 2\] and \[19, 2\]"),
            (POINTS[: least - 1], POINTS[: least - 1], {}, ValueError, f"at least {least} .* got {least - 1}"),
            (POINTS, POINTS, {"weights": torch.ones(19)}, ValueError, r"weights .* \[20\], got \[19\]"),
            (POINTS, POINTS, {"weights": torch.full((20,), NAN)}, ValueError, "finite and not negative"),
            (POINTS, POINTS, {"K1": torch.eye(3)[None]}, ValueError, r"K1 .* got (only K1|\[1, 3, 3\])"),
        ]:
            raises(error, message, RANSAC(), points1, points2, **cameras | change)


class TestAccuracy:
    @pytest.mark.parametrize(
        ("name", "num_points", "calibrated"),
        [("handheld", 400, False), *((name, number, True) for name in NAMED for number in (7, 60))],
    )
    def test_exact_points(self, name, num_points, calibrated):
        scene = one_scene(name, num_points, noise=0.0, outliers=0.0)
        found = RANSAC(seed=0).estimate(scene.points1, scene.points2, **cameras_of(scene, calibrated))
        assert found.inliers.all()
        if num_points > 7:  # of fewer, others fit within the threshold
            assert up_to_sign(found.F_mat[None], scene.F_mat[None]) < (1e-6 if calibrated else 1e-8)

    @pairwise(name=NAMED, options=[{}, {"distance": "symmetric", "inl_th": 2.0}])
    def test_finds_the_inliers(self, name, options):
        points1, points2, _, true = pair(name)
        _, inliers = RANSAC(seed=0, **options)(points1, points2)
        assert inliers[true].float().mean() > 0.9
        assert inliers[~true].float().mean() < 0.15  # outliers can lie on their lines

    @pytest.mark.long
    @pytest.mark.parametrize("name", ["kitti_06", "tum_fr3_office"])
    def test_level_with_kornia(self, real_data, name):
        store = read_store(real_data / "correspondences" / f"{name}.h5")
        estimators, scores = (RANSAC(seed=0), kornia_ransac.RANSAC("fundamental", 1.0, seed=0)), []
        for i in range(2, 17, 2):
            points = [torch.from_numpy(p) for p in store.matches(i, 0.8)[:2]]
            F_mats = [ransac(*points)[0].double() for ransac in estimators]
            truth, points = torch.from_numpy(store.F[i]), [x.double() for x in points]
            scores.append([f1_score(*points, F_mat, truth, 1.0).item() for F_mat in F_mats])
        ours, theirs = np.nanmean(scores, 0)
        assert ours > theirs - 0.01


def test_seeded_calls_repeat_exactly_and_leave_the_global_generator():
    points, ransac, state = [p.float() for p in pair()[:2]], RANSAC(seed=3), torch.get_rng_state()
    first = ransac(*points)
    torch.testing.assert_close(ransac(*points), first, rtol=0, atol=0)
    torch.set_default_dtype(torch.float64)
    try:
        torch.testing.assert_close(RANSAC(seed=np.int64(3))(*points), first, rtol=0, atol=0)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize("normalizer", [None, kln.Whitening()])
def test_autocast_changes_nothing_and_the_result_serves_in_training(normalizer, dtype):
    points = [p.to(dtype) for p in pair(num_points=100)[:2]]
    plain = RANSAC(normalizer, seed=0)(*points)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(RANSAC(normalizer, seed=0)(*points), plain, rtol=0, atol=0)
    F_mat, inliers = RANSAC(normalizer, seed=0)(points[0].requires_grad_(), points[1])
    kln.symmetric_epipolar_distance(*points, F_mat)[inliers].sum().backward()
    assert points[0].grad.isfinite().all()


class TestBudget:
    def count(self, points, weights=None, **options) -> int:
        return RANSAC(seed=0, **options).estimate(*points, weights).num_samples

    def test_confidence(self):
        points = pair(outliers=0.05)[:2]
        assert self.count(points) <= 128 < self.count(points, confidence=1.0, max_samples=3000) == 3000

    def test_time(self, monkeypatch):
        """By a clock that is a second later whenever it is read."""
        points, drawn = pair(num_points=1000, outliers=0.95)[:2], []
        for seconds in (0.5, 2.5):
            monkeypatch.setattr(time, "perf_counter", count().__next__)
            drawn.append(self.count(points, max_samples=10**9, confidence=1.0, max_seconds=seconds))
        assert 0 < drawn[0] < drawn[1] < 10_000

    def test_few_inliers(self, monkeypatch):
        """Of as many samples, those that are drawn near the best matrix find more of the correct matches."""
        scenes, recall = [pair(num_points=300, noise=0.5, outliers=0.8, seed=seed) for seed in range(4)], []
        for near in (20.0, 1e6):
            monkeypatch.setattr("kornia_learnnorm.ransac.ransac.NEAR", near)
            ransac = RANSAC(seed=0, max_samples=5000, confidence=1.0)
            recall.append(np.mean([ransac(*points)[1][true].float().mean() for *points, _, true in scenes]))
        assert recall[0] > recall[1] + 0.1


class TestHardInput:
    @pytest.mark.parametrize("normalizer", [None, kln.Whitening()])
    def test_what_determines_no_matrix(self, normalizer):
        for arguments in [
            pair(num_points=8, outliers=0.0)[:2],
            (LINE, LINE + 3),
            (torch.cat([POINTS[:7], POINTS[7:] * NAN]), uniform(20, 2, seed=1)),
            (POINTS, uniform(20, 2, seed=1), (torch.arange(20) < 7).float()),
        ]:
            assert failed(RANSAC(seed=0, normalizer=normalizer, max_samples=2000)(*arguments))

    @pytest.mark.parametrize("value", [None, 0.0, 5.0, 1e6])
    def test_all_outliers_or_all_identical(self, value):
        points = [uniform(50, 2, high=500, seed=k) if value is None else torch.full((50, 2), value) for k in (0, 1)]
        F_mat, inliers = RANSAC(seed=0, max_samples=2000)(*points)
        assert F_mat.isfinite().all()
        assert failed((F_mat, inliers)) or (inliers.all() if value is not None else inliers.float().mean() < 0.5)

    @pairwise(normalizer=[None, kln.ReweightedWhitening()], value=[1e10, -1e150, 1e300])
    def test_points_that_are_far_away(self, normalizer, value):
        points1, points2, _, true = pair(num_points=200)
        points1[:3], points2[2:4] = value, -value
        true[:4] = False
        F_mat, inliers = RANSAC(normalizer, seed=0)(points1, points2)
        assert F_mat.isfinite().all()
        assert inliers[true].float().mean() > 0.85
        assert not inliers[:4].any()

    @pytest.mark.parametrize("jitter", [0.0, 1e-6, 1e-4])
    def test_many_points_that_nearly_agree(self, jitter):
        points1, points2, _, _ = pair(num_points=1000, outliers=0.0)
        for k, points in enumerate((points1, points2)):
            points[:550] = points[0] + jitter * uniform(550, 2, low=-1, seed=k)
        F_mat, inliers = RANSAC(seed=0)(points1, points2)
        assert inliers[550:].float().mean() > 0.9
        assert (kln.sampson_distance(points1, points2, F_mat)[inliers] < 1.001).all()

    def test_outliers_that_come_first(self):
        points1, points2, _, true = pair(num_points=1200, outliers=0.7)
        order = true.long().argsort()
        assert RANSAC(seed=0)(points1[order], points2[order])[1][true[order]].float().mean() > 0.95

    @pytest.mark.long
    def test_dense_matches_in_the_order_of_the_rows(self):
        rows, columns = torch.meshgrid(torch.arange(256), torch.arange(256), indexing="ij")
        points1 = torch.stack([columns, rows], -1).flatten(0, 1) + 1e-6 * uniform(2**16, 2)
        points2 = points1 + 150 / uniform(2**16, 1, low=4, high=8) + 0.1 * uniform(2**16, 2, low=-1, seed=1)
        assert RANSAC(seed=0)(points1.float(), points2.float())[1].float().mean() > 0.99

    @pairwise(distance=["sampson", "symmetric"], number=[100, 1000])
    def test_match_on_the_epipole(self, number, distance):
        epipole = torch.full((2,), 300.0, dtype=torch.float64)
        points1 = uniform(number, 2, high=600)
        points2 = epipole + (points1 - epipole) * uniform(number, 1, low=1.1, high=1.4, seed=1)
        points1[0] = points2[0] = epipole
        assert RANSAC(distance=distance, seed=0)(points1, points2)[1][1:].all()

    def test_float32_far_from_the_origin(self):
        """Their matrix means nothing any more, but which are inliers is known."""
        points1, points2, _, true = pair(outliers=0.2)
        assert RANSAC(seed=0)(points1.float() + 3e5, points2.float() + 3e5)[1][true].float().mean() > 0.9

    @pytest.mark.parametrize("number", [9, 200])
    def test_nothing_moves(self, number, dtype):
        """One of the matrices that fit, as a camera that stands still must not look like lost tracking."""
        points = uniform(number, 2, high=500).to(dtype)
        for moved in (points, 0.9 * points + 20):
            F_mat, inliers = RANSAC(seed=0, max_samples=2000)(points, moved)
            assert F_mat.isfinite().all()
            assert inliers.all()

    @pytest.mark.parametrize("planes", [1, 2])
    def test_planes(self, planes):
        scene = one_scene("handheld", 400, noise=0.0, outliers=0.0)
        normals = torch.tensor([[0.02, 0.18, 0.06], [0.01, -0.01, 0.07]], dtype=torch.float64)[:planes]
        H = scene.K2 @ (scene.R + scene.t[:, None] * normals[:, None]) @ torch.linalg.inv(scene.K1)
        points2 = transform_points(H, torch.stack(scene.points1.chunk(planes))).flatten(0, 1)
        F_mat, inliers = RANSAC(seed=0)(scene.points1, points2)
        assert F_mat.isfinite().all()
        assert inliers.all()


@pytest.mark.long
@both
@settings(max_examples=6)
@given(scale=st.floats(0.1, 10), x=st.floats(-1e4, 1e4), y=st.floats(-1e4, 1e4), order=st.permutations(range(100)))
def test_invariances(calibrated, scale, x, y, order):
    """To similarities of the pixels, to the order of the rows and to a swap of the views."""
    scene = one_scene("handheld", 100, noise=0.1, outliers=0.4)
    points, cameras = (scene.points1, scene.points2), cameras_of(scene, calibrated)
    F_mat, inliers = RANSAC(seed=0)(*points, **cameras)
    T = torch.tensor([[scale, 0, x], [0, scale, y], [0, 0, 1]], dtype=torch.float64)
    moved_cameras = {name: T @ K for name, K in cameras.items()}
    moved = RANSAC(inl_th=scale, seed=0)(*(scale * p + T[:2, 2] for p in points), **moved_cameras)[1]
    shuffled = RANSAC(seed=0)(*(p[order] for p in points), **cameras)[1]
    swapped, same = RANSAC(seed=0)(*points[::-1], **dict(zip(cameras, [*cameras.values()][::-1], strict=True)))
    for found, expected in ((moved, inliers), (shuffled, inliers[order]), (same, inliers)):
        assert (found == expected).float().mean() > 0.95
    errors = [epipolar_distances(*(p[inliers] for p in points), F).mean() for F in (F_mat, swapped.mT)]
    assert errors[0] == pytest.approx(errors[1], rel=0.05, abs=1e-3)


def test_mask_by_hand():
    """Zeros of both signs are equal; equal coordinates in another order are not."""
    points1 = torch.tensor([[0.0, 1], [-0.0, 1], [1, 0], [7, 7], [8, 8]])
    points2 = torch.tensor([[2.0, 3], [4, 5], [5, 4], [5, 4], [7, 7]])
    assert distinct_points(points1, points2).tolist() == [True, False, True, False, True]
    assert distinct_points(points1, points2, torch.arange(5)).tolist() == [False, True, False, True, True]


class TestSharedPoints:
    @pytest.mark.parametrize("cameras", [False, True])
    def test_copies_are_absent(self, cameras):
        scene = one_scene("handheld", 200, noise=0.3, outliers=0.3)
        points, known = scene[:2], (scene.K1, scene.K2) if cameras else ()
        found = RANSAC(seed=0).estimate(*points, None, *known)
        again = RANSAC(seed=0).estimate(*(torch.cat([x, x[:50]]) for x in points), None, *known)
        assert torch.equal(found.F_mat, again.F_mat)
        assert torch.equal(torch.cat([found.inliers, torch.zeros(50, dtype=torch.bool)]), again.inliers)

    def test_the_weights_decide_which_counts(self):
        scene = one_scene("handheld", 200, noise=0.3, outliers=0.0)
        points2 = torch.cat([uniform(200, 2, high=600), scene.points2])
        weights = torch.tensor([0.1, 0.2]).repeat_interleave(200)
        _, inliers = RANSAC(seed=0)(scene.points1.repeat(2, 1), points2, weights)
        assert inliers[200:].float().mean() > 0.9
        assert not inliers[:200].any()

    def test_rows_that_are_not_finite_hide_no_match(self):
        points1, points2, *_ = one_scene("handheld", 100, noise=0.3, outliers=0.0)
        more = RANSAC(seed=0)(points1.repeat(2, 1), torch.cat([points2 * torch.nan, points2]))[1]
        assert torch.equal(more, torch.cat([torch.zeros_like(more[:100]), RANSAC(seed=0)(points1, points2)[1]]))

"""The learned eight-point algorithm: invariances, small sets, scores, stages, files, errors."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import (
    check_gradients,
    correspondences,
    rewrite_weights,
    scenes,
    seeded,
    shaken_estimator,
    signless,
    uniform,
    up_to_sign,
)

import kornia_learnnorm as kln
from kornia_learnnorm.estimators.match_features import masked_median


def shaken_double(**options) -> kln.LearnedEightPoint:
    return shaken_estimator(**options).double()


@settings(max_examples=5)
@given(
    num_points=st.sampled_from([8, 9, 40]),
    seed=st.integers(0, 2**20),
    factor=st.floats(1e-3, 1e3),
    shift=st.floats(-1e3, 1e3),
)
@torch.no_grad()
def test_invariances(num_points, seed, factor, shift):
    """To the order of the correspondences, a swap of the views, and one scale and translation of both images."""
    layer, points = shaken_double(), correspondences("handheld", 4, num_points, seed=seed)
    order = torch.randperm(num_points, generator=seeded(seed))
    estimate, shuffled = layer.estimate(*points), layer.estimate(*(p[:, order] for p in points))
    assert up_to_sign(shuffled.F_mat, estimate.F_mat) < 1e-6
    assert torch.allclose(shuffled.weights, estimate.weights[:, order], atol=1e-8)
    assert up_to_sign(layer(*points[::-1]).mT, estimate.F_mat) < 1e-6
    moved = layer(*(factor * (p + shift) for p in points))
    T = torch.tensor([[factor, 0, factor * shift], [0, factor, factor * shift], [0, 0, 1]], dtype=torch.float64)
    assert up_to_sign(T.mT @ moved @ T, estimate.F_mat) < 1e-5


class TestSmallSets:
    def test_eight_are_the_optimal_correction(self):
        points, layer = correspondences("handheld", 5), shaken_double()
        expected = kln.find_fundamental(*points, rank2="optimal")
        assert up_to_sign(layer(*points).detach(), expected) < 1e-9
        padded = [torch.cat([p, p[:, :3]], 1) for p in points]
        mask = torch.arange(11).expand(5, 11) < 8
        assert up_to_sign(layer(*padded, mask=mask).detach(), expected) < 1e-9

    def test_eight_with_outliers_are_hartleys_projection(self):
        points1, points2 = correspondences("handheld", 40)
        points2 = points2 + 30 * torch.randn(points2.shape, generator=seeded(), dtype=points2.dtype)
        optimal, hartley = (kln.find_fundamental(points1, points2, rank2=kind) for kind in ("optimal", "projection"))
        residual = kln.sampson_distance(points1, points2, optimal).square().mean(1).sqrt()
        both = torch.cat([points1, points2], 1)
        fits = residual < 0.01 * (both - both.mean(1, keepdim=True)).norm(dim=-1).mean(1)
        assert 0 < fits.sum() < 40
        found = shaken_double()(points1, points2).detach()
        assert up_to_sign(found[fits], optimal[fits]) < 1e-9
        assert up_to_sign(found[~fits], hartley[~fits]) < 1e-9

    @pytest.mark.parametrize("options", [{}, {"rank2": "optimal"}, {"refine_steps": 0}])
    @pytest.mark.parametrize("number", [8, 9])
    def test_every_parameter_gets_a_gradient(self, number, options):
        """Otherwise DistributedDataParallel waits for the gradients that are missing."""
        layer = shaken_double(**options)
        signless(layer(*correspondences("handheld", 3, number))).sum().backward()
        gradients = torch.cat([parameter.grad.flatten() for parameter in layer.parameters()])
        assert gradients.isfinite().all()
        assert bool(gradients.any()) == (number > 8)

    def test_an_untrained_layer_is_hartleys(self):
        points = correspondences("handheld", 5, 20)
        layer = kln.LearnedEightPoint(width=16, depth=1, stages=1, refine_steps=0)
        assert up_to_sign(layer(*points).detach(), kln.find_fundamental(*points)) < 1e-6


class TestSamples:
    def test_find_the_matrix_where_the_weights_do_not(self):
        """An untrained network gives all matches the same weight."""
        scene = scenes("handheld", 10, 200, noise=0.1)
        points2 = scene.points2.clone()
        points2[:, :60] = 600 * uniform(10, 60, 2, seed=3)
        errors = []
        for samples in (0, 256):
            torch.manual_seed(0)
            layer = kln.LearnedEightPoint(width=16, depth=1, stages=1, samples=samples).double()
            with torch.no_grad():
                F_mat = layer(scene.points1, points2)
            errors.append(kln.symmetric_epipolar_distance(scene.points1[:, 60:], scene.points2[:, 60:], F_mat))
        without, found = (error.median(1).values for error in errors)
        assert (found < without / 4).double().mean() >= 0.8

    @pytest.mark.parametrize("number", [9, 15, 16, 40])
    def test_padding_has_no_effect(self, number):
        """Few present matches are not searched, however many rows there are."""
        points, layer = correspondences("handheld", 3, number), shaken_double()
        padded = [torch.cat([p, p[:, :1].expand(-1, 20, -1)], 1) for p in points]
        mask = torch.arange(number + 20).expand(3, -1) < number
        assert up_to_sign(layer(*padded, mask=mask).detach(), layer(*points).detach()) < 1e-6

    def test_gradcheck(self):
        """With many steps derivatives are those of the optimum, wherever the fit began."""
        points, layer = correspondences("handheld", 1, 20), shaken_double(refine_steps=60)

        def numbers(points1, points2, scores):
            return signless(layer(points1, points2, scores=scores))

        check_gradients(numbers, *points, uniform(1, 20), atol=1e-4, rtol=1e-2)


class TestEstimate:
    def test_smoke(self, device, dtype):
        layer = shaken_estimator(stages=3).to(device)
        points = [p.to(device, dtype) for p in correspondences("driving", 3, 30)]
        scores = torch.rand(3, 30)
        estimate = layer.estimate(*points, scores=scores)
        assert (estimate.F_mat.shape, estimate.F_mat.dtype) == ((3, 3, 3), dtype)
        assert len(estimate.stages) == 3
        unrefined = shaken_estimator(stages=3, refine_steps=0).to(device).estimate(*points, scores=scores)
        assert up_to_sign(unrefined.F_mat.detach(), unrefined.stages[-1].F_mat.detach()) < 1e-3
        assert torch.equal(unrefined.stages[0].F_mat, estimate.stages[0].F_mat)
        assert not torch.equal(unrefined.stages[1].F_mat, estimate.stages[1].F_mat)  # it sees other residuals
        assert torch.allclose(estimate.weights, estimate.stages[-1].logits.sigmoid())
        assert estimate.E_mat is None
        assert estimate.determined.all()

    @pytest.mark.parametrize("number", [0, 5, 8])
    def test_scores_of_few_matches_get_zero(self, number):
        points1, points2 = correspondences("handheld", 2, 30)
        matches = [torch.arange(number)[:, None].expand(number, 2)] * 2
        scores = [torch.rand(number, requires_grad=True) for _ in range(2)]
        estimate = shaken_estimator().from_matches(points1, points2, matches, scores)
        for gradient in torch.autograd.grad(signless(estimate.F_mat).sum(), scores):
            assert not gradient.any()

    def test_wrong_scores(self):
        for scores, error, message in [
            (torch.rand(2, 9), ValueError, r"scores .*\[2, 12\], got \[2, 9\]"),
            (torch.full((2, 12), 1.5), ValueError, r"scores .* got 1\.5 to 1\.5"),
            (torch.full((2, 12), torch.nan), ValueError, r"scores .* got nan"),
            (torch.ones(2, 12, dtype=torch.int64), TypeError, r"scores .* got torch\.int64"),
        ]:
            with pytest.raises(error, match=message):
                shaken_estimator()(*correspondences("handheld", 2, 12), scores=scores)

    def test_wrong_options(self):
        for options, message in [
            ({"stages": 0}, "stages must be .* 1, got 0"),
            ({"refine_steps": -1}, "refine_steps must be .* 0, got -1"),
            ({"width": 0}, "width must be"),
            ({"samples": -1}, "samples must be .* 0, got -1"),
            ({"depth": 1.5}, "depth must be .* got 1.5"),
            ({"learn_transforms": "no"}, "learn_transforms must be .* got 'no'"),
            ({"rank2": "no"}, "rank2 must be"),
        ]:
            with pytest.raises(ValueError, match=message):
                kln.LearnedEightPoint(**options)

    def test_masked_scores_may_hold_anything(self):
        points, layer = correspondences("handheld", 2, 12), shaken_double()
        mask = torch.arange(12).expand(2, 12) < 10
        scores = torch.where(mask, 0.5, torch.nan)
        expected = layer(*(p[:, :10] for p in points), scores=scores[:, :10])
        assert up_to_sign(layer(*points, mask=mask, scores=scores).detach(), expected.detach()) < 1e-6


class TestFiles:
    @pytest.fixture
    def file(self, tmp_path):
        path = tmp_path / "weights.safetensors"
        layer = shaken_estimator(learn_transforms=False, rank2="optimal")
        layer.trained_on = ("one", "two@0:3")
        layer.save_pretrained(path)
        return path

    def test_round_trip(self, file):
        layer, expected = kln.LearnedEightPoint.from_pretrained(file), shaken_estimator()
        assert (layer.learn_transforms, layer.rank2, layer.trained_on) == (False, "optimal", ("one", "two@0:3"))
        assert not layer.training
        for key, value in expected.state_dict().items():
            assert torch.equal(layer.state_dict()[key], value)

    @pytest.mark.parametrize(
        "architecture", ["", "[]", '{"widht": 3}', '{"width": 10000}', '{"stages": 0}', '{"rank2": "no"}']
    )
    def test_garbled_architecture(self, file, architecture):
        rewrite_weights(file, lambda _, metadata: metadata.update(architecture=architecture))
        with pytest.raises(ValueError, match=r"weights\.safetensors describes no estimator of this version"):
            kln.LearnedEightPoint.from_pretrained(file)

    def test_weights_of_a_normaliser(self):
        with pytest.raises(ValueError, match=r"crossview: .* LearnedEightPoint.* LearnedNormalizer"):
            kln.LearnedEightPoint.from_pretrained("crossview")


def test_median_of_the_present_rows():
    values, present = uniform(6, 11, 3, low=-1), (uniform(6, 11, seed=1) < 0.6).double()
    found = masked_median(values, present)
    for k in range(6):
        held = values[k][present[k] > 0].sort(0).values
        assert torch.equal(found[k, 0], held[(len(held) - 1) // 2])
    assert torch.equal(masked_median(values, torch.ones(6, 11)), masked_median(values, None))
    assert not masked_median(values, torch.zeros(6, 11)).any()

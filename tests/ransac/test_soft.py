"""The soft RANSAC against NumPy, and its gradients against enumeration and finite differences."""

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from pairwise import pairwise
from references import eight_point, numpy_hartley, numpy_sampson, numpy_whitening, up_to_sign
from scenes import DTYPES, correspondences, raises, seeded, uniform
from torch.autograd import gradcheck

from kornia_learnnorm import Hartley, Whitening
from kornia_learnnorm.ransac.soft import expected_loss, sample_minimal_sets


def target(F):
    """A loss of matrices that knows no sign, (*, K)."""
    return (F[..., 0, :].square() * F.new_tensor([1.0, 2.0, 3.0])).sum(-1)


def drawn(points, count: int = 6, seed: int = 0):
    logits = uniform(*points.shape[:2], low=-1, seed=seed)
    return sample_minimal_sets(logits, count, torch.Generator().manual_seed(seed))


def unit_square(num_points: int, batch_size: int = 2):
    return [uniform(batch_size, num_points, 2, low=-1, seed=seed) for seed in (1, 2)]


class TestSampleMinimalSets:
    @pytest.mark.parametrize("peak", [0, 46])
    def test_probabilities_agree_with_numpy(self, peak):
        logits = uniform(3, 12, low=-2, high=2)
        logits[:, :5] += peak
        samples, log_probs = sample_minimal_sets(logits, 10, torch.Generator().manual_seed(0))
        p = np.exp(logits.numpy()) / np.exp(logits.numpy()).sum(-1, keepdims=True)
        drawn = np.take_along_axis(p[:, None], samples.numpy(), -1)
        never = np.stack([np.delete(row, sample) for row, many in zip(p, samples, strict=True) for sample in many])
        left = never.reshape(3, 10, 4).sum(-1, keepdims=True) + drawn[..., ::-1].cumsum(-1)[..., ::-1]
        np.testing.assert_allclose(log_probs.numpy(), np.log(drawn / left).sum(-1))

    def test_repeats_with_the_generator_and_ignores_a_constant(self):
        logits = uniform(2, 20)
        first, again, moved = (sample_minimal_sets(values, 7, seeded(3)) for values in (logits, logits, logits + 50))
        assert torch.equal(first[0], again[0])
        assert torch.equal(first[0], moved[0])
        torch.testing.assert_close(first[1], moved[1])

    def test_gradients(self):
        def log_probs(logits):
            return sample_minimal_sets(logits, 4, torch.Generator().manual_seed(0))[1]

        assert gradcheck(log_probs, [uniform(2, 10, low=-1).requires_grad_()])

    def test_gradients_of_certain_draws_are_finite(self):
        logits = torch.full((1, 20), -60.0)
        logits[:, :8] = 60.0
        logits.requires_grad_()
        (gradient,) = torch.autograd.grad(sample_minimal_sets(logits, 4)[1].sum(), logits)
        assert torch.isfinite(gradient).all()

    def test_exceptions(self):
        for logits, count, error, message in [
            (None, 1, TypeError, "logits must be .* got <class 'NoneType'>"),
            (torch.ones(9), 1, ShapeError, r"\[9\]"),
            (torch.ones(1, 7), 1, ValueError, "at least 8 .* got 7"),
            (torch.full((1, 9), -torch.inf), 1, ValueError, "logits must be finite, got 9"),
            (torch.ones(1, 9), 0, ValueError, "count must be >= 1, got 0"),
        ]:
            raises(error, message, sample_minimal_sets, logits, count)


class TestExpectedLoss:
    @pairwise(batch_size=[0, 1, 3], num_points=[8, 40], guided=[False, True], dtype=DTYPES)
    def test_smoke(self, batch_size, num_points, guided, dtype, device):
        points = [uniform(batch_size, num_points, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
        samples, log_probs = sample_minimal_sets(torch.zeros(batch_size, num_points, device=device, dtype=dtype), 5)
        assert (samples.shape, log_probs.shape, log_probs.dtype) == ((batch_size, 5, 8), (batch_size, 5), dtype)
        assert (samples.sort(-1).values.diff(dim=-1) > 0).all()
        choice = expected_loss(*points, samples, target, log_probs if guided else None)
        shapes = choice.loss.shape, choice.F_mat.shape, choice.probability.shape
        assert shapes == ((batch_size,), (batch_size, 5, 3, 3), (batch_size, 5))
        assert choice.loss.dtype == choice.F_mat.dtype == choice.probability.dtype == dtype

    @pytest.mark.parametrize(("normalizer", "transform"), [(None, numpy_hartley), (Whitening(), numpy_whitening)])
    def test_agrees_with_numpy(self, normalizer, transform):
        points1, points2 = correspondences("handheld", 3, 30)
        samples, log_probs = drawn(points1)
        choice = expected_loss(points1, points2, samples, target, log_probs, normalizer, 2.0, 3.0, 0.5)
        for b in range(3):
            chosen = [points[b][samples[b]] for points in (points1, points2)]
            F = eight_point(*chosen, *(transform(points) for points in chosen))
            distance = np.abs(numpy_sampson(points1[b], points2[b], F))
            scores = 0.5 * (1 / (1 + np.exp(-3.0 * (1 - distance / 2.0)))).sum(-1)
            p = np.exp(scores - scores.max()) / np.exp(scores - scores.max()).sum()
            losses = (F[:, 0] ** 2 * [1, 2, 3]).sum(-1)
            assert up_to_sign(choice.F_mat[b], F) < 1e-9
            np.testing.assert_allclose(choice.probability[b].numpy(), p, rtol=1e-6)
            assert choice.loss[b].item() == pytest.approx(p @ losses, rel=1e-6)

    @settings(max_examples=5)
    @given(st.integers(0, 2**31), st.randoms())
    def test_order_does_not_matter(self, seed, random):
        points1, points2 = correspondences("handheld", 2, 15, seed)
        samples, _ = drawn(points1, seed=seed)
        order = torch.tensor(random.sample(range(15), 15))
        hypotheses, within = (torch.tensor(random.sample(range(n), n)) for n in (6, 8))
        choice = expected_loss(points1, points2, samples, target)
        moved = order.argsort()[samples][:, hypotheses][..., within]
        shuffled = expected_loss(points1[:, order], points2[:, order], moved, target)
        torch.testing.assert_close(choice.loss, shuffled.loss, rtol=1e-5, atol=1e-12)
        torch.testing.assert_close(choice.probability[:, hypotheses], shuffled.probability, rtol=1e-4, atol=1e-9)

    def test_sharp_scores_choose_the_best_and_flat_ones_average(self):
        points = correspondences("orbit", 3, 40, noise=0.2, outliers=0.2)
        samples, _ = drawn(points[0], 20)
        flat, sharp = (expected_loss(*points, samples, target, scale=scale) for scale in (0.0, 1e4))
        torch.testing.assert_close(flat.loss, target(flat.F_mat).mean(-1))
        best = sharp.probability.argmax(-1, keepdim=True)
        torch.testing.assert_close(sharp.loss, target(sharp.F_mat).gather(-1, best)[:, 0])

    def test_gradients_of_points_and_normaliser(self):
        points, shear = unit_square(12), torch.tensor([0.3, -0.2], dtype=torch.float64)
        samples, log_probs = drawn(points[0])

        def loss(points1, points2, shear):
            def normalizer(*views):
                T1, T2 = Hartley()(*views)
                S = torch.eye(3, dtype=torch.float64) + torch.diag_embed(shear, 1)
                return S @ T1, S.mT @ T2

            return expected_loss(points1, points2, samples, target, log_probs, normalizer, threshold=0.1).loss

        assert gradcheck(loss, [value.requires_grad_() for value in (*points, shear)], fast_mode=True)

    @pytest.mark.long
    def test_gradients_of_the_sampling_are_unbiased(self, generator):
        """Nine points have nine sets of eight: the exact expectation over two hypotheses is a sum of 81 terms."""
        points = [p[:1] for p in unit_square(9)]
        logits = uniform(1, 9, low=-1, seed=5).requires_grad_()
        sets = torch.tensor([[i for i in range(9) if i != left_out] for left_out in range(9)])
        pairs = torch.cartesian_prod(torch.arange(9), torch.arange(9))
        values = expected_loss(*(p.expand(81, -1, -1) for p in points), sets[pairs], target, scale=1.0, threshold=0.1)
        p = logits[0].softmax(-1)
        last = probabilities_to_be_last(p)  # A set is drawn where its missing point would come last.
        exact = (last[pairs[:, 0]] * last[pairs[:, 1]] * values.loss).sum()
        (wanted,) = torch.autograd.grad(exact, logits)

        many = logits.detach().expand(40_000, -1).clone().requires_grad_()
        samples, log_probs = sample_minimal_sets(many, 2, generator)
        points = [p.expand(40_000, -1, -1) for p in points]
        found = expected_loss(*points, samples, target, log_probs, scale=1.0, threshold=0.1)
        (gradients,) = torch.autograd.grad(found.loss.sum(), many)
        error = gradients.std(0) / 200
        assert found.loss.mean().item() == pytest.approx(exact.item(), abs=4 * found.loss.std().item() / 200)
        assert ((gradients.mean(0) - wanted[0]).abs() < 4.5 * error).all()
        assert (wanted[0].abs() > 6 * error).any()


def probabilities_to_be_last(p):
    """Probability of each to be drawn last without replacement: by inclusion and exclusion."""
    result = []
    for last in range(len(p)):
        others = [i for i in range(len(p)) if i != last]
        sets = [chosen for size in range(len(p)) for chosen in combinations(others, size)]
        result.append(sum((-1) ** len(chosen) * p[last] / (p[last] + sum(p[i] for i in chosen)) for chosen in sets))
    return torch.stack(result)


POINTS, SAMPLES = torch.rand(2, 9, 2), torch.arange(8).expand(2, 3, 8)


def test_expected_loss():
    for wrong, error, message in [
        ({"samples": None}, TypeError, "samples must be .* got <class 'NoneType'>"),
        ({"samples": SAMPLES[..., :7]}, ShapeError, r"\[2, 3, 7\]"),
        ({"samples": SAMPLES[:1]}, ValueError, "samples of 2 sets .* got 1"),
        ({"log_probs": torch.zeros(2)}, ValueError, r"log_probs .* \[2, 3\] .* got \[2\]"),
        ({"samples": SAMPLES[:, :1], "log_probs": torch.zeros(2, 1)}, ValueError, r"log_probs .* got \[2, 1\]"),
        ({"loss": lambda F: F[:, 0, 0, 0]}, ValueError, r"one value per matrix, \[2, 3\], got \[2\]"),
        *(({name: 0.0}, ValueError, r"threshold and slope .* got .*0\.0") for name in ("threshold", "slope")),
    ]:
        with pytest.raises(error, match=message):
            expected_loss(**({"points1": POINTS, "points2": POINTS, "samples": SAMPLES, "loss": target} | wrong))

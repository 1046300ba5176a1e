"""The refiner of matches: identity before training, Lucas-Kanade, frames, symmetry, masks, gradients, files, errors."""

import pickle
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pairwise import pairwise
from references import check_gradients
from scenes import DTYPES, raises, rewrite_weights, roughened, seeded, uniform
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.estimators.match_refiner import local_frames

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
from make_sequences import texture  # noqa: E402 (needs Pillow, which comes with OpenCV's extra)

pytestmark = pytest.mark.numerical
WIDTH, HEIGHT = 120, 90
SHIFT = 0.4, -0.3  # of the second image against the first, pixels
trained = partial(roughened, kln.MatchRefiner)


def inputs(number: int = 1, num_points: int = 20, channels: int = 1) -> list[Tensor]:
    """A texture, the same one moved by SHIFT, of another size, and matches, which lie at the same place of both."""
    image = cv2.GaussianBlur(texture(0, WIDTH, HEIGHT), (0, 0), 1.5)
    shift = np.array([[1.0, 0, SHIFT[0]], [0, 1, SHIFT[1]]])
    pair = image, cv2.warpAffine(image, shift, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)[:, :-10]
    images = (torch.from_numpy(view / 255.0).expand(number, channels, -1, -1) for view in pair)
    points = 15 + torch.tensor([WIDTH - 40.0, HEIGHT - 30.0]).double() * uniform(number, num_points, 2, seed=3)
    return [*images, points, points.clone()]


@pairwise(number=[0, 1, 3], num_points=[0, 1, 20], channels=[1, 3], dtype=DTYPES, masked=[False, True])
def test_smoke(number, num_points, channels, dtype, masked):
    values = [value.to(dtype) for value in inputs(number, num_points, channels)]
    mask = uniform(number, num_points) > 0.3 if masked else None
    with torch.set_grad_enabled(masked):
        found = trained().float()(*values, mask=mask)
    for name, shape in {"points1": (num_points, 2), "points2": (num_points, 2), "scale": (num_points,)}.items():
        value = getattr(found, name)
        assert (value.shape, value.dtype, value.is_inference()) == ((number, *shape), dtype, False)
        assert value[torch.ones(number, num_points, dtype=torch.bool) if mask is None else mask].isfinite().all()


@pytest.mark.parametrize("channels", [1, 3])
def test_bytes_are_taken_as_they_are(channels):
    image1, image2, *points = inputs(channels=channels)
    grey1, grey2 = (255 * image1).byte(), (255 * image2).byte()
    torch.testing.assert_close(trained()(grey1, grey2, *points), trained()(grey1 / 255, grey2 / 255, *points))


def test_points_stay_before_training():
    values = inputs()
    found = kln.MatchRefiner()(*values)
    for points in found[:2]:
        assert torch.equal(points, values[2])
    assert torch.equal(found.scale, torch.ones_like(found.scale))


def test_the_step_is_that_of_lucas_kanade():
    """One step in a wide window removes most of a shift by less than a pixel, of which OpenCV's iterations find all."""
    refiner = kln.MatchRefiner(15).double()
    values = inputs(num_points=200)
    with torch.no_grad():
        refiner.gates.bias[2] = 1.0  # the widest window's step
        found = refiner(*values)
    displacement = (found.points2 - found.points1)[0]
    first, second = ((255 * image[0, 0]).byte().numpy() for image in values[:2])
    start = values[2][0].float().numpy()
    second = np.pad(second, ((0, 0), (0, 10)), "edge")
    tracked = cv2.calcOpticalFlowPyrLK(first, second, start, start.copy(), winSize=(15, 15), maxLevel=0)[0]
    expected = torch.from_numpy(tracked - start)
    assert (expected - torch.tensor(SHIFT)).norm(dim=-1).median() < 0.05
    assert (displacement - expected).norm(dim=-1).median() < 0.16


def test_points_move_apart_alike_and_within_the_bound():
    refiner, values = trained(bound=0.6), inputs(num_points=50)
    with torch.no_grad():
        refiner.shift.weight.mul_(100)
    found = refiner(*values)
    first, second = found.points1 - values[2], found.points2 - values[3]
    torch.testing.assert_close(first, -second)
    assert 0.25 < first.norm(dim=-1).max() <= 0.3


@given(st.integers(0, 1000), st.sampled_from([1, 2]))
@settings(max_examples=8)
def test_swapping_the_views_swaps_the_result(seed, passes):
    image1, image2, points1, points2 = inputs(num_points=10)
    points2 = points2 + uniform(1, 10, 2, low=-1, seed=seed)
    refiner = trained()
    refiner.passes = passes
    found, swapped = refiner(image1, image2, points1, points2), refiner(image2, image1, points2, points1)
    torch.testing.assert_close(swapped.points1, found.points2, atol=1e-12, rtol=0)
    torch.testing.assert_close(swapped.points2, found.points1, atol=1e-12, rtol=0)
    torch.testing.assert_close(swapped.scale, found.scale, atol=1e-12, rtol=0)


@pytest.mark.parametrize("num_points", [20, 300])
def test_the_order_of_the_matches_has_no_effect(num_points):
    image1, image2, points1, points2 = inputs(num_points=num_points)
    order = torch.randperm(num_points, generator=seeded())
    found = trained()(image1, image2, points1, points2)
    shuffled = trained()(image1, image2, points1[:, order], points2[:, order])
    for one, other in zip(found, shuffled, strict=True):
        torch.testing.assert_close(one[:, order], other)


@pytest.mark.parametrize("num_points", [40, 400])
def test_frames_are_those_of_an_affine_map(num_points):
    """Also among false matches; turned views give patches that agree."""
    A = torch.tensor([[0.8, -0.4], [0.5, 1.1]]).double()
    points1 = 300 * uniform(2, num_points, 2)
    points2 = points1 @ A.mT + 50
    frame1, frame2 = local_frames(points1, points2)
    torch.testing.assert_close(frame2 @ torch.linalg.inv(frame1), A.expand(2, num_points, 2, 2), atol=0.05, rtol=0)
    torch.testing.assert_close(frame1 @ frame2, torch.eye(2).double().expand_as(frame1))
    false = uniform(2, num_points, seed=1) < 0.3
    points2 = torch.where(false[..., None], 400 * uniform(2, num_points, 2, seed=2), points2)
    frame1, frame2 = local_frames(points1, points2)
    assert (frame2 @ torch.linalg.inv(frame1) - A).abs().amax((-1, -2))[~false].median() < 0.2
    torch.testing.assert_close(local_frames(points2, points1), (frame2, frame1))
    mirrored = local_frames(points1, points1 * torch.tensor([-1.0, 1.0]))  # no turn: the patches stay upright
    assert mirrored[0].isfinite().all()


@pytest.mark.parametrize(("num_points", "absent"), [(20, 6), (600, 200), (600, 500), (20, 20)])
def test_masked_rows_come_back_as_they_are(num_points, absent):
    refiner, values = trained(), inputs(num_points=num_points)
    mask = torch.randperm(num_points, generator=seeded())[None] >= absent
    expected = refiner(*values[:2], *(value[mask][None] for value in values[2:]))
    points = [torch.where(mask[..., None], value, torch.nan).requires_grad_() for value in values[2:]]
    found = refiner(*values[:2], *points, mask=mask)
    for k in range(2):
        torch.testing.assert_close(found[k][mask][None], expected[k])
        assert found[k][~mask].isnan().all()
    assert found.scale[~mask].isinf().all()
    weights = found.scale**-2
    assert not weights[~mask].any()
    (found.points1[mask].sum() + weights.sum()).backward()
    assert all(point.grad.isfinite().all() for point in points)


def test_images_without_texture_and_points_outside_move_nothing_far():
    refiner, flat, points = trained().float(), torch.full((1, 1, 30, 40), 0.5), torch.zeros(1, 10, 2)
    points[0, :2] = torch.tensor([[-300.0, 20], [1e4, 1e4]])
    for image in (flat, torch.zeros(1, 1, 1, 1), torch.ones(1, 3, 30, 40)):
        assert all(value.isfinite().all() for value in refiner(image, flat, points, points))
    message = "10 of 10 points2 lie outside of image2, 40 x 30"
    raises(ValueError, message, refiner, flat, flat, points, points + 301)


def test_a_second_pass_is_that_of_the_moved_points():
    """A match alone, whose frame is the identity wherever it is."""
    values, refiner = inputs(num_points=1), trained()
    once = refiner(*values)
    expected, refiner.passes = refiner(*values[:2], *once[:2]), 2
    for found, other, before in zip(refiner(*values), expected, once, strict=True):
        torch.testing.assert_close(found, other)
        assert not torch.allclose(found, before)


def test_autocast_changes_nothing():
    refiner, values = trained().float(), [value.float() for value in inputs()]
    with torch.autocast("cpu", torch.bfloat16):
        found = refiner(*values)
    torch.testing.assert_close(found, refiner(*values), rtol=0, atol=0)


@pytest.mark.parametrize("passes", [1, 2])
def test_gradcheck(passes):
    image1, image2, points1, points2 = inputs(num_points=3)
    crops = [image[..., 20:50, 20:60].contiguous() for image in (image1, image2)]
    points = [15.3 + 5 * uniform(1, 3, 2, seed=seed) for seed in (4, 5)]
    refiner = trained()
    refiner.passes = passes
    check_gradients(lambda *values: torch.cat([v.flatten(1) for v in refiner(*values)], 1), *crops, *points)
    sum(value.sum() for value in refiner(image1, image2, points1, points2)).backward()
    assert all(bool(p.grad.isfinite().all()) and bool(p.grad.any()) for p in refiner.parameters())


def test_files_and_pickles_give_the_same_refiner(tmp_path):
    refiner, values = trained(), inputs()
    refiner.trained_on = ("a", "b")
    refiner.save_pretrained(tmp_path / "mine.safetensors")
    loaded = kln.MatchRefiner.from_pretrained(tmp_path / "mine.safetensors")
    assert (loaded.trained_on, loaded.training, loaded.bound) == (("a", "b"), False, 1.5)
    for other in (loaded, pickle.loads(pickle.dumps(refiner))):
        for one, two in zip(other(*values), refiner(*values), strict=True):
            assert torch.equal(one, two)
    raises(ValueError, "MatchRefiner", kln.LearnedEightPoint.from_pretrained, tmp_path / "mine.safetensors")
    rewrite_weights(tmp_path / "mine.safetensors", lambda state, about: about.update(architecture='{"width": 1e9}'))
    raises(ValueError, "describes no refiner", kln.MatchRefiner.from_pretrained, tmp_path / "mine.safetensors")


def test_exceptions():
    refiner, (image1, image2, points1, points2) = trained(), inputs()
    nan = points1.clone()
    nan[0, 0, 0] = torch.nan
    for wrong, error, match in (
        ((255 * image1, image2, points1, points2), ValueError, "from 0 to 1, got"),
        ((image1.long(), image2, points1, points2), TypeError, "image1 must hold floating-point numbers from 0"),
        ((image1[0], image2, points1, points2), Exception, "image1"),
        ((image1, image2.expand(2, -1, -1, -1), points1, points2), ValueError, r"image2 must have shape \[1, 1 or 3"),
        ((image1.expand(1, 2, -1, -1), image2, points1, points2), ValueError, r"got \[1, 2, 90, 120\]"),
        ((image1, image2, points1, points2[:, :5]), ValueError, "pair up"),
        ((image1, image2, nan, points2), ValueError, "points1 must be finite"),
        ((image1, image2, points1, points2, torch.ones(1, 20)), TypeError, "mask must be a boolean"),
    ):
        raises(error, match, refiner, *wrong)
    refiner.passes = 0
    raises(ValueError, "passes must be a whole number, at least 1, got 0", refiner, image1, image2, points1, points2)
    raises(TypeError, "must be float32 or float64, .* got torch.float16", trained().half(), *inputs())
    for name, value, text in (
        ("patch_size", 8, "odd"),
        ("patch_size", 3, "5, got"),
        ("width", 0, "1"),
        ("bound", 0, "0"),
    ):
        raises(ValueError, text, kln.MatchRefiner, **{name: value})
    raises(FileNotFoundError, r"no weights 'none': .* one of refiner$", kln.MatchRefiner.from_pretrained, "none")

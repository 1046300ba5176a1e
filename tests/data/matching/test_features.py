"""Features of images: SIFT's against NumPy, the learned ones with stubs and random weights."""

import urllib.error
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.feature import DISK, LightGlue, LightGlueMatcher, scale_laf
from make_sequences import texture

from kornia_learnnorm.data.matching import features, matchers
from kornia_learnnorm.data.synthetic.render import render_pair
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.two_view.many_pairs import PairOptions, estimate_pairs

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")


@pytest.fixture(autouse=True)
def _no_networks_kept():
    features.pretrained.cache_clear()
    yield
    features.pretrained.cache_clear()


def test_sift_finds_the_centre_of_a_blob():
    rows, columns = np.mgrid[:120, :160]
    image = 200 * np.exp(-((columns - 70.3) ** 2 + (rows - 50.6) ** 2) / 18)
    found = features.detect_sift(np.round(image).astype(np.uint8), 10).points
    assert np.abs(found - [70.3, 50.6]).max() < 0.1


def test_rootsift_is_the_root_of_sift_of_unit_sum_and_a_blank_image_has_none():
    sift, root = features.detect_sift(texture(), 100), features.detect_rootsift(texture(), 100)
    rows = sift.descriptors.astype(np.float64)
    assert np.allclose(root.descriptors, np.sqrt(rows / np.abs(rows).sum(1)[:, None]), atol=1e-6)
    assert np.allclose(np.linalg.norm(root.descriptors, axis=1), 1, atol=1e-5)
    assert root.descriptors.dtype == np.float32
    assert np.array_equal(root.points, sift.points)
    found = features.detect_rootsift(np.zeros((60, 80), np.uint8))
    assert (found.points.shape, found.descriptors.shape, found.size) == ((0, 2), (0, 128), (80, 60))


def test_disk_of_random_weights(monkeypatch):
    weights = {"extractor": DISK().state_dict()}
    monkeypatch.setattr("kornia.feature.disk.disk.load_state_dict_from_url", lambda *_, **__: weights)
    found = features.detect_disk(texture(width=200), 50)  # 180 and 200 are no multiples of 16
    assert 0 < len(found.points) <= 50
    assert (found.points.max(0) < (200, 180)).all()
    assert found.descriptors.shape == (len(found.points), 128)
    assert (found.points.dtype, found.descriptors.dtype, found.size) == (np.float32, np.float32, (200, 180))
    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)


def test_keynet_leaves_out_what_fills_up(monkeypatch):
    """Kornia fills up with frames of zeros where it finds fewer features than it was asked for."""
    frames = torch.zeros(1, 5, 2, 3)
    frames[0, :2, :, 2] = torch.tensor([[30.0, 20.0], [70.0, 40.0]])
    output = frames, torch.zeros(1, 5), torch.rand(1, 5, 128)
    monkeypatch.setattr(features, "pretrained", lambda *_: lambda image: output)
    found = features.detect_keynet(texture(), 5)
    assert found.points.tolist() == [[30, 20], [70, 40]]
    assert found.descriptors.shape == (2, 128)


def test_lightglue_of_random_weights(monkeypatch):
    network = LightGlue(None, input_dim=128, filter_threshold=0.0).eval()
    monkeypatch.setattr(matchers, "pretrained", lambda *_: network)
    rng = np.random.default_rng(0)
    points, rows = rng.uniform(0, 90, (2, 30, 2)), rng.normal(size=(2, 30, 128))
    sides = [features.Features(*map(np.float32, side), (100, 90)) for side in zip(points, rows, strict=True)]
    points1, points2, score = matchers.match_lightglue(*sides)
    assert points1.shape == points2.shape == (len(score), 2)
    assert len(score) > 0
    assert all(part.dtype == torch.float32 for part in (points1, points2, score))
    assert ((score >= 0) & (score <= 1)).all()
    with pytest.raises(ValueError, match=r"LightGlue of disk needs .* 128 columns, got float32 with 64 columns"):
        matchers.match_lightglue(*(side._replace(descriptors=side.descriptors[:, :64]) for side in sides))


@pytest.mark.parametrize(
    ("name", "scale", "used"), [("sift", 6.0, ("scales", "oris")), ("keynet_affnet_hardnet", 1.0, ("lafs",))]
)
def test_lightglue_gets_the_frames_that_kornia_gives_it(monkeypatch, name, scale, used):
    """Kornia's LightGlueMatcher makes the same input of local affine frames, SIFT's of six standard deviations."""
    given = {}

    class Spy(torch.nn.Module):
        def forward(self, data):
            given.update(data)
            return {"matches0": torch.full((1, 2), -1), "matching_scores0": torch.zeros(1, 2)}

    monkeypatch.setattr("kornia.feature.integrated.LightGlue", lambda *_, **__: Spy())
    found = [features.detect_rootsift(texture(seed, 200), 50) for seed in range(2)]
    rows, lafs = ([torch.from_numpy(getattr(side, part)) for side in found] for part in ("descriptors", "lafs"))
    frames = [scale_laf(side[None], scale) for side in lafs]
    LightGlueMatcher(name)(*rows, *frames, *(side.size[::-1] for side in found))
    for number, side in enumerate(found):
        ours, expected = matchers._lightglue_input(side), given[f"image{number}"]
        for part in ("keypoints", "descriptors", "image_size", *used):
            torch.testing.assert_close(ours[part], expected[part].to(ours[part].dtype), rtol=1e-5, atol=1e-4)


KEYNET_FILES = ["keynet_pytorch.pth", "AffNet.pth", "OriNet.pth", "checkpoint_liberty_with_aug.pth"]


@pytest.mark.parametrize(
    ("detector", "files", "lightglue", "share", "distance"),
    [
        ("aliked", ["aliked-n16.pth"], "aliked_lightglue_v0-1_arxiv-pth", 0.9, 0.4),
        ("disk", ["depth-save.pth"], "disk_lightglue_v0-1_arxiv-pth", 0.85, 1.0),
        ("xfeat", ["xfeat.pt"], "xfeat-lighterglue.pt", 0.6, 1.5),
        ("rootsift", [], "sift_lightglue_v0-1_arxiv-pth", 0.8, 0.3),
        ("keynet", KEYNET_FILES, "keynet_affnet_hardnet_lightglue.pth", 0.6, 1.5),
    ],
)
def test_matches_of_trained_networks_are_true(cached_weights, detector, files, lightglue, share, distance):
    """On a rendered pair: share of matches within 2 px of their epipolar lines, median distance."""
    cached_weights(*files, lightglue)
    pair = render_pair(seed=0, width=240, height=180)
    sides = [features.DETECTORS[detector](image, 300) for image in (pair.image1, pair.image2)]
    points1, points2, ratio = matchers.match_nearest(*sides)
    for found1, found2, score in ((points1, points2, 1 - ratio), matchers.match_lightglue(*sides, detector)):
        points = (found[score > 0.2][None].double() for found in (found1, found2))
        found = symmetric_epipolar_distance(*points, torch.from_numpy(pair.F_mat)[None])[0]
        assert len(found) > 50
        assert (found < 2).double().mean() > share
        assert found.median() < distance


@pytest.mark.parametrize(("detector", "file"), [("aliked", "aliked-n16.pth"), ("xfeat", "xfeat.pt")])
def test_grey_values_are_colours_of_three_equal_channels(cached_weights, detector, file):
    cached_weights(file)
    grey = texture(0, 120, 100)
    one, three = features.DETECTORS[detector](grey, 50), features.DETECTORS[detector](np.stack([grey] * 3, -1), 50)
    assert np.allclose(one.points, three.points, atol=1e-3)
    with pytest.raises(ValueError, match=r"grey or RGB with shape .*, got \(120, 100, 4\)"):
        features.DETECTORS[detector](np.zeros((120, 100, 4), np.uint8), 50)


@pytest.mark.parametrize(
    ("detect", "error"),
    [(features.detect_disk, urllib.error.URLError("no network")), (features.detect_keynet, EOFError("Ran out"))],
)
def test_weights_that_cannot_be_loaded(monkeypatch, detect, error):
    for place in ("disk.disk", "keynet", "affine_shape", "orientation", "hardnet"):
        monkeypatch.setattr(f"kornia.feature.{place}.load_state_dict_from_url", Mock(side_effect=error))
    with pytest.raises(OSError, match=r"the weights of .*checkpoints and could not be loaded: .*(no network|Ran out)"):
        detect(texture(), 10)


def test_weights_without_a_network_are_one_line(monkeypatch, tmp_path, refused, planes):
    """Kornia warns of every attempt and prints every address; the command names the file and its address once."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr("kornia.core.download.urlopen", Mock(side_effect=urllib.error.URLError("no network")))
    monkeypatch.setattr("kornia.core.download.time.sleep", lambda _: None)
    images = planes / "left.png", planes / "right.png"
    refused(["estimate", *images, "--detector", "xfeat"], "the weights of XFeat are not in")
    refused(["estimate", *images, "--detector", "xfeat"], f"{tmp_path}/hub/checkpoints/xfeat.pt")
    refused(["estimate", *images, "--detector", "aliked"], "/aliked-n16.pth")


def test_weights_without_a_network_end_a_list_of_pairs(monkeypatch, tmp_path, planes):
    missing = Mock(side_effect=urllib.error.URLError("none"))
    monkeypatch.setattr("kornia.feature.xfeat.load_state_dict_from_url", missing)
    pairs, out = [(planes / "left.png", planes / "right.png")], tmp_path / "out"
    with pytest.raises(features.MissingWeightsError, match="the weights of XFeat are not in"):
        estimate_pairs(pairs, out, PairOptions(detector="xfeat"), jobs=1)
    assert (out / "pairs.jsonl").read_text() == ""
    with pytest.raises(ValueError, match="K must be one camera for both images or two, got 3"):
        PairOptions(K=("1,1,1,1",) * 3).arguments(*pairs[0])


@given(seed=st.integers(0, 10**6), width=st.integers(1, 60), height=st.integers(1, 50), share=st.floats(0, 0.02))
def test_kept_features_against_distances(seed, width, height, share):
    rng = np.random.default_rng(seed)
    mask = rng.random((height, width)) >= share
    points = rng.uniform(-0.5, (width - 0.5, height - 0.5), (40, 2)).astype(np.float32)
    masked = np.argwhere(~mask)[:, ::-1]
    away = np.abs(points.round()[:, None] - masked).max(-1).min(-1, initial=np.inf) > 8
    found = features.keep_features(features.Features(points, np.arange(40)[:, None], (width, height)), mask)
    assert found.descriptors[:, 0].tolist() == np.flatnonzero(away).tolist()
    assert np.array_equal(found.points, points[away])
    assert found.size == (width, height)

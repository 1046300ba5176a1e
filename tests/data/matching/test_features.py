"""Features of images: SIFT's against NumPy, the learned ones with stubs and random weights."""

import urllib.error
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.feature import DISK, LightGlue
from make_sequences import texture

from kornia_learnnorm.data.matching import features as module
from kornia_learnnorm.data.matching import matchers as matching
from kornia_learnnorm.data.matching.features import (
    Features,
    detect_disk,
    detect_keynet,
    detect_rootsift,
    detect_sift,
    keep_features,
    pretrained,
)

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")


@pytest.fixture(autouse=True)
def _no_networks_kept():
    pretrained.cache_clear()
    yield
    pretrained.cache_clear()


def test_rootsift_is_the_root_of_sift_of_unit_sum():
    sift, root = detect_sift(texture(), 100), detect_rootsift(texture(), 100)
    rows = sift.descriptors.astype(np.float64)
    assert np.allclose(root.descriptors, np.sqrt(rows / np.abs(rows).sum(1)[:, None]), atol=1e-6)
    assert np.allclose(np.linalg.norm(root.descriptors, axis=1), 1, atol=1e-5)
    assert root.descriptors.dtype == np.float32
    assert np.array_equal(root.points, sift.points)


def test_blank_has_none():
    found = detect_rootsift(np.zeros((60, 80), np.uint8))
    assert (found.points.shape, found.descriptors.shape, found.size) == ((0, 2), (0, 128), (80, 60))


def test_disk_of_random_weights(monkeypatch):
    weights = {"extractor": DISK().state_dict()}
    monkeypatch.setattr("kornia.feature.disk.disk.load_state_dict_from_url", lambda *_, **__: weights)
    found = detect_disk(texture(width=200), 50)  # 180 and 200 are no multiples of 16
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
    monkeypatch.setattr(module, "pretrained", lambda *_: lambda image: output)
    found = detect_keynet(texture(), 5)
    assert found.points.tolist() == [[30, 20], [70, 40]]
    assert found.descriptors.shape == (2, 128)


def test_keynet_of_random_weights(monkeypatch):
    import kornia.feature.affine_shape as affine
    import kornia.feature.hardnet as hardnet
    import kornia.feature.keynet as keynet
    import kornia.feature.orientation as orientation

    networks = {
        keynet: keynet.KeyNet(False), orientation: orientation.OriNet(False),
        affine: affine.LAFAffNetShapeEstimator(False), hardnet: hardnet.HardNet(False),
    }  # fmt: skip
    for place, network in networks.items():
        weights = {"state_dict": network.state_dict()}
        monkeypatch.setattr(place, "load_state_dict_from_url", lambda *_, w=weights, **__: w)
    found = detect_keynet(texture(), 40)
    assert len(found.points) <= 40
    assert found.descriptors.shape == (len(found.points), 128)
    assert (found.points.dtype, found.descriptors.dtype) == (np.float32, np.float32)
    assert found.points.any(1).all()


def test_lightglue_of_random_weights(monkeypatch):
    monkeypatch.setattr(matching, "_lightglue", LightGlue(None, input_dim=128).eval().__call__)
    monkeypatch.setattr(matching, "pretrained", lambda name, network: network)
    rng = np.random.default_rng(0)
    points, rows = rng.uniform(0, 90, (2, 30, 2)), rng.normal(size=(2, 30, 128))
    sides = [Features(*map(np.float32, side), (100, 90)) for side in zip(points, rows, strict=True)]
    matches = matching.match_lightglue(*sides)
    assert matches.points1.shape == matches.points2.shape == (len(matches.ratio), 2)
    assert all(part.dtype == torch.float32 for part in matches)
    assert ((matches.ratio >= 0) & (matches.ratio <= 1)).all()
    with pytest.raises(ValueError, match=r"the descriptors of DISK, .* got float32 with 64 columns"):
        matching.match_lightglue(*(side._replace(descriptors=side.descriptors[:, :64]) for side in sides))


@pytest.mark.parametrize(
    ("detect", "error"), [(detect_disk, urllib.error.URLError("no network")), (detect_keynet, EOFError("Ran out"))]
)
def test_weights_that_cannot_be_loaded(monkeypatch, detect, error):
    for place in ("disk.disk", "keynet", "affine_shape", "orientation", "hardnet"):
        monkeypatch.setattr(f"kornia.feature.{place}.load_state_dict_from_url", Mock(side_effect=error))
    with pytest.raises(OSError, match=r"the weights of .*checkpoints and could not be loaded: .*(no network|Ran out)"):
        detect(texture(), 10)


class TestKeepFeatures:
    @staticmethod
    def features(points: np.ndarray, size: tuple[int, int]) -> Features:
        return Features(points.astype(np.float32), np.arange(len(points))[:, None], size)

    @given(seed=st.integers(0, 10**6), width=st.integers(1, 60), height=st.integers(1, 50), share=st.floats(0, 0.02))
    def test_against_distances(self, seed, width, height, share):
        rng = np.random.default_rng(seed)
        mask = rng.random((height, width)) >= share
        points = rng.uniform(-0.5, (width - 0.5, height - 0.5), (40, 2))
        masked = np.argwhere(~mask)[:, ::-1]
        away = np.abs(points.astype(np.float32).round()[:, None] - masked).max(-1).min(-1, initial=np.inf) > 8
        found = keep_features(self.features(points, (width, height)), mask)
        assert found.descriptors[:, 0].tolist() == np.flatnonzero(away).tolist()
        assert np.array_equal(found.points, points[away].astype(np.float32))
        assert found.size == (width, height)

    def test_wrong_masks(self):
        features = self.features(np.zeros((2, 2)), (30, 40))
        with pytest.raises(TypeError, match="a mask must be an array of bool, got uint8"):
            keep_features(features, np.ones((40, 30), np.uint8))
        with pytest.raises(ValueError, match=r"shape of its image, \(40, 30\), got \(30, 40\)"):
            keep_features(features, np.ones((30, 40), bool))

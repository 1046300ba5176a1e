"""Matching images."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from make_sequences import texture

from kornia_learnnorm.data.matching.matchers import match_images

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")


class TestMatchImages:
    def test_shift_is_found(self):
        image = texture(width=260, height=200)
        matches = match_images(image[20:, 10:].copy(), image[:-20, :-10].copy())
        good = matches.ratio < 0.6
        assert good.sum() > 50
        offset = (matches.points2 - matches.points1)[good].median(0).values
        assert torch.allclose(offset, torch.tensor([10.0, 20.0]), atol=0.1)

    def test_neighbours_and_ratio_match_numpy(self):
        image1, image2 = texture(0), texture(0)[:, 15:].copy()
        matches = match_images(image1, image2, num_features=100)
        sift = cv2.SIFT_create(100)
        (keys1, descriptors1), (keys2, descriptors2) = (sift.detectAndCompute(i, None) for i in (image1, image2))
        distances = np.linalg.norm(descriptors1[:, None].astype(float) - descriptors2[None], axis=2)
        nearest = distances.argmin(1)
        ranked = np.sort(distances, 1)
        assert np.allclose(matches.ratio, ranked[:, 0] / ranked[:, 1], atol=1e-5)
        assert all(part.dtype == torch.float32 for part in matches)
        assert np.allclose(matches.points1, [key.pt for key in keys1])
        assert np.allclose(matches.points2, [keys2[index].pt for index in nearest])

    def test_ties_have_ratio_one(self):
        # Two copies of a patch in image 2: both neighbours are at distance zero.
        patch = np.full((120, 120), 128, np.uint8)
        patch[30:90, 30:90] = texture(width=60, height=60)
        matches = match_images(patch, np.hstack([patch, patch]))
        assert (matches.ratio == 1).float().mean() > 0.9

    @pytest.mark.parametrize(
        ("changes", "error", "message"),
        [
            ({"image1": np.full((180, 240), 7, np.uint8)}, ValueError, r"image 1 is blank .* 0 features"),
            ({"image2": np.full((180, 240), 7, np.uint8)}, ValueError, r"image 2 is blank .* 0 features"),
            ({"image1": np.zeros((1, 1), np.uint8)}, ValueError, "image 1 is blank or nearly so"),
            ({"image1": texture() / 255.0}, TypeError, "an image must be an array of uint8, got float64"),
            ({"image2": "right.png"}, TypeError, "an image must be an array of uint8"),
            ({"image2": np.zeros((180, 240, 3), np.uint8)}, ValueError, r"must be grey .* got \(180, 240, 3\)"),
            ({"num_features": 0}, ValueError, "num_features must be at least 2, got 0"),
        ],
    )
    def test_wrong_arguments(self, changes, error, message):
        with pytest.raises(error, match=message):
            match_images(**{"image1": texture(), "image2": texture(), **changes})

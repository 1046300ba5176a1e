"""Reading images and matching them."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from kornia_learnnorm.data.images import read_image
from kornia_learnnorm.data.matching import match_images

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")


def texture(seed: int = 0, width: int = 240, height: int = 180) -> np.ndarray:
    """Blurred noise at two scales, with the full range of grey values."""
    rng = np.random.default_rng(seed)
    image = sum(cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma) * sigma for sigma in (1.5, 4.0))
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


class TestReadImage:
    def test_grey_values_survive(self, tmp_path):
        image = texture()
        path = tmp_path / "näme with spaces.png"
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        assert np.array_equal(read_image(path), image)
        assert np.array_equal(read_image(str(path)), image)

    def test_colour_becomes_grey(self, tmp_path):
        colour = np.zeros((4, 5, 3), np.uint8)
        colour[..., 2] = 200  # red, the last channel in OpenCV's order
        cv2.imwrite(str(tmp_path / "red.png"), colour)
        image = read_image(tmp_path / "red.png")
        assert image.shape == (4, 5)
        assert abs(int(image[0, 0]) - 0.299 * 200) <= 1  # luma of ITU-R BT.601

    def test_sixteen_bits_become_eight(self, tmp_path):
        cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 5), 0x8000, np.uint16))
        image = read_image(tmp_path / "deep.png")
        assert image.dtype == np.uint8
        assert abs(int(image[0, 0]) - 0x80) <= 1

    def test_missing_file(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"nothing\.png does not exist"):
            read_image(tmp_path / "nothing.png")

    def test_folder(self, tmp_path):
        with pytest.raises(ValueError, match="is a folder"):
            read_image(tmp_path)

    def test_empty_file(self, tmp_path):
        (tmp_path / "empty.png").touch()
        with pytest.raises(ValueError, match=r"empty\.png is empty"):
            read_image(tmp_path / "empty.png")

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
    def test_truncated(self, tmp_path, suffix):
        data = cv2.imencode(suffix, texture())[1].tobytes()
        (tmp_path / f"half{suffix}").write_bytes(data[: len(data) // 2])
        with pytest.raises(ValueError, match="truncated") as caught:
            read_image(tmp_path / f"half{suffix}")
        assert "\n" not in str(caught.value)

    def test_jpeg_with_a_thumbnail_is_whole_and_noticed_when_cut(self, tmp_path):
        thumbnail = cv2.imencode(".jpg", texture(width=32, height=24))[1].tobytes()
        segment = b"\xff\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail  # a fill byte, APP1
        data = cv2.imencode(".jpg", texture())[1].tobytes()
        data = data[:2] + segment + data[2:]
        (tmp_path / "whole.jpg").write_bytes(data)
        assert read_image(tmp_path / "whole.jpg").shape == (180, 240)
        (tmp_path / "cut.jpg").write_bytes(data[:-200])
        with pytest.raises(ValueError, match="truncated"):
            read_image(tmp_path / "cut.jpg")

    def test_corrupt(self, tmp_path):
        data = bytearray(cv2.imencode(".png", texture())[1].tobytes())
        data[len(data) // 2 : len(data) // 2 + 50] = bytes(50)
        (tmp_path / "corrupt.png").write_bytes(data)
        with pytest.raises(ValueError, match="corrupt"):
            read_image(tmp_path / "corrupt.png")

    def test_text(self, tmp_path):
        (tmp_path / "text.png").write_text("hello")
        with pytest.raises(ValueError, match="not an image"):
            read_image(tmp_path / "text.png")

    def test_without_opencv(self, tmp_path, monkeypatch):
        cv2.imwrite(str(tmp_path / "image.png"), texture())
        monkeypatch.setitem(sys.modules, "cv2", None)
        with pytest.raises(ImportError, match=r"pip install 'kornia-learnnorm\[images\]'"):
            read_image(tmp_path / "image.png")


class TestMatchImages:
    def test_shift_is_found(self):
        image = texture(width=260, height=200)
        matches = match_images(image[20:, 10:].copy(), image[:-20, :-10].copy())
        good = matches.ratio < 0.6
        assert good.sum() > 50
        offset = (matches.points2 - matches.points1)[good].median(0).values
        assert torch.allclose(offset, torch.tensor([10.0, 20.0]), atol=0.1)

    def test_types_and_shapes(self):
        matches = match_images(texture(0), texture(1))
        count = len(matches.ratio)
        assert matches.points1.shape == matches.points2.shape == (count, 2)
        assert all(part.dtype == torch.float32 for part in matches)
        assert ((matches.ratio >= 0) & (matches.ratio <= 1)).all()
        for points in matches[:2]:
            assert (points >= 0).all()
            assert (points < torch.tensor([240, 180])).all()

    def test_neighbours_and_ratio_match_numpy(self):
        image1, image2 = texture(0), texture(0)[:, 15:].copy()
        matches = match_images(image1, image2, num_features=100)
        sift = cv2.SIFT_create(100)
        (keys1, descriptors1), (keys2, descriptors2) = (sift.detectAndCompute(i, None) for i in (image1, image2))
        distances = np.linalg.norm(descriptors1[:, None].astype(float) - descriptors2[None], axis=2)
        nearest = distances.argmin(1)
        ranked = np.sort(distances, 1)
        assert np.allclose(matches.ratio, ranked[:, 0] / ranked[:, 1], atol=1e-5)
        assert np.allclose(matches.points1, [key.pt for key in keys1])
        assert np.allclose(matches.points2, [keys2[index].pt for index in nearest])

    def test_ties_have_ratio_one(self):
        # Two copies of a patch in image 2: both neighbours are at distance zero.
        patch = np.full((120, 120), 128, np.uint8)
        patch[30:90, 30:90] = texture(width=60, height=60)
        matches = match_images(patch, np.hstack([patch, patch]))
        assert (matches.ratio == 1).float().mean() > 0.9

    def test_same_twice(self):
        first, second = (match_images(texture(0), texture(1)) for _ in range(2))
        assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))

    @pytest.mark.parametrize("blank", [0, 1])
    def test_blank(self, blank):
        images = [texture(), texture()]
        images[blank] = np.full((180, 240), 7, np.uint8)
        with pytest.raises(ValueError, match=rf"image {blank + 1} is blank .* 0 features"):
            match_images(*images)

    def test_tiny(self):
        with pytest.raises(ValueError, match="image 1 is blank or nearly so"):
            match_images(np.zeros((1, 1), np.uint8), texture())

    def test_wrong_arguments(self):
        with pytest.raises(TypeError, match=r"an image must be an array of uint8, got float64"):
            match_images(texture() / 255.0, texture())
        with pytest.raises(TypeError, match="an image must be an array of uint8"):
            match_images(texture(), "right.png")
        with pytest.raises(ValueError, match=r"an image must be grey .* got \(180, 240, 3\)"):
            match_images(texture(), np.zeros((180, 240, 3), np.uint8))
        with pytest.raises(ValueError, match="num_features must be at least 2, got 0"):
            match_images(texture(), texture(), num_features=0)

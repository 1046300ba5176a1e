import numpy as np
import pytest
from make_sequences import texture

from kornia_learnnorm.data.images import image_size, read_image
from kornia_learnnorm.data.masks import content_mask, read_mask

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")


class TestContentMask:
    @pytest.mark.parametrize(
        ("top", "bottom", "left", "right"), [(30, 30, 0, 0), (0, 0, 25, 0), (1, 0, 0, 2), (5, 7, 9, 11)]
    )
    @pytest.mark.parametrize("level", [0, 2])
    def test_frame(self, top, bottom, left, right, level):
        image = np.pad(np.maximum(texture(), 40), ((top, bottom), (left, right)), constant_values=level)
        wanted = np.pad(np.ones((180, 240), bool), ((top, bottom), (left, right)))
        assert np.array_equal(content_mask(image), wanted)

    @pytest.mark.parametrize("quality", [95, 60, 30])
    def test_letterbox_in_a_jpeg(self, tmp_path, quality):
        path = tmp_path / "a.jpg"
        Image.fromarray(np.pad(texture(), ((37, 37), (0, 0)))).save(path, quality=quality)
        rows = content_mask(read_image(path)).all(1)
        assert rows[37:-37].all()
        assert rows.sum() <= 180 + 2 * 8  # the blocks of 8 x 8 pixels at the edge have some of both

    @pytest.mark.parametrize("mean", [0.0, 0.3, 1.0, 3.0, 10.0])
    def test_photograph_at_night_loses_nothing(self, mean):
        noise = np.random.default_rng(0).normal(mean, 1.0, (300, 400)).clip(0, 255)
        image = np.round(noise).astype(np.uint8)
        image[100:150, 180:260] = texture(width=80, height=50)  # what is lit
        assert content_mask(image) is None

    BLACK_INSIDE = np.full((20, 30), 90, np.uint8)
    BLACK_INSIDE[8:12], BLACK_INSIDE[:, 5:9] = 0, 0

    @pytest.mark.parametrize("image", [texture(), np.zeros((20, 30), np.uint8), BLACK_INSIDE])
    def test_no_frame(self, image):
        assert content_mask(image) is None

    def test_wrong_arguments(self):
        with pytest.raises(TypeError, match="array of uint8, got float64"):
            content_mask(np.zeros((4, 5)))
        with pytest.raises(ValueError, match=r"must be grey .* got \(4, 5, 3\)"):
            content_mask(np.zeros((4, 5, 3), np.uint8))


class TestReadMask:
    def test_pixels_above_half_count(self, tmp_path):
        cv2.imwrite(str(tmp_path / "m.png"), np.array([[0, 1, 127], [128, 254, 255]], np.uint8))
        mask = read_mask(tmp_path / "m.png", (3, 2))
        assert mask.dtype == bool
        assert mask.tolist() == [[False, False, False], [True, True, True]]

    def test_reduced_as_its_image(self, tmp_path):
        cv2.imwrite(str(tmp_path / "a.png"), texture())
        cv2.imwrite(str(tmp_path / "m.png"), np.repeat([0, 255], 120).astype(np.uint8)[None].repeat(180, 0))
        mask = read_mask(tmp_path / "m.png", image_size(tmp_path / "a.png"), max_size=100)
        assert mask.shape == read_image(tmp_path / "a.png", max_size=100).shape == (75, 100)
        assert np.array_equal(mask, (np.arange(100) >= 50)[None].repeat(75, 0))

    @pytest.mark.parametrize(
        ("mask", "size", "message"),
        [
            (np.full((4, 5), 255, np.uint8), (4, 5), r"m\.png has 5 x 4 pixels, its image 4 x 5"),
            (np.ones((4, 5), np.uint8), (5, 4), r"m\.png has no pixel above 127"),
        ],
    )
    def test_wrong(self, tmp_path, mask, size, message):
        cv2.imwrite(str(tmp_path / "m.png"), mask)
        with pytest.raises(ValueError, match=message):
            read_mask(tmp_path / "m.png", size)

"""Images as eight bits, turned and reduced, beside what OpenCV reads; masks of the pixels that count."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import blobs, centroids, texture
from pairwise import pairwise
from scenes import raises

from kornia_learnnorm.data import images

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

COLOURS = np.stack([texture(seed) for seed in range(3)], -1)
SIZES = st.tuples(st.integers(1, 20000), st.integers(1, 20000))


class TestPixels:
    @pytest.mark.parametrize(
        ("mode", "suffix", "limit"),
        [(mode, ".png", 0) for mode in ("RGB", "RGBA", "P", "LA", "1")]
        + [("RGB", ".tif", 1), ("RGB", ".jpg", 0), ("L", ".bmp", 0), ("CMYK", ".jpg", 2), ("RGB", ".webp", 1)],
    )
    def test_grey_and_colours_as_opencv_reads_them(self, tmp_path, mode, suffix, limit):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(COLOURS).convert(mode).save(path)
        grey, expected = images.read_image(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey.dtype == np.uint8
        assert np.abs(grey.astype(int) - expected).max() <= limit
        colour, expected = images.read_colour(path), cv2.imread(str(path))[..., ::-1]
        assert np.abs(colour.astype(int) - expected).max() <= max(limit, suffix == ".jpg")

    @pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32])
    def test_more_than_eight_bits_are_refused(self, tmp_path, dtype):
        Image.fromarray(np.ones((1, 2), dtype)).save(tmp_path / "a.tif")
        with pytest.raises(ValueError, match=r"a\.tif .* pixels of the kind [IF].* are not read, expected eight bits"):
            images.read_image(tmp_path / "a.tif")

    @pytest.mark.parametrize("mode", ["LA", "RGBA"])
    def test_alpha_is_composited_over_black(self, tmp_path, mode):
        colours, alpha = Image.fromarray(COLOURS).convert(mode[:-1]), texture(3)
        colours.putalpha(Image.fromarray(alpha))
        colours.save(tmp_path / "a.png")
        wanted = np.asarray(colours.convert("RGB")) * (alpha / 255.0)[..., None]
        assert np.abs(images.read_colour(tmp_path / "a.png") - wanted).max() <= 0.51
        grey = cv2.cvtColor(wanted.astype(np.float32), cv2.COLOR_RGB2GRAY)
        assert np.abs(images.read_image(tmp_path / "a.png") - grey).max() <= 1.5
        Image.fromarray(np.array([[7, 9]], np.uint8)).save(tmp_path / "a.png", transparency=7)
        assert images.read_image(tmp_path / "a.png").tolist() == [[0, 9]]

    def test_first_frame_of_several(self, tmp_path):
        first, second = (Image.fromarray(texture(seed)) for seed in (0, 1))
        first.save(tmp_path / "a.gif", save_all=True, append_images=[second])
        assert np.array_equal(images.read_image(tmp_path / "a.gif"), texture(0))


class TestBroken:
    def test_files(self, tmp_path):
        for name, change in [
            ("empty.png", lambda data: b""),
            ("half.png", lambda data: data[: len(data) // 2]),
            ("half.jpg", lambda data: data[: len(data) // 2]),
            ("hole.png", lambda data: data[: len(data) // 2] + bytes(50) + data[len(data) // 2 + 50 :]),
        ]:
            path = tmp_path / f"näme with spaces {name}"
            data = cv2.imencode(name[-4:], texture())[1].tobytes()
            path.write_bytes(data)
            assert np.abs(images.read_image(str(path)).astype(int) - texture()).mean() < 3
            data = change(data)
            path.write_bytes(data)
            raises(ValueError, rf"{name} .*: {len(data)} bytes, [^\n<]*truncated or corrupt$", images.read_image, path)

    def test_not_a_file(self, tmp_path, monkeypatch):
        for read in (images.read_image, images.image_size):
            raises(FileNotFoundError, r"nothing\.png", read, tmp_path / "nothing.png")
        raises(ValueError, r"bytes, Is a directory$", images.read_image, tmp_path)
        monkeypatch.setitem(sys.modules, "PIL.Image", None)
        raises(ImportError, r"pip install '\.\[images\]'", images.read_image, tmp_path)


class TestSizeAndTurn:
    @pairwise(suffix=[".png", ".jpg", ".tif"], orientation=range(1, 9))
    def test_as_opencv_decodes_it(self, tmp_path, suffix, orientation):
        path, exif = tmp_path / f"turned{suffix}", Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(texture(width=48, height=32)).save(path, exif=exif)
        expected = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert images.image_size(path) == expected.shape[::-1] == ((32, 48) if orientation > 4 else (48, 32))
        assert np.array_equal(images.read_image(path), expected)
        small = images.read_image(path, 24)
        wanted = cv2.resize(expected, small.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(int) - wanted).mean() < 8

    @pytest.mark.parametrize("data", [b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\0" + b"\xff" * 9])
    def test_unreadable(self, tmp_path, data):
        (tmp_path / "broken.png").write_bytes(data)
        assert images.image_size(tmp_path / "broken.png") == (0, 0)


def scaled(points, size, other):
    return (np.c_[points, np.ones(len(points))] @ images.scaling(size, other).numpy().T)[:, :2]


class TestMaxSize:
    @pytest.mark.parametrize("suffix", [".jpg", ".png"])
    def test_points_follow(self, tmp_path, suffix):
        """Also where an eighth, a quarter and half of a JPEG's size are no whole numbers."""
        grid = np.stack(np.meshgrid(np.arange(60, 1141, 110), np.arange(60, 843, 110)), -1).reshape(-1, 2)
        centres = grid + np.random.default_rng(0).uniform(-0.5, 0.5, grid.shape)
        Image.fromarray(blobs(centres, 1201, 903, width_of_blob=8.0)).save(tmp_path / f"a{suffix}", quality=95)
        for max_size in (2000, 1200, 801, 600, 299, 150):
            read = images.read_image(tmp_path / f"a{suffix}", max_size)
            size = read.shape[::-1]
            assert size == images.reduced_size((1201, 903), max_size)
            wanted = scaled(centres, images.image_size(tmp_path / f"a{suffix}"), size)
            found = centroids(read, wanted, max(2, round(45 * size[0] / 1201)), floor=2)
            assert np.abs(found - wanted).max() < 0.03

    def test_arrays_as_files(self, tmp_path):
        Image.fromarray(COLOURS).save(tmp_path / "a.png")
        assert np.array_equal(images.resize_image(COLOURS, 100), images.read_colour(tmp_path / "a.png", 100))
        assert images.resize_image(COLOURS, 240) is COLOURS
        assert images.resize_image(texture(), 60).shape == (45, 60)
        with pytest.raises(ValueError, match=r"max_size must be a number of pixels, 1 or more, .* got 0"):
            images.read_image(tmp_path / "a.png", 0)

    @given(size=SIZES, max_size=st.integers(1, 10000))
    def test_sizes(self, size, max_size):
        reduced = images.reduced_size(size, max_size)
        assert max(reduced) == min(max(size), max_size)
        assert min(reduced) >= 1
        assert np.abs(np.maximum(np.array(size) * max(reduced) / max(size), 1) - reduced).max() <= 0.5

    @pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="there is no /proc")
    def test_memory_of_a_large_jpeg(self, tmp_path):
        """8,000 x 6,000 pixels take less memory than their grey values would."""

        def peak():
            return int(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024

        Image.new("L", (8000, 6000), 90).save(tmp_path / "large.jpg")
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts again
        before = peak()
        assert images.read_image(tmp_path / "large.jpg", 2000).shape == (1500, 2000)
        assert peak() - before < 8000 * 6000 / 2**20


class TestScaling:
    @given(size=SIZES, other=SIZES, point=st.tuples(st.floats(-1e4, 3e4), st.floats(-1e4, 3e4)))
    def test_there_and_back(self, size, other, point):
        """The outer corners of the image stay where they are: -0.5 and the size less 0.5."""
        points = np.array([point, (-0.5, -0.5), np.array(size) - 0.5])
        there = scaled(points, size, other)
        assert np.allclose(there[1:], [(-0.5, -0.5), np.array(other) - 0.5], rtol=1e-9, atol=1e-9)
        assert np.allclose(scaled(there, other, size), points, rtol=1e-9, atol=1e-6)

    @pytest.mark.parametrize("sizes", [((0, 0), (3, 4)), ((3, 4), (3, 0))])
    def test_no_size(self, sizes):
        raises(ValueError, r"a positive width and height, got .*0\)", images.scaling, *sizes)


class TestContentMask:
    @pairwise(sides=[(30, 30, 0, 0), (0, 0, 25, 0), (1, 0, 0, 2), (5, 7, 9, 11)], level=[0, 2])
    def test_frame(self, sides, level):
        widths = (sides[:2], sides[2:])
        image = np.pad(np.maximum(texture(), 40), widths, constant_values=level)
        assert np.array_equal(images.content_mask(image), np.pad(np.ones((180, 240), bool), widths))

    @pytest.mark.parametrize("quality", [95, 30])
    def test_letterbox_in_a_jpeg(self, tmp_path, quality):
        path = tmp_path / "a.jpg"
        Image.fromarray(np.pad(texture(), ((37, 37), (0, 0)))).save(path, quality=quality)
        rows = images.content_mask(images.read_image(path)).all(1)
        assert rows[37:-37].all()
        assert rows.sum() <= 180 + 2 * 8  # the blocks of 8 x 8 pixels at the edge have some of both

    @pytest.mark.parametrize("mean", [0.0, 0.3, 1.0, 3.0, 10.0])
    def test_photograph_at_night_loses_nothing(self, mean):
        noise = np.random.default_rng(0).normal(mean, 1.0, (300, 400)).clip(0, 255)
        image = np.round(noise).astype(np.uint8)
        image[100:150, 180:260] = texture(width=80, height=50)  # what is lit
        assert images.content_mask(image) is None

    def test_no_frame(self):
        inside = np.full((20, 30), 90, np.uint8)
        inside[8:12], inside[:, 5:9] = 0, 0
        assert [images.content_mask(image) for image in (texture(), np.zeros((20, 30), np.uint8), inside)] == [None] * 3

    def test_wrong_arguments(self):
        raises(TypeError, "array of uint8, got float64", images.content_mask, np.zeros((4, 5)))
        raises(ValueError, r"must be grey .* got \(4, 5, 3\)", images.content_mask, np.zeros((4, 5, 3), np.uint8))


class TestReadMask:
    def test_pixels_above_half_count_also_reduced(self, tmp_path):
        cv2.imwrite(str(tmp_path / "m.png"), np.repeat([127, 128], 120).astype(np.uint8)[None].repeat(180, 0))
        mask = images.read_mask(tmp_path / "m.png", (240, 180))
        assert np.array_equal(mask, (np.arange(240) >= 120)[None].repeat(180, 0))

    def test_wrong(self, tmp_path):
        cv2.imwrite(str(tmp_path / "m.png"), np.ones((4, 5), np.uint8))
        raises(ValueError, r"m\.png has 5 x 4 pixels, its image 4 x 5", images.read_mask, tmp_path / "m.png", (4, 5))
        raises(ValueError, r"m\.png has no pixel above 127", images.read_mask, tmp_path / "m.png", (5, 4))

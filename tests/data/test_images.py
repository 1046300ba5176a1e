"""Images of every kind as eight bits, turned and reduced, beside what OpenCV reads."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import blobs, centroids, texture

from kornia_learnnorm.data import images
from kornia_learnnorm.data.images import (
    image_size,
    read_colour,
    read_image,
    reduced_size,
    resize_image,
    scale_points,
    scaling,
)

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

COLOURS = np.stack([texture(seed) for seed in range(3)], -1)
SIZES = st.tuples(st.integers(1, 20000), st.integers(1, 20000))


def exif(orientation: int) -> bytes:
    data = Image.Exif()
    data[0x0112] = orientation
    return data.tobytes()


class TestPixels:
    @pytest.mark.parametrize(
        ("mode", "suffix", "limit"),
        [(mode, *kind) for mode in ("RGB", "RGBA", "P", "LA", "1") for kind in ((".png", 0), (".tif", 1))]
        + [("RGB", ".jpg", 0), ("L", ".bmp", 0), ("CMYK", ".jpg", 2), ("RGB", ".webp", 1)],
    )
    def test_grey_and_colours_as_opencv_reads_them(self, tmp_path, mode, suffix, limit):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(COLOURS).convert(mode).save(path)
        grey, expected = read_image(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey.dtype == np.uint8
        assert np.abs(grey.astype(int) - expected).max() <= limit
        colour, expected = read_colour(path), cv2.imread(str(path))[..., ::-1]
        assert np.abs(colour.astype(int) - expected).max() <= max(limit, suffix == ".jpg")

    @pytest.mark.parametrize("folder", ["kitti/sequences/06/image_0", "tum"])
    def test_real_images_as_opencv_reads_them(self, real_data, folder):
        for path in sorted((real_data / folder).rglob("*.png"))[:3]:
            assert np.array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))

    @pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
    def test_sixteen_bits_keep_the_upper_eight(self, tmp_path, suffix):
        deep = np.array([[0, 0xFF, 0x100, 0x80FF, 0xFFFF]], np.uint16)
        cv2.imwrite(str(tmp_path / f"deep{suffix}"), deep)
        assert read_image(tmp_path / f"deep{suffix}").tolist() == [[0, 0, 1, 0x80, 0xFF]]
        colours = np.dstack([deep] * 3)
        if suffix != ".pgm":
            cv2.imwrite(str(tmp_path / f"deep{suffix}"), colours)
            assert read_colour(tmp_path / f"deep{suffix}")[0, :, 0].tolist() == [0, 0, 1, 0x80, 0xFF]

    @pytest.mark.parametrize("values", [np.array([[0, 70000]], np.int32), np.ones((1, 2), np.float32)])
    def test_other_numbers_are_refused(self, tmp_path, values):
        Image.fromarray(values).save(tmp_path / "a.tif")
        with pytest.raises(ValueError, match=r"a\.tif .* pixels of the kind [IF] are not read, expected grey"):
            read_image(tmp_path / "a.tif")

    @pytest.mark.parametrize("mode", ["LA", "RGBA"])
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
    def test_alpha_is_composited_over_black(self, tmp_path, mode, suffix):
        colours = Image.fromarray(COLOURS).convert(mode[:-1])
        alpha = texture(3)
        colours.putalpha(Image.fromarray(alpha))
        colours.save(tmp_path / f"a{suffix}", **({"lossless": True, "exact": True} if suffix == ".webp" else {}))
        wanted = np.asarray(colours.convert("RGB")) * (alpha / 255.0)[..., None]
        assert np.abs(read_colour(tmp_path / f"a{suffix}") - wanted).max() <= 0.51
        grey = cv2.cvtColor(wanted.astype(np.float32), cv2.COLOR_RGB2GRAY)
        assert np.abs(read_image(tmp_path / f"a{suffix}") - grey).max() <= 1.5

    @pytest.mark.parametrize(
        ("pixels", "key"),
        [(np.array([[7, 9]], np.uint8), 7), (np.array([[[7, 8, 9], [9, 9, 9]]], np.uint8), (7, 8, 9))],
    )
    def test_transparent_colour(self, tmp_path, pixels, key):
        Image.fromarray(pixels).save(tmp_path / "a.png", transparency=key)
        grey = read_image(tmp_path / "a.png")
        assert grey[0, 0] == 0 < grey[0, 1]

    @pytest.mark.parametrize("suffix", [".gif", ".webp"])
    def test_first_frame_of_several(self, tmp_path, suffix):
        first, second = (Image.fromarray(texture(seed)) for seed in (0, 1))
        exact = {"lossless": True} if suffix == ".webp" else {}
        first.save(tmp_path / f"a{suffix}", save_all=True, append_images=[second], **exact)
        assert np.array_equal(read_image(tmp_path / f"a{suffix}"), texture(0))


class TestBroken:
    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("empty.png", lambda data: b"", r"empty\.png is empty"),
            ("text.png", lambda data: b"hello", "5 bytes, not an image of a kind that Pillow reads"),
            ("half.png", lambda data: data[: len(data) // 2], "truncated"),
            ("half.jpg", lambda data: data[: len(data) // 2], "truncated"),
            ("half.bmp", lambda data: data[: len(data) // 2], "truncated"),
            ("hole.png", lambda data: data[: len(data) // 2] + bytes(50) + data[len(data) // 2 + 50 :], "corrupt"),
        ],
    )
    def test_files(self, tmp_path, name, change, message):
        path = tmp_path / f"näme with spaces {name}"
        data = cv2.imencode(name[-4:], texture())[1].tobytes()
        path.write_bytes(data)
        assert np.abs(read_image(str(path)).astype(int) - texture()).mean() < 3
        path.write_bytes(change(data))
        with pytest.raises(ValueError, match=message) as caught:
            read_image(path)
        assert "\n" not in str(caught.value)
        assert "<_io" not in str(caught.value)

    def test_not_a_file(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"nothing\.png does not exist"):
            read_image(tmp_path / "nothing.png")
        with pytest.raises(ValueError, match="is a folder"):
            read_image(tmp_path)

    @pytest.mark.parametrize(
        ("error", "message"),
        [
            (PermissionError(13, "Permission denied"), r"a\.png .* \d+ bytes, Permission denied$"),
            (MemoryError(), "too large for the memory"),
            (SyntaxError("broken PNG file (chunk b'\\xe3')"), r"bytes, truncated or corrupt$"),
        ],
    )
    def test_reasons_without_the_words_of_pillow(self, tmp_path, monkeypatch, error, message):
        def fail(*_):
            raise error

        cv2.imwrite(str(tmp_path / "a.png"), texture())
        monkeypatch.setattr(images, "open_image", fail)
        with pytest.raises(ValueError, match=message):
            read_image(tmp_path / "a.png")

    def test_without_pillow(self, tmp_path, monkeypatch):
        cv2.imwrite(str(tmp_path / "image.png"), texture())
        monkeypatch.setitem(sys.modules, "PIL.Image", None)
        for read in (read_image, image_size):
            with pytest.raises(ImportError, match=r"pip install '\.\[images\]'"):
                read(tmp_path / "image.png")


class TestSizeAndTurn:
    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_as_opencv_decodes_it(self, tmp_path, suffix, orientation):
        path = tmp_path / f"turned{suffix}"
        Image.fromarray(texture(width=48, height=32)).save(path, exif=exif(orientation))
        expected = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image_size(path) == expected.shape[::-1] == ((32, 48) if orientation > 4 else (48, 32))
        assert np.abs(read_image(path).astype(int) - expected).max() <= (suffix == ".webp")
        small = read_image(path, 24)
        wanted = cv2.resize(expected, small.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(int) - wanted).mean() < 8

    @pytest.mark.parametrize("data", [b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\0" + b"\xff" * 9])
    def test_unreadable(self, tmp_path, data):
        (tmp_path / "broken.png").write_bytes(data)
        assert image_size(tmp_path / "broken.png") == (0, 0)
        with pytest.raises(FileNotFoundError, match=r"no image at .*a\.png"):
            image_size(tmp_path / "a.png")

    def test_large_image_is_no_reason_to_warn(self, tmp_path):
        (tmp_path / "large.pgm").write_bytes(b"P5\n10000 10000\n255\n")
        assert image_size(tmp_path / "large.pgm") == (10000, 10000)


class TestMaxSize:
    @pytest.mark.parametrize("suffix", [".jpg", ".png"])
    def test_points_follow(self, tmp_path, suffix):
        """Also where an eighth, a quarter and half of a JPEG's size are no whole numbers."""
        grid = np.stack(np.meshgrid(np.arange(60, 1141, 110), np.arange(60, 843, 110)), -1).reshape(-1, 2)
        centres = grid + np.random.default_rng(0).uniform(-0.5, 0.5, grid.shape)
        Image.fromarray(blobs(centres, 1201, 903, width_of_blob=8.0)).save(tmp_path / f"a{suffix}", quality=95)
        for max_size in (2000, 1201, 1200, 1000, 801, 600, 333, 299, 150):
            read = read_image(tmp_path / f"a{suffix}", max_size)
            size = read.shape[::-1]
            assert size == reduced_size((1201, 903), max_size)
            wanted = scale_points(centres, image_size(tmp_path / f"a{suffix}"), size)
            found = centroids(read, wanted, max(2, round(45 * size[0] / 1201)), floor=2)
            assert np.abs(found - wanted).max() < 0.03

    @pytest.mark.parametrize("mode", ["LA", "P", "RGBA"])
    def test_modes(self, tmp_path, mode):
        Image.fromarray(COLOURS).convert(mode).save(tmp_path / "a.tif")
        for read in (read_image, read_colour):
            full, small = read(tmp_path / "a.tif"), read(tmp_path / "a.tif", 120)
            wanted = cv2.resize(full, (120, 90), interpolation=cv2.INTER_AREA)
            assert np.abs(small.astype(int) - wanted).mean() < (8 if mode == "P" else 3)  # dithered

    def test_arrays_as_files(self, tmp_path):
        Image.fromarray(COLOURS).save(tmp_path / "a.png")
        assert np.array_equal(resize_image(COLOURS, 100), read_colour(tmp_path / "a.png", 100))
        assert resize_image(COLOURS, 240) is COLOURS
        assert resize_image(texture(), 60).shape == (45, 60)
        with pytest.raises(ValueError, match=r"max_size must be a number of pixels, 1 or more, .* got 0"):
            read_image(tmp_path / "a.png", 0)

    @given(size=SIZES, max_size=st.integers(1, 10000))
    def test_sizes(self, size, max_size):
        reduced = reduced_size(size, max_size)
        assert max(reduced) == min(max(size), max_size)
        assert min(reduced) >= 1
        wanted = np.array(size) * max(reduced) / max(size)
        assert np.abs(np.maximum(wanted, 1) - reduced).max() <= 0.5

    @pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="there is no /proc")
    def test_memory_of_a_large_jpeg(self, tmp_path):
        """8,000 x 6,000 pixels take less memory than their grey values would."""
        Image.new("L", (8000, 6000), 90).save(tmp_path / "large.jpg")
        program = """
import re, sys
from pathlib import Path
from kornia_learnnorm.data.images import read_image
import PIL.Image
peak = lambda: int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024
before = peak()
assert read_image(sys.argv[1], 2000).shape == (1500, 2000)
print(peak() - before)
"""
        run = [sys.executable, "-c", program, str(tmp_path / "large.jpg")]
        assert float(subprocess.run(run, capture_output=True, text=True, check=True).stdout) < 8000 * 6000 / 2**20


class TestScaling:
    def test_against_corners(self):
        """The outer corners of the image stay where they are: -0.5 and the size less 0.5."""
        corners = np.array([[-0.5, -0.5], [1000.5, 600.5]])
        assert np.allclose(scale_points(corners, (1001, 601), (333, 200)), [[-0.5, -0.5], [332.5, 199.5]], atol=1e-12)

    @given(size=SIZES, other=SIZES, point=st.tuples(st.floats(-1e4, 3e4), st.floats(-1e4, 3e4)))
    def test_there_and_back(self, size, other, point):
        points = np.array([point])
        there = scale_points(points, size, other)
        assert np.allclose(np.append(points, 1) @ scaling(size, other).numpy().T, np.append(there, 1), rtol=1e-9)
        assert np.allclose(scale_points(there, other, size), points, rtol=1e-9, atol=1e-6)

    @pytest.mark.parametrize("sizes", [((0, 0), (3, 4)), ((3, 4), (3, 0))])
    def test_no_size(self, sizes):
        with pytest.raises(ValueError, match=r"a positive width and height, got .*0\)"):
            scaling(*sizes)

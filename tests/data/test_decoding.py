"""Images of every kind of pixel as eight bits, and reduced ones."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import texture

from kornia_learnnorm.data.decoding import reduced_size
from kornia_learnnorm.data.images import image_size, read_colour, read_image, resize_image, scale_points

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

COLOURS = np.stack([texture(seed) for seed in range(3)], -1)


def exif(orientation: int) -> bytes:
    data = Image.Exif()
    data[0x0112] = orientation
    return data.tobytes()


def tiff(values: np.ndarray, orientation: int = 1, photometric: int = 2) -> bytes:
    """An uncompressed TIFF of unsigned 16-bit values, which Pillow cannot write in colour."""
    height, width, channels = values.shape
    bits, pixels = 8 + 2 + 10 * 12 + 4, 8 + 2 + 10 * 12 + 4 + 8
    tags = [
        (256, 4, 1, width), (257, 4, 1, height), (258, 3, channels, bits if channels > 2 else 16), (259, 3, 1, 1),
        (262, 3, 1, photometric), (273, 4, 1, pixels), (274, 3, 1, orientation), (277, 3, 1, channels),
        (278, 4, 1, height), (279, 4, 1, values.size * 2),
    ]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    head = b"II*\0" + struct.pack("<IH", 8, 10) + entries + bytes(4)
    return head + struct.pack("<4H", 16, 16, 16, 16) + values.astype("<u2").tobytes()


class TestDepth:
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
    @pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
    def test_grey(self, tmp_path, suffix, bits):
        values = np.arange(2**bits, dtype=np.uint16).reshape(-1, 16)
        cv2.imwrite(str(tmp_path / f"a{suffix}"), values)
        assert np.array_equal(read_image(tmp_path / f"a{suffix}"), values // 2 ** (bits - 8))

    @pytest.mark.parametrize("suffix", [".png", ".tif"])
    @pytest.mark.parametrize("alpha", [False, True])
    @pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
    def test_colour(self, tmp_path, suffix, alpha, bits):
        values = np.random.default_rng(0).integers(0, 2**bits, (20, 30, 3)).astype(np.uint16)
        values[0, 0, 0] = 2**bits - 1
        stored = np.dstack([values, np.full((20, 30), 0xFFFF, np.uint16)]) if alpha else values
        cv2.imwrite(str(tmp_path / f"a{suffix}"), stored)
        assert np.array_equal(read_colour(tmp_path / f"a{suffix}")[..., ::-1], values >> (bits - 8))

    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_colour_is_turned(self, tmp_path, orientation):
        values = np.random.default_rng(0).integers(0, 4096, (20, 30, 3)).astype(np.uint16)
        values[0, 0, 0] = 4095
        Image.fromarray(np.asarray(values >> 4, np.uint8)).save(tmp_path / "eight.png", exif=exif(orientation))
        (tmp_path / "a.tif").write_bytes(tiff(values, orientation))
        wanted = cv2.imread(str(tmp_path / "eight.png"))[..., ::-1]
        assert np.array_equal(read_colour(tmp_path / "a.tif"), wanted)

    def test_declared_depth_of_pgm(self, tmp_path):
        values = np.array([[0, 800, 1600, 4095]], ">u2")
        (tmp_path / "a.pgm").write_bytes(b"P5\n4 1\n4095\n" + values.tobytes())
        assert read_image(tmp_path / "a.pgm").tolist() == [[0, 50, 100, 255]]

    @pytest.mark.parametrize("bits", [12, 16])
    def test_white_is_zero(self, tmp_path, bits):
        values = np.array([[[0], [2**bits // 2], [2**bits - 1]]], np.uint16)
        (tmp_path / "a.tif").write_bytes(tiff(values, photometric=0))
        assert read_image(tmp_path / "a.tif").tolist() == [[255, 127, 0]]

    @pytest.mark.parametrize(
        ("values", "message"),
        [
            (np.array([[-5, 70]], np.int16), "go from -5 to 70, expected 0 to 65535"),
            (np.array([[0, 70000]], np.int32), "go from 0 to 70000, expected 0 to 65535"),
        ],
    )
    def test_out_of_range(self, tmp_path, values, message):
        cv2.imwrite(str(tmp_path / "a.tif"), values)
        with pytest.raises(ValueError, match=rf"a\.tif cannot be used: its grey values {message}"):
            read_image(tmp_path / "a.tif")


class TestFloats:
    @pytest.mark.parametrize(
        ("values", "expected"),
        [
            ([0.0, 0.25, 0.5, 1.0], [0, 64, 128, 255]),  # times 255
            ([0.0, 1.4, 127.6, 255.0], [0, 1, 128, 255]),  # rounded
            ([-1.0, 0.0, 1.0, 4.0], [0, 51, 102, 255]),  # from the minimum to the maximum
            ([100.0, 200.0, 300.0, 350.0], [0, 102, 204, 255]),
            ([-3e38, 0.0, 0.0, 3e38], [0, 128, 128, 255]),
            ([-2.0] * 4, [0] * 4),
            ([0.0] * 4, [0] * 4),
        ],
    )
    def test_ranges(self, tmp_path, values, expected):
        Image.fromarray(np.array([values], np.float32)).save(tmp_path / "a.tif")
        assert read_image(tmp_path / "a.tif").tolist() == [expected]
        assert read_colour(tmp_path / "a.tif").tolist() == [[[value] * 3 for value in expected]]

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_not_finite(self, tmp_path, value):
        Image.fromarray(np.array([[0.1, value, value, 1.0]], np.float32)).save(tmp_path / "a.tif")
        with pytest.raises(ValueError, match=r"a\.tif cannot be used: 2 of its 4 .* pixels are NaN or infinite"):
            read_image(tmp_path / "a.tif")

    def test_colours_are_refused(self, tmp_path):
        cv2.imwrite(str(tmp_path / "a.tif"), COLOURS.astype(np.float32))
        with pytest.raises(ValueError, match="pixels that Pillow does not read, such as colours of floating-point"):
            read_image(tmp_path / "a.tif")


class TestAlpha:
    @pytest.mark.parametrize("mode", ["LA", "RGBA"])
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
    def test_composited_over_black(self, tmp_path, mode, suffix):
        colours = Image.fromarray(COLOURS).convert(mode[:-1])
        alpha = texture(3)
        colours.putalpha(Image.fromarray(alpha))
        colours.save(tmp_path / f"a{suffix}", **({"lossless": True, "exact": True} if suffix == ".webp" else {}))
        wanted = np.asarray(colours.convert("RGB")) * (alpha / 255.0)[..., None]
        assert np.abs(read_colour(tmp_path / f"a{suffix}") - wanted).max() <= 0.51
        grey = cv2.cvtColor(wanted.astype(np.float32), cv2.COLOR_RGB2GRAY)
        assert np.abs(read_image(tmp_path / f"a{suffix}") - grey).max() <= 1.5

    @pytest.mark.parametrize(
        ("image", "key"),
        [
            (np.array([[7, 9]], np.uint8), 7),
            (np.array([[1, 3]], np.uint8), b"\0"),  # a palette; alpha of its first colour
            (np.array([[[7, 8, 9], [9, 9, 9]]], np.uint8), (7, 8, 9)),
            (np.array([[0x1234, 0xFFFF]], np.uint16), 0x1234),
        ],
    )
    def test_transparent_colour(self, tmp_path, image, key):
        image = Image.fromarray(image)
        if isinstance(key, bytes):
            image = image.quantize(2)
            key = bytes([0, 255]) if image.getpixel((0, 0)) == 0 else bytes([255, 0])
        image.save(tmp_path / "a.png", transparency=key)
        grey = read_image(tmp_path / "a.png")
        assert grey[0, 0] == 0 < grey[0, 1]

    def test_transparent_colour_of_sixteen_bits_has_no_effect(self, tmp_path):
        values = np.full((2, 2, 3), 0x0912, np.uint16)
        data = cv2.imencode(".png", values)[1].tobytes()
        Image.new("RGB", (2, 2)).save(tmp_path / "b.png", transparency=(9, 0, 0))
        chunk = (tmp_path / "b.png").read_bytes()
        start = chunk.index(b"tRNS") - 4
        end = data.index(b"IDAT") - 4
        (tmp_path / "a.png").write_bytes(data[:end] + chunk[start : start + 18] + data[end:])
        assert (read_colour(tmp_path / "a.png") == 0x0912 >> 4).all()


class TestColours:
    def test_cmyk_of_adobe(self, tmp_path):
        Image.fromarray(COLOURS).convert("CMYK").save(tmp_path / "a.jpg", quality=98)
        read = read_colour(tmp_path / "a.jpg").astype(int)
        assert np.abs(read - cv2.imread(str(tmp_path / "a.jpg"))[..., ::-1]).max() <= 2
        assert np.abs(read - COLOURS).mean() < 3
        grey = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_GRAYSCALE)
        assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - grey).max() <= 2

    def test_cmyk_in_a_tiff(self, tmp_path):
        Image.fromarray(COLOURS).convert("CMYK").save(tmp_path / "a.tif")
        assert np.array_equal(read_colour(tmp_path / "a.tif"), COLOURS)

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp"])
    def test_as_opencv_reads_them(self, tmp_path, suffix):
        Image.fromarray(COLOURS).save(tmp_path / f"a{suffix}")
        wanted = cv2.imread(str(tmp_path / f"a{suffix}"))[..., ::-1]
        assert np.abs(read_colour(tmp_path / f"a{suffix}").astype(int) - wanted).max() <= (suffix == ".jpg")

    @pytest.mark.parametrize("mode", ["1", "L", "P"])
    def test_grey_and_palettes(self, tmp_path, mode):
        image = Image.fromarray(texture()).convert(mode)
        image.save(tmp_path / "a.png")
        assert np.array_equal(read_colour(tmp_path / "a.png"), np.asarray(image.convert("RGB")))

    @pytest.mark.parametrize("suffix", [".gif", ".png", ".tif", ".webp"])
    def test_first_frame_of_several(self, tmp_path, suffix):
        first, second = (Image.fromarray(texture(seed)) for seed in (0, 1))
        exact = {"lossless": True} if suffix == ".webp" else {}
        first.save(tmp_path / f"a{suffix}", save_all=True, append_images=[second], **exact)
        with Image.open(tmp_path / f"a{suffix}") as image:
            assert image.n_frames == 2
        assert np.array_equal(read_image(tmp_path / f"a{suffix}"), texture(0))

    def test_lab_is_refused(self, tmp_path):
        Image.fromarray(COLOURS).convert("LAB").save(tmp_path / "a.tif")
        with pytest.raises(ValueError, match=r"cannot be used: its pixels are of the kind LAB, expected grey, RGB"):
            read_image(tmp_path / "a.tif")


def blobs(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Smooth bright blobs on a grid, and their centres (x, y), which are no whole pixels."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(60, width - 60, 110), np.arange(60, height - 60, 110)), -1).reshape(-1, 2)
    centres = grid + rng.uniform(-0.5, 0.5, grid.shape)
    y, x = np.ogrid[:height, :width]
    image = sum(np.exp(-((x - cx) ** 2) / 128) * np.exp(-((y - cy) ** 2) / 128) for cx, cy in centres)
    return np.round(image * 250).astype(np.uint8), centres


def centroids(image: np.ndarray, near: np.ndarray, reach: int) -> np.ndarray:
    """Centre of mass of the grey values about each of some pixels."""
    found = []
    for cx, cy in np.round(near).astype(int):
        y, x = np.mgrid[cy - reach : cy + reach + 1, cx - reach : cx + reach + 1]
        mass = image[cy - reach : cy + reach + 1, cx - reach : cx + reach + 1].astype(float).clip(2) - 2
        found.append([(mass * x).sum() / mass.sum(), (mass * y).sum() / mass.sum()])
    return np.array(found)


class TestMaxSize:
    @pytest.mark.parametrize("suffix", [".jpg", ".png"])
    @pytest.mark.parametrize("max_size", [2000, 1201, 1200, 1000, 801, 600, 333, 299, 150])
    def test_points_follow(self, tmp_path, suffix, max_size):
        """Also where an eighth, a quarter and half of a JPEG's size are no whole numbers."""
        image, centres = blobs(1201, 903)
        Image.fromarray(image).save(tmp_path / f"a{suffix}", quality=95)
        read = read_image(tmp_path / f"a{suffix}", max_size)
        size = read.shape[::-1]
        assert size == reduced_size((1201, 903), max_size)
        wanted = scale_points(centres, image_size(tmp_path / f"a{suffix}"), size)
        found = centroids(read, wanted, max(2, round(45 * size[0] / 1201)))
        assert np.abs(found - wanted).max() < 0.03

    def test_nothing_changes_within_the_limit(self, tmp_path):
        for suffix in (".jpg", ".png"):
            Image.fromarray(COLOURS).save(tmp_path / f"a{suffix}")
            for read in (read_image, read_colour):
                assert np.array_equal(read(tmp_path / f"a{suffix}", 240), read(tmp_path / f"a{suffix}"))

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
    @pytest.mark.parametrize("orientation", [1, 3, 6, 7])
    def test_turned(self, tmp_path, suffix, orientation):
        Image.fromarray(COLOURS).save(tmp_path / f"a{suffix}", exif=exif(orientation))
        size = (75, 100) if orientation > 4 else (100, 75)
        full, small = read_colour(tmp_path / f"a{suffix}"), read_colour(tmp_path / f"a{suffix}", 100)
        assert small.shape == (*size[::-1], 3)
        wanted = cv2.resize(full, size, interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(int) - wanted).mean() < 4

    @pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "I;16", "F"])
    def test_modes(self, tmp_path, mode):
        image = Image.fromarray(COLOURS)
        if mode == "I;16":
            image = Image.fromarray(texture().astype(np.uint16) * 257)
        (image if mode == "I;16" else image.convert(mode)).save(tmp_path / "a.tif")
        for read in (read_image, read_colour):
            full, small = read(tmp_path / "a.tif"), read(tmp_path / "a.tif", 120)
            assert small.shape[:2] == (90, 120)
            wanted = cv2.resize(full, (120, 90), interpolation=cv2.INTER_AREA)
            assert np.abs(small.astype(int) - wanted).mean() < {"1": 20, "P": 8}.get(mode, 3)  # dithered

    def test_arrays_as_files(self, tmp_path):
        Image.fromarray(COLOURS).save(tmp_path / "a.png")
        assert np.array_equal(resize_image(COLOURS, 100), read_colour(tmp_path / "a.png", 100))
        assert resize_image(COLOURS, 240) is COLOURS
        assert resize_image(texture(), 60).shape == (45, 60)

    @given(size=st.tuples(st.integers(1, 30000), st.integers(1, 30000)), max_size=st.integers(1, 10000))
    def test_sizes(self, size, max_size):
        reduced = reduced_size(size, max_size)
        assert max(reduced) == min(max(size), max_size)
        assert min(reduced) >= 1
        wanted = np.array(size) * max(reduced) / max(size)
        assert np.abs(np.maximum(wanted, 1) - reduced).max() <= 0.5

    @pytest.mark.parametrize("max_size", [0, -1])
    def test_no_size(self, tmp_path, max_size):
        Image.fromarray(COLOURS).save(tmp_path / "a.png")
        with pytest.raises(ValueError, match=rf"max_size must be a number of pixels, 1 or more, .* got {max_size}"):
            read_image(tmp_path / "a.png", max_size)

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

"""Reading images, and frames as they are matched."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import texture

from kornia_learnnorm.data import decoding
from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.images import (
    content_mask,
    image_size,
    read_frame,
    read_image,
    read_mask,
    scale_points,
    scaling,
)
from kornia_learnnorm.geometry.transforms import transform_fundamental

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

CAMERA = np.array([[250.0, 0, 119.0], [0, 245.0, 92.0], [0, 0, 1]])
DISTORTION = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)  # of the benchmark's first Kinect


def blobs(centres: np.ndarray, width: int = 240, height: int = 180) -> np.ndarray:
    """A smooth bright blob about each centre (x, y)."""
    y, x = np.mgrid[:height, :width]
    image = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 18.0) for cx, cy in centres)
    return np.round(np.clip(image, 0, 1) * 250).astype(np.uint8)


def centroids(image: np.ndarray, near: np.ndarray, reach: int = 14) -> np.ndarray:
    """Centre of mass of the grey values about each of some pixels."""
    found = []
    for cx, cy in np.round(near).astype(int):
        y, x = np.mgrid[cy - reach : cy + reach + 1, cx - reach : cx + reach + 1]
        mass = image[cy - reach : cy + reach + 1, cx - reach : cx + reach + 1].astype(float)
        found.append([(mass * x).sum() / mass.sum(), (mass * y).sum() / mass.sum()])
    return np.array(found)


def frame_of(path: Path, image: np.ndarray, **known) -> Frame:
    cv2.imwrite(str(path), image)
    return Frame(path, path.name, "", image.shape[::-1], **known)


class TestReadImage:
    def test_grey_values_survive(self, tmp_path):
        image = texture()
        path = tmp_path / "näme with spaces.png"
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        assert np.array_equal(read_image(path), image)
        assert np.array_equal(read_image(str(path)), image)

    def test_not_a_file(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"nothing\.png does not exist"):
            read_image(tmp_path / "nothing.png")
        with pytest.raises(ValueError, match="is a folder"):
            read_image(tmp_path)

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("empty.png", lambda data: b"", r"empty\.png is empty"),
            ("text.png", lambda data: b"hello", "5 bytes, not an image of a kind that Pillow reads"),
            ("text.tif", lambda data: b"II*\0hello", "a corrupt TIFF"),
            ("half.png", lambda data: data[: len(data) // 2], "truncated"),
            ("half.jpg", lambda data: data[: len(data) // 2], "truncated"),
            ("half.bmp", lambda data: data[: len(data) // 2], "truncated"),
            ("hole.png", lambda data: data[: len(data) // 2] + bytes(50) + data[len(data) // 2 + 50 :], "corrupt"),
        ],
    )
    def test_broken(self, tmp_path, name, change, message):
        (tmp_path / name).write_bytes(change(cv2.imencode(name[-4:], texture())[1].tobytes()))
        with pytest.raises(ValueError, match=message) as caught:
            read_image(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert "<_io" not in str(caught.value)

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
        monkeypatch.setattr(decoding, "open_image", fail)
        with pytest.raises(ValueError, match=message):
            read_image(tmp_path / "a.png")

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

    @pytest.mark.parametrize(
        ("mode", "suffix", "limit"),
        [(mode, *kind) for mode in ("RGB", "RGBA", "P", "LA", "1") for kind in ((".png", 0), (".tif", 1))]
        + [("RGB", ".jpg", 0)],
    )
    def test_modes_as_opencv_converts_them(self, tmp_path, mode, suffix, limit):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(np.stack([texture(seed) for seed in range(3)], -1)).convert(mode).save(path)
        image, expected = read_image(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image.dtype == np.uint8
        assert np.abs(image.astype(int) - expected).max() <= limit

    @pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
    def test_sixteen_bits_keep_the_upper_eight(self, tmp_path, suffix):
        deep = np.array([[0, 0xFF, 0x100, 0x80FF, 0xFFFF]], np.uint16)
        cv2.imwrite(str(tmp_path / f"deep{suffix}"), deep)
        assert read_image(tmp_path / f"deep{suffix}").tolist() == [[0, 0, 1, 0x80, 0xFF]]

    def test_without_pillow(self, tmp_path, monkeypatch):
        cv2.imwrite(str(tmp_path / "image.png"), texture())
        monkeypatch.setitem(sys.modules, "PIL.Image", None)
        for read in (read_image, image_size):
            with pytest.raises(ImportError, match=r"pip install '\.\[images\]'"):
                read(tmp_path / "image.png")

    @pytest.mark.parametrize("folder", ["kitti/sequences/06/image_0", "tum"])
    def test_real_images_as_opencv_reads_them(self, real_data, folder):
        for path in sorted((real_data / folder).rglob("*.png"))[:3]:
            assert np.array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


class TestImageSize:
    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm"])
    def test_formats(self, tmp_path, suffix):
        Image.new("L", (31, 17)).save(tmp_path / f"a{suffix}")
        assert image_size(tmp_path / f"a{suffix}") == image_size(str(tmp_path / f"a{suffix}")) == (31, 17)

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_orientation_as_opencv_decodes_it(self, tmp_path, suffix, orientation):
        exif = Image.Exif()
        exif[0x0112] = orientation
        path = tmp_path / f"turned{suffix}"
        Image.fromarray(texture(width=48, height=32)).save(path, exif=exif)
        expected = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image_size(path) == expected.shape[::-1] == ((32, 48) if orientation > 4 else (48, 32))
        assert np.abs(read_image(path).astype(int) - expected).max() <= (suffix == ".webp")

    @pytest.mark.parametrize(
        "data", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"P5\n-1 x", b"II*\0" + b"\xff" * 9]
    )
    def test_unreadable(self, tmp_path, data):
        (tmp_path / "broken.png").write_bytes(data)
        assert image_size(tmp_path / "broken.png") == (0, 0)

    def test_large_image_is_no_reason_to_warn(self, tmp_path):
        path = tmp_path / "large.pgm"
        path.write_bytes(b"P5\n10000 10000\n255\n")
        assert image_size(path) == (10000, 10000)

    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"no image at .*a\.png"):
            image_size(tmp_path / "a.png")
        with pytest.raises(FileNotFoundError):
            image_size(tmp_path)


class TestScale:
    SIZES = st.tuples(st.integers(1, 20000), st.integers(1, 20000))

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

    def test_fundamental_matrix_of_the_full_images(self):
        rng = np.random.default_rng(0)
        full, small = ((4001, 2999), (3000, 2000)), ((1000, 750), (999, 666))
        F_small = torch.from_numpy(rng.normal(size=(3, 3)))
        F_full = transform_fundamental(F_small, *(scaling(*sizes) for sizes in zip(full, small, strict=True)))
        points = [rng.uniform(0, 2000, (20, 2)) for _ in range(2)]
        reduced = [scale_points(p, *sizes) for p, *sizes in zip(points, full, small, strict=True)]
        # the values of the bilinear form, coordinate by coordinate
        before, after = (
            np.einsum("ni,ij,nj->n", np.c_[p2, np.ones(20)], F.numpy(), np.c_[p1, np.ones(20)])
            for (p1, p2), F in ((points, F_full), (reduced, F_small))
        )
        assert np.allclose(before, after)

    @pytest.mark.parametrize("sizes", [((0, 0), (3, 4)), ((3, 4), (3, 0))])
    def test_no_size(self, sizes):
        with pytest.raises(ValueError, match=r"a positive width and height, got .*0\)"):
            scaling(*sizes)


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

    @pytest.mark.parametrize("image", [texture(), np.zeros((20, 30), np.uint8), np.full((20, 30), 255, np.uint8)])
    def test_no_frame(self, image):
        assert content_mask(image) is None

    def test_black_inside(self):
        image = np.full((20, 30), 90, np.uint8)
        image[8:12], image[:, 5:9] = 0, 0
        assert content_mask(image) is None

    @pytest.mark.parametrize(
        ("image", "error", "message"),
        [
            (np.zeros((4, 5)), TypeError, "array of uint8, got float64"),
            (np.zeros((4, 5, 3), np.uint8), ValueError, r"must be grey .* got \(4, 5, 3\)"),
            (np.zeros((0, 5), np.uint8), ValueError, r"got \(0, 5\)"),
        ],
    )
    def test_wrong_arguments(self, image, error, message):
        with pytest.raises(error, match=message):
            content_mask(image)


class TestReadMask:
    def test_pixels_above_half_count(self, tmp_path):
        cv2.imwrite(str(tmp_path / "m.png"), np.array([[0, 1, 127], [128, 254, 255]], np.uint8))
        mask = read_mask(tmp_path / "m.png", (3, 2))
        assert mask.dtype == bool
        assert mask.tolist() == [[False, False, False], [True, True, True]]

    @pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA"])
    def test_modes(self, tmp_path, mode):
        wanted = texture() > 127
        Image.fromarray(wanted).convert(mode).save(tmp_path / "m.png")
        assert np.array_equal(read_mask(tmp_path / "m.png", (240, 180)), wanted)

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
            (np.ones((4, 5), np.uint8), (5, 4), r"m\.png has no pixel above 127, its largest value is 1"),
        ],
    )
    def test_wrong(self, tmp_path, mask, size, message):
        cv2.imwrite(str(tmp_path / "m.png"), mask)
        with pytest.raises(ValueError, match=message):
            read_mask(tmp_path / "m.png", size)
        with pytest.raises(FileNotFoundError, match=r"^mask .*none\.png does not exist"):
            read_mask(tmp_path / "none.png", size)
        with pytest.raises(ValueError, match=r"^mask .* is a folder"):
            read_mask(tmp_path, size)


class TestReadFrame:
    GRID = np.stack(np.meshgrid(np.arange(40.0, 210, 40), np.arange(40.0, 150, 33)), -1).reshape(-1, 2)

    def test_as_it_is(self, tmp_path):
        image = texture()
        assert np.array_equal(read_frame(frame_of(tmp_path / "a.png", image)), image)

    def test_undistortion_moves_points_as_opencv_says(self, tmp_path):
        frame = frame_of(tmp_path / "a.png", blobs(self.GRID), camera=CAMERA, distortion=DISTORTION)
        want = cv2.undistortPoints(self.GRID[:, None], CAMERA, np.array(DISTORTION), P=CAMERA)[:, 0]
        assert np.abs(want - self.GRID).max() > 1  # there is something to undistort
        assert np.abs(centroids(read_frame(frame), want) - want).max() < 0.1

    @pytest.mark.parametrize("size", [(120, 90), (180, 135), (360, 270), (320, 180)])
    def test_resizing_agrees_with_the_camera(self, tmp_path, size):
        frame = replace(frame_of(tmp_path / "a.png", blobs(self.GRID), camera=CAMERA), resized=size)
        image = read_frame(frame)
        assert image.shape == size[::-1]
        rays = np.linalg.solve(CAMERA, np.column_stack([self.GRID, np.ones(len(self.GRID))]).T)
        want = (frame.K @ rays)[:2].T
        reach = int(14 * max(size[0] / 240, size[1] / 180))
        assert np.abs(centroids(image, want, reach) - want).max() < 0.05

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"size": (640, 480)}, r"a\.png has 240 x 180 pixels, its camera 640 x 480"),
            ({"distortion": DISTORTION}, "a distortion, but no camera matrix"),
        ],
    )
    def test_does_not_fit_its_camera(self, tmp_path, change, message):
        with pytest.raises(ValueError, match=message):
            read_frame(replace(frame_of(tmp_path / "a.png", texture()), **change))

"""Reading images, and frames as they are matched."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from make_sequences import texture

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.images import image_size, read_frame, read_image

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
            ("text.png", lambda data: b"hello", "not an image"),
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

    def test_floating_point(self, tmp_path):
        Image.fromarray(np.zeros((3, 4), np.float32)).save(tmp_path / "float.tif")
        with pytest.raises(ValueError, match=r"float\.tif .*floating-point numbers, expected 8 or 16 bits"):
            read_image(tmp_path / "float.tif")

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

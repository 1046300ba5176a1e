import shutil
from itertools import combinations

import numpy as np
import pytest
from make_sequences import SIZE, names
from scenes import raises

from kornia_learnnorm.data.datasets.colmap import read_colmap
from kornia_learnnorm.data.datasets.pairing import covisible_pairs

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")


def read(folder):
    return read_colmap(folder / "model", folder / "images")


def set_camera(folder, camera: str) -> None:
    (folder / "model" / "cameras.txt").write_text(f"1 {camera}\n")


class TestReadColmap:
    def test_binary_model(self, written, tmp_path):
        model = written / "colmap"
        pycolmap.Reconstruction(str(model / "model")).write_binary(str(tmp_path))
        for text, binary in zip(read(model), read_colmap(str(tmp_path), str(model / "images")), strict=True):
            assert text.name == binary.name
            assert np.array_equal(text.K, binary.K)
            assert np.array_equal(text.pose, binary.pose)

    def test_projection_is_that_of_colmap(self, colmap):
        cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
        for camera, distortion in [
            ("PINHOLE 160 120 130 131 80 60", ()),
            ("SIMPLE_RADIAL 160 120 130 80 60 0.1", (0.1, 0, 0, 0)),
            ("OPENCV 160 120 130 131 80 60 0.1 -0.02 0.003 -0.004", (0.1, -0.02, 0.003, -0.004)),
        ]:
            set_camera(colmap, camera)
            frame = read(colmap)[3]
            assert frame.distortion == distortion
            image = pycolmap.Reconstruction(str(colmap / "model")).find_image_with_name(frame.name)
            points = np.array([[0.1, -0.3, 4.0], [1.0, 1.0, 3.0], [-0.5, 0.8, 2.5]])
            expected = np.array([image.project_point(point) for point in points]) - 0.5
            in_camera = (np.linalg.inv(frame.pose) @ np.column_stack([points, np.ones(3)]).T)[:3].T
            coefficients = np.array(distortion, float) if distortion else None
            pixels = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), frame.K, coefficients)[0][:, 0]
            assert np.allclose(pixels, expected, atol=1e-6)

    def test_wrong_camera(self, colmap):
        for camera, message in [
            ("OPENCV_FISHEYE 160 120 130 130 80 60 0 0 0 0", r"one/0\.png must be one of .* got OPENCV_FISHEYE"),
            ("PINHOLE 320 240 130 130 160 120", r"0\.png must have its camera's size, 320 x 240 .* got 160 x 120"),
        ]:
            set_camera(colmap, camera)
            raises(ValueError, message, read, colmap)

    def test_missing_and_unreadable_files(self, colmap):
        (colmap / "images/one/1.png").write_bytes(b"")
        assert [frame.size for frame in read(colmap)] == [SIZE, (0, 0), SIZE, SIZE]
        shutil.rmtree(colmap / "images/two")
        raises(FileNotFoundError, r"2 of 4 images are not in .*images, the first is two/2\.png", read, colmap)
        (colmap / "model" / "points3D.txt").unlink()
        raises(FileNotFoundError, r"no COLMAP model at .*model: it lacks points3D\.bin or", read, colmap)

    @pytest.mark.parametrize(("name", "text"), [("cameras", "hello\n"), ("points3D", "1 0 0 1 0 0 0 0.5 77 0 2 9\n")])
    def test_malformed(self, colmap, name, text):
        (colmap / "model" / f"{name}.txt").write_text(text)
        raises(ValueError, r"the COLMAP model .*model cannot be read: ", read, colmap)


class TestCovisiblePairs:
    @pytest.mark.parametrize("min_points", [1, 88, 96, 97])
    def test_common_points(self, written, min_points):
        model = written / "colmap"
        lines = (model / "model" / "images.txt").read_text().splitlines()[1:]
        points = [set(line.split()[2::3]) - {"-1"} for line in lines[1::2]]
        seen = dict(zip([line.split()[-1] for line in lines[::2]], points, strict=True))
        expected = [(a, b) for a, b in combinations(sorted(seen), 2) if len(seen[a] & seen[b]) >= min_points]
        assert names(covisible_pairs(model / "model", read(model), min_points)) == expected

    def test_errors(self, colmap):
        frames = read(colmap)
        raises(ValueError, "at least 1 point, got min_points 0", list, covisible_pairs(colmap / "model", frames, 0))
        path = colmap / "model" / "images.txt"
        path.write_text(path.read_text().replace("one/0.png", "one/9.png"))
        with pytest.raises(ValueError, match=r"no image 'one/0\.png' among the 4 of the model"):
            list(covisible_pairs(colmap / "model", frames))

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import blobs, centroids, texture
from scenes import raises

from kornia_learnnorm.data.datasets.frames import Frame, FramePair, read_frame, resize_frames

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")

CAMERA = np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])
SMALL_CAMERA = np.array([[250.0, 0, 119.0], [0, 245.0, 92.0], [0, 0, 1]])
DISTORTION = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)  # of the benchmark's first Kinect
NO_POSE = np.full((4, 4), np.nan)
SEEDS = st.integers(0, 2**32 - 1)


def rigid(rng: np.random.Generator) -> np.ndarray:
    """A random rotation and translation, (4, 4)."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Q * np.linalg.det(Q), rng.normal(size=3)
    return pose


def random_pair(seed: int) -> FramePair:
    rng = np.random.default_rng(seed)
    return FramePair(*(Frame(Path("a"), "a", "", (640, 480), CAMERA, rigid(rng)) for _ in range(2)))


class TestFramePair:
    @given(seed=SEEDS)
    def test_motion_takes_points_of_the_first_camera_to_the_second(self, seed):
        pair, world = random_pair(seed), np.array([0.3, -2.0, 5.0, 1.0])
        R, t = pair.motion
        first, second = (np.linalg.inv(f.pose) @ world for f in pair)
        assert np.allclose(R @ first[:3] + t, second[:3])
        assert np.allclose(R @ R.T, np.eye(3))

    @given(seed=SEEDS)
    def test_epipolar_constraint(self, seed):
        pair = random_pair(seed)
        world = np.column_stack([np.random.default_rng(0).normal(size=(20, 3)) * 5, np.ones(20)])  # of either depth
        x1, x2 = (x / x[:, 2:] for x in (world @ np.linalg.inv(f.pose)[:3].T @ f.K.T for f in pair))
        scale = np.linalg.norm(x1, axis=1) * np.linalg.norm(x2, axis=1)
        assert np.abs((x2 @ pair.F * x1).sum(1) / scale).max() < 1e-9
        assert np.linalg.norm(pair.F) == pytest.approx(1)
        assert abs(np.linalg.det(pair.F)) < 1e-12

    def test_unknown_and_a_camera_that_stands_still(self):
        pair = random_pair(0)
        for unknown in (replace(pair.frame2, camera=np.full((3, 3), np.nan)), replace(pair.frame1, pose=NO_POSE)):
            assert np.isnan(FramePair(pair.frame1, unknown).F).all()
        turned = replace(pair.frame2, pose=np.column_stack([pair.frame2.pose[:, :3], pair.frame1.pose[:, 3]]))
        for still in (pair.frame1, turned):
            assert np.isnan(FramePair(pair.frame1, still).F).all()


def frame_of(path: Path, image: np.ndarray, **known) -> Frame:
    cv2.imwrite(str(path), image)
    return Frame(path, path.name, "", image.shape[::-1], **known)


class TestReadFrame:
    GRID = np.stack(np.meshgrid(np.arange(40.0, 210, 40), np.arange(40.0, 150, 33)), -1).reshape(-1, 2)

    def test_undistortion_moves_points_as_opencv_says(self, tmp_path):
        frame = frame_of(tmp_path / "a.png", blobs(self.GRID), camera=SMALL_CAMERA, distortion=DISTORTION)
        want = cv2.undistortPoints(self.GRID[:, None], SMALL_CAMERA, np.array(DISTORTION), P=SMALL_CAMERA)[:, 0]
        assert np.abs(want - self.GRID).max() > 1  # there is something to undistort
        assert np.abs(centroids(read_frame(frame), want) - want).max() < 0.1

    @pytest.mark.parametrize("size", [(120, 90), (320, 180)])
    def test_resizing_agrees_with_the_camera(self, tmp_path, size):
        frame = replace(frame_of(tmp_path / "a.png", blobs(self.GRID), camera=SMALL_CAMERA), resized=size)
        image = read_frame(frame)
        assert image.shape == size[::-1]
        rays = np.linalg.solve(SMALL_CAMERA, np.column_stack([self.GRID, np.ones(len(self.GRID))]).T)
        want = (frame.K @ rays)[:2].T
        assert np.abs(centroids(image, want, int(14 * max(size[0] / 240, size[1] / 180))) - want).max() < 0.05

    def test_wrong_size_or_camera(self, tmp_path):
        raises(ValueError, "positive width and height, got 5 x -1", resize_frames, [], (5, -1))
        frame = frame_of(tmp_path / "a.png", texture())
        with pytest.raises(ValueError, match=r"a\.png has 240 x 180 pixels, its camera 640 x 480"):
            read_frame(replace(frame, size=(640, 480)))
        raises(ValueError, "a distortion, but no camera matrix", read_frame, replace(frame, distortion=DISTORTION))

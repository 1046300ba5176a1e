"""Readers of image sequences, against the layouts that tests/data/make_sequences.py writes and against real data."""

from __future__ import annotations

import os
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

from make_sequences import (  # noqa: E402
    FOCAL,
    FRAMES,
    KITTI_BASELINES,
    KITTI_K,
    LAYOUTS,
    SIZE,
    STEP,
    TUM_START,
    metres,
)

from kornia_learnnorm.data.datasets.cambridge import read_cambridge  # noqa: E402
from kornia_learnnorm.data.datasets.frames import FramePair, pair_frames  # noqa: E402
from kornia_learnnorm.data.datasets.sequences import SPLITS, read_folder, read_kitti, read_tum, split_sequences  # noqa: E402
from kornia_learnnorm.data.images import image_size  # noqa: E402

FR1, FR3 = "rgbd_dataset_freiburg1_wall", "rgbd_dataset_freiburg3_long_office_household"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """All layouts, not to be changed."""
    folder = tmp_path_factory.mktemp("sequences")
    for name, write in LAYOUTS.items():
        if name != "colmap":
            write(folder / name)
    return folder


@pytest.fixture
def kitti(written, tmp_path):
    return shutil.copytree(written / "kitti", tmp_path / "kitti")


@pytest.fixture
def tum(written, tmp_path):
    return shutil.copytree(written / "tum", tmp_path / "tum")


@pytest.fixture
def cambridge(written, tmp_path):
    return shutil.copytree(written / "cambridge", tmp_path / "Church")


def edit(path: Path, line: int, text: str | None) -> None:
    """Replace a line, counted from 1, or take it out."""
    lines = path.read_text().splitlines()
    lines[line - 1 : line] = [] if text is None else [text]
    path.write_text("".join(f"{one}\n" for one in lines))


def moved(pixels: float, focal: float = FOCAL) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = metres(pixels, focal)
    return pose


def rotated(wxyz: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (N, 3) by a unit quaternion: q v q*, with Hamilton's product."""

    def product(p, q):
        w = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdims=True)
        return np.concatenate(
            [w, p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])], -1
        )

    pure = np.column_stack([np.zeros(len(vectors)), vectors])
    return product(product(np.broadcast_to(wxyz, pure.shape), pure), (wxyz * [1, -1, -1, -1])[None])[:, 1:]


def epipoles_agree(pair: FramePair) -> bool:
    """The wall moves sideways only: with the true F, y stays and any shift in x is allowed."""
    x1 = np.array([[20.0, 30, 1], [90, 80, 1], [140, 10, 1]])
    x2 = x1 - np.array([STEP, 0, 0])
    return bool(np.abs((x2 @ pair.F * x1).sum(1)).max() < 1e-9)


class TestImageSize:
    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm"])
    def test_formats(self, tmp_path, suffix):
        Image.new("L", (31, 17)).save(tmp_path / f"a{suffix}")
        assert image_size(tmp_path / f"a{suffix}") == image_size(str(tmp_path / f"a{suffix}")) == (31, 17)

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_orientation_as_opencv_decodes_it(self, tmp_path, suffix, orientation):
        cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
        exif = Image.Exif()
        exif[0x0112] = orientation
        path = tmp_path / f"turned{suffix}"
        Image.new("L", (31, 17)).save(path, exif=exif)
        assert image_size(path) == cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE).shape[::-1]
        assert image_size(path) == ((17, 31) if orientation > 4 else (31, 17))

    @pytest.mark.parametrize(
        "data", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"P5\n-1 x", b"II*\0" + b"\xff" * 9]
    )
    def test_unreadable(self, tmp_path, data):
        (tmp_path / "broken.png").write_bytes(data)
        assert image_size(tmp_path / "broken.png") == (0, 0)

    @given(keep=st.integers(0, 60), where=st.integers(0, 59), value=st.integers(0, 255))
    def test_no_broken_header_raises(self, tmp_path_factory, keep, where, value):
        path = tmp_path_factory.getbasetemp() / "header.png"
        Image.new("L", (31, 17)).save(path)
        data = bytearray(path.read_bytes()[:keep])
        data[where : where + 1] = bytes([value])
        path.write_bytes(data)
        assert len(image_size(path)) == 2

    def test_large_image_is_no_reason_to_warn(self, tmp_path):
        path = tmp_path / "large.pgm"
        path.write_bytes(b"P5\n10000 10000\n255\n")
        assert image_size(path) == (10000, 10000)

    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"no image at .*a\.png"):
            image_size(tmp_path / "a.png")
        with pytest.raises(FileNotFoundError):
            image_size(tmp_path)

    def test_without_pillow(self, written, monkeypatch):
        monkeypatch.setitem(sys.modules, "PIL", None)
        with pytest.raises(ImportError, match=r"pip install 'kornia-learnnorm\[images\]'"):
            read_folder(written / "folder")


class TestKitti:
    def test_frames(self, written):
        frames = read_kitti(written / "kitti")
        assert [frame.sequence for frame in frames] == [s for s in ("00", "06", "11") for _ in range(FRAMES)]
        assert [frame.name for frame in frames[:2]] == [f"sequences/00/image_0/{n:06}.png" for n in range(2)]
        for frame in frames:
            assert frame.path == written / "kitti" / frame.name
            assert frame.size == SIZE
            assert frame.distortion == ()
            assert np.array_equal(frame.K, KITTI_K)

    def test_poses(self, written):
        frames = read_kitti(str(written / "kitti"), ["06", "11"])
        for number, frame in enumerate(frames[:FRAMES]):
            assert np.allclose(frame.pose, moved(STEP * number), atol=1e-8)
        assert all(np.isnan(frame.pose).all() for frame in frames[FRAMES:])

    @pytest.mark.parametrize("number", range(4))
    def test_other_cameras_stand_beside_the_first(self, written, number):
        frames = read_kitti(written / "kitti", ["00"], f"image_{number}")
        assert np.allclose(frames[1].pose, moved(STEP + KITTI_BASELINES[number]), atol=1e-8)

    def test_a_point_of_the_world_projects_through_every_camera(self, kitti):
        # From the definition: x_N = P_N X for X in camera 0, with any fourth column and any pose.
        rng = np.random.default_rng(0)
        b, (R, _) = rng.normal(size=3), np.linalg.qr(rng.normal(size=(3, 3)))
        R, t = R * np.linalg.det(R), rng.normal(size=3)
        P = np.column_stack([KITTI_K, b])
        edit(kitti / "sequences/00/calib.txt", 3, "P2: " + " ".join(map(repr, P.ravel().tolist())))
        edit(kitti / "poses/00.txt", 1, " ".join(map(repr, np.column_stack([R, t]).ravel().tolist())))
        frame = read_kitti(kitti, ["00"], "image_2")[0]
        point = np.array([0.2, -0.4, 3.0])
        world = R @ point + t
        through = frame.K @ (np.linalg.inv(frame.pose) @ [*world, 1])[:3]
        assert np.allclose(through, P @ [*point, 1])

    def test_given_order(self, written):
        assert [frame.sequence for frame in read_kitti(written / "kitti", ["06", "00"])][::FRAMES] == ["06", "00"]

    def test_line_number_is_the_frame_number(self, kitti):
        (kitti / "sequences/00/image_0/000001.png").unlink()
        assert np.allclose(read_kitti(kitti, ["00"])[1].pose, moved(2 * STEP), atol=1e-8)

    def test_frames_are_in_order_of_their_numbers(self, kitti):
        folder = kitti / "sequences/00/image_0"
        (folder / "000003.png").rename(folder / "10.png")
        (folder / "000000.png").rename(folder / "9.png")
        shutil.rmtree(kitti / "poses")
        assert [frame.path.stem for frame in read_kitti(kitti, ["00"])] == ["000001", "000002", "9", "10"]

    def test_an_unreadable_image_is_kept(self, kitti):
        (kitti / "sequences/00/image_0/000001.png").write_bytes(b"")
        frames = read_kitti(kitti, ["00"])
        assert [frame.size for frame in frames] == [SIZE, (0, 0), SIZE, SIZE]

    @pytest.mark.parametrize("text", ["1 2 3", "1 0 0 nan 0 1 0 0 0 0 1 0", "a b", "1 " * 13])
    def test_malformed_pose(self, kitti, text):
        edit(kitti / "poses/00.txt", 2, text)
        with pytest.raises(ValueError, match=rf"00\.txt, line 2: the 12 numbers of a pose expected, got '{text[:3]}"):
            read_kitti(kitti, ["00"])

    @pytest.mark.parametrize(("line", "text"), [(FRAMES, None), (FRAMES, "")])
    def test_too_few_poses(self, kitti, line, text):
        edit(kitti / "poses/00.txt", line, text)
        with pytest.raises(ValueError, match=rf"00\.txt has no line {FRAMES}, the pose of .*000003\.png"):
            read_kitti(kitti, ["00"])

    def test_calibration(self, kitti):
        path = kitti / "sequences/00/calib.txt"
        edit(path, 2, "P1: 1 2 3")
        assert len(read_kitti(kitti, ["00"])) == FRAMES
        with pytest.raises(ValueError, match=r"calib\.txt, line 2: P1: and 12 numbers expected, got 'P1: 1 2 3'"):
            read_kitti(kitti, ["00"], "image_1")
        edit(path, 2, "P1: " + "0 " * 12)
        with pytest.raises(ValueError, match=r"calib\.txt, line 2: a camera matrix beside a fourth column expected"):
            read_kitti(kitti, ["00"], "image_1")
        edit(path, 2, None)
        with pytest.raises(ValueError, match=r"calib\.txt has no line 'P1: 12 numbers'"):
            read_kitti(kitti, ["00"], "image_1")
        path.write_bytes(b"\xff\xfe\x00")
        with pytest.raises(ValueError, match=r"calib\.txt is not a text file in UTF-8"):
            read_kitti(kitti, ["00"])
        path.unlink()
        with pytest.raises(FileNotFoundError, match=r"no calibration at .*calib\.txt"):
            read_kitti(kitti, ["00"])

    def test_images(self, kitti):
        folder = kitti / "sequences/00/image_0"
        (folder / "000003.png").rename(folder / "left3.png")
        with pytest.raises(ValueError, match=r"left3\.png: an image's name must be its frame's number"):
            read_kitti(kitti, ["00"])
        shutil.rmtree(folder)
        with pytest.raises(FileNotFoundError, match=r"no images \*\.png in .*image_0"):
            read_kitti(kitti, ["00"])

    def test_wrong_arguments(self, written, tmp_path):
        with pytest.raises(ValueError, match=r"no sequence '07' at .*, there are 00, 06, 11"):
            read_kitti(written / "kitti", ["07"])
        with pytest.raises(ValueError, match=r"each once, got \['00', '00'\]"):
            read_kitti(written / "kitti", ["00", "00"])
        with pytest.raises(ValueError, match=r"one name or more, each once, got \[\]"):
            read_kitti(written / "kitti", [])
        with pytest.raises(TypeError, match="a list of names, got the string '00'"):
            read_kitti(written / "kitti", "00")
        with pytest.raises(ValueError, match="image_0 to image_3, got 'image_4'"):
            read_kitti(written / "kitti", camera="image_4")
        with pytest.raises(FileNotFoundError, match=r"no folder .*sequences"):
            read_kitti(tmp_path)


class TestTum:
    def test_frames(self, written):
        frames = read_tum(written / "tum")
        assert [frame.sequence for frame in frames] == [FR1] * FRAMES + [FR3] * FRAMES
        assert frames[0].name == f"{FR1}/rgb/{TUM_START:.6f}.png"
        assert all(frame.path == written / "tum" / frame.name and frame.size == (640, 480) for frame in frames)

    def test_cameras(self, written):
        first, third = read_tum(written / "tum")[:: 2 * FRAMES - 1]
        assert np.array_equal(first.K, [[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
        assert first.distortion == (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
        assert np.array_equal(third.K, [[535.4, 0, 320.1], [0, 539.2, 247.6], [0, 0, 1]])
        assert third.distortion == ()

    def test_unknown_camera(self, tum):
        (tum / FR1).rename(tum / "mine")
        frame = read_tum(tum, ["mine"])[0]
        assert np.isnan(frame.K).all()
        assert frame.distortion == ()

    @pytest.mark.parametrize(
        ("name", "known"), [("fr1_wall", True), ("tum-fr1", True), ("fr10", False), ("afr1", False)]
    )
    def test_camera_is_told_by_the_name(self, tum, name, known):
        (tum / FR1).rename(tum / name)
        assert np.isfinite(read_tum(tum, [name])[0].K).all() == known

    def test_a_sequence_alone(self, written, monkeypatch):
        frames = read_tum(written / "tum" / FR3)
        assert frames[0].name == f"rgb/{TUM_START:.6f}.png"
        assert frames[0].sequence == FR3
        monkeypatch.chdir(written / "tum" / FR3)
        assert [frame.sequence for frame in read_tum(".", [FR3])] == [FR3] * FRAMES
        assert read_tum(".")[0].camera[0, 0] == 535.4

    def test_the_nearest_pose(self, written):
        turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        for number, frame in enumerate(read_tum(written / "tum" / FR3)):
            assert np.allclose(frame.pose, turn @ moved(STEP * number, 535.4), atol=1e-8)

    @pytest.mark.parametrize(
        ("stamps", "expected"),
        [
            ([-0.01, 0.01], 0),  # a tie: the earlier
            ([0.01, -0.01], 1),  # unsorted
            ([-0.011, 0.01], 1),
            ([0.02], 0),  # at the limit
            ([0.020001], None),
            ([-5.0, 5.0], None),
        ],
    )
    def test_association(self, tum, stamps, expected):
        lines = [f"{TUM_START + stamp:.6f} {index} 0 0 0 0 0 1" for index, stamp in enumerate(stamps)]
        (tum / FR1 / "groundtruth.txt").write_text("\n".join(lines))
        x = read_tum(tum, [FR1])[0].pose[0, 3]
        assert np.isnan(x) if expected is None else x == expected

    def test_max_difference(self, written):
        assert np.isnan(read_tum(written / "tum", max_difference=0.001)[0].pose).all()
        for wrong in (-0.1, float("nan")):
            with pytest.raises(ValueError, match=f"zero or more seconds, got {wrong}"):
                read_tum(written / "tum", max_difference=wrong)

    @given(seed=st.integers(0, 2**32 - 1), norm=st.floats(0.01, 100))
    def test_quaternions(self, tmp_path_factory, seed, norm):
        root = tmp_path_factory.getbasetemp() / "quaternion"
        root.mkdir(exist_ok=True)
        rng = np.random.default_rng(seed)
        q, t, points = rng.normal(size=4), rng.normal(size=3), rng.normal(size=(5, 3))
        q /= np.linalg.norm(q)
        (root / "rgb.txt").write_text("1.0 a.png\n")
        Image.new("L", (4, 3)).save(root / "a.png")
        values = [*t.tolist(), *(norm * q[[1, 2, 3, 0]]).tolist()]
        (root / "groundtruth.txt").write_text("1.0 " + " ".join(map(repr, values)))
        pose = read_tum(root)[0].pose
        assert np.allclose(points @ pose[:3, :3].T + pose[:3, 3], rotated(q, points) + t)
        assert np.array_equal(pose[3], [0, 0, 0, 1])

    def test_images_are_in_order_of_time(self, tum):
        path = tum / FR1 / "rgb.txt"
        path.write_text("\n".join(reversed(path.read_text().splitlines())))
        frames = read_tum(tum, [FR1])
        assert [frame.name for frame in frames] == sorted(frame.name for frame in frames)

    def test_no_ground_truth(self, tum):
        (tum / FR1 / "groundtruth.txt").unlink()
        frames = read_tum(tum)
        assert np.isnan([frame.pose for frame in frames[:FRAMES]]).all()
        assert np.isfinite([frame.pose for frame in frames[FRAMES:]]).all()

    @pytest.mark.parametrize(
        ("file", "line", "text", "message"),
        [
            ("rgb.txt", 3, "12.5", r"rgb\.txt, line 3: a timestamp and a file name expected, got '12\.5'"),
            ("rgb.txt", 4, "noon rgb/1.png", r"line 4: a timestamp and a file name expected, got 'noon rgb/1\.png'"),
            (
                "groundtruth.txt",
                2,
                "1 2 3",
                r"groundtruth\.txt, line 2: timestamp tx ty tz qx qy qz qw expected, got '1",
            ),
            ("groundtruth.txt", 3, "1 2 3 4 0 0 0 inf", "line 3: timestamp tx"),
            ("groundtruth.txt", 3, "1 2 3 4 0 0 0 0", "line 3: a quaternion must not be zero"),
        ],
    )
    def test_malformed(self, tum, file, line, text, message):
        edit(tum / FR1 / file, line, text)
        with pytest.raises(ValueError, match=message):
            read_tum(tum, [FR1])

    def test_missing(self, tum, tmp_path):
        edit(tum / FR1 / "rgb.txt", 3, "12.5 rgb/none.png")
        with pytest.raises(FileNotFoundError, match=r"rgb\.txt, line 3: no image at .*none\.png"):
            read_tum(tum)
        (tum / FR1 / "rgb.txt").write_text("# nothing\n")
        with pytest.raises(ValueError, match=r"rgb\.txt lists no images"):
            read_tum(tum)
        (tum / FR3 / "groundtruth.txt").write_text("# nothing\n")
        with pytest.raises(ValueError, match=r"groundtruth\.txt has no poses"):
            read_tum(tum / FR3)
        with pytest.raises(ValueError, match=f"no sequence 'desk' at .*, there are {FR1}, {FR3}"):
            read_tum(tum, ["desk"])
        (tmp_path / "empty").mkdir()
        with pytest.raises(FileNotFoundError, match=r"no rgb\.txt in .*empty, nor in a folder in it"):
            read_tum(tmp_path / "empty")
        with pytest.raises(FileNotFoundError, match=r"no folder at .*none"):
            read_tum(tmp_path / "none")


class TestCambridge:
    def test_frames(self, written):
        frames = read_cambridge(written / "cambridge")
        assert [frame.name for frame in frames] == [
            f"seq{s}/frame{n + 1:05}.png" for s in (1, 2) for n in range(FRAMES)
        ]
        for number, frame in enumerate(frames):
            assert frame.sequence == frame.name[:4]
            assert frame.size == SIZE
            assert np.allclose(frame.K, [[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]])
            assert np.allclose(frame.pose, moved(STEP * (number % FRAMES)), atol=1e-8)

    @pytest.mark.parametrize(("split", "folder"), [("train", "seq1"), ("test", "seq2")])
    def test_split(self, written, split, folder):
        assert {frame.sequence for frame in read_cambridge(str(written / "cambridge"), split)} == {folder}

    def test_convention(self, cambridge):
        # Points of the world go to the camera by x = R(q) (X - C), as DSAC* and hloc read these files.
        rng = np.random.default_rng(0)
        q, C, points = rng.normal(size=4), rng.normal(size=3), rng.normal(size=(6, 3))
        q /= np.linalg.norm(q)
        edit(
            cambridge / "dataset_train.txt", 4, f"seq1/frame00001.png {' '.join(map(repr, [*C.tolist(), *q.tolist()]))}"
        )
        world_to_camera = np.linalg.inv(read_cambridge(cambridge, "train")[0].pose)
        assert np.allclose(points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3], rotated(q, points - C))

    def test_without_reconstruction(self, cambridge):
        edit(cambridge / "reconstruction.nvm", 4, None)
        edit(cambridge / "reconstruction.nvm", 3, "7")
        frames = read_cambridge(cambridge, "train")
        assert np.isnan(frames[0].K).all()
        assert np.isfinite(frames[1].K).all()
        (cambridge / "reconstruction.nvm").unlink()
        assert all(np.isnan(frame.K).all() for frame in read_cambridge(cambridge))

    def test_suffix_of_the_reconstruction(self, cambridge):
        path = cambridge / "reconstruction.nvm"
        path.write_text(path.read_text().replace(".jpg", ".png"))
        assert np.isfinite(read_cambridge(cambridge)[0].K).all()

    def test_an_unreadable_image_has_no_camera(self, cambridge):
        (cambridge / "seq1/frame00001.png").write_bytes(b"")
        frame = read_cambridge(cambridge)[0]
        assert frame.size == (0, 0)
        assert np.isnan(frame.K).all()

    @pytest.mark.parametrize(
        ("file", "line", "text", "message"),
        [
            (
                "dataset_train.txt",
                5,
                "seq1/frame00002.png 1 2 3",
                r"dataset_train\.txt, line 5: ImageFile X Y Z W P Q R",
            ),
            ("dataset_test.txt", 4, "seq2/frame00001.png 0 0 0 0 0 0 0", "line 4: a quaternion must not be zero"),
            (
                "dataset_train.txt",
                5,
                "seq1/frame00001.png 0 0 0 1 0 0 0",
                "line 5: seq1/frame00001.png is listed twice",
            ),
            ("reconstruction.nvm", 1, "NVM_V3 FixedK 1 2 3 4 5", r"reconstruction\.nvm, line 1: NVM_V3 expected"),
            ("reconstruction.nvm", 3, "many", "line 3: the number of images expected, got 'many'"),
            ("reconstruction.nvm", 3, "99", r"reconstruction\.nvm, line 13: an image, its focal length"),
            ("reconstruction.nvm", 5, "seq1/frame00002.jpg 1 2", r"line 5: an image, its focal length"),
            ("reconstruction.nvm", 5, "a.jpg 0 1 0 0 0 0 0 0 0 0", r"line 5: a positive focal length expected, got 0"),
        ],
    )
    def test_malformed(self, cambridge, file, line, text, message):
        edit(cambridge / file, line, text)
        with pytest.raises(ValueError, match=message):
            read_cambridge(cambridge)

    def test_truncated_reconstruction(self, cambridge):
        (cambridge / "reconstruction.nvm").write_text("NVM_V3\n\n3\n")
        with pytest.raises(ValueError, match=r"reconstruction\.nvm announces 3 images and has 0"):
            read_cambridge(cambridge)
        (cambridge / "reconstruction.nvm").write_text("NVM_V3\n")
        with pytest.raises(ValueError, match="the number of images expected, got ''"):
            read_cambridge(cambridge)

    def test_missing(self, cambridge):
        with pytest.raises(ValueError, match="'train', 'test' or None for both, got 'val'"):
            read_cambridge(cambridge, "val")
        edit(cambridge / "dataset_train.txt", 5, "seq1/none.png 0 0 0 1 0 0 0")
        with pytest.raises(FileNotFoundError, match=r"dataset_train\.txt, line 5: no image at .*none\.png"):
            read_cambridge(cambridge)
        (cambridge / "dataset_train.txt").write_text("a\nb\n\n")
        with pytest.raises(ValueError, match=r"dataset_train\.txt lists no images"):
            read_cambridge(cambridge)
        (cambridge / "dataset_train.txt").unlink()
        with pytest.raises(FileNotFoundError, match=r"no list of images at .*dataset_train\.txt"):
            read_cambridge(cambridge)


class TestFolder:
    def test_frames(self, written):
        frames = read_folder(written / "folder")
        assert [(frame.sequence, frame.name) for frame in frames] == [
            ("", "a.png"),
            ("", "b.PNG"),
            ("left", "left/1.jpg"),
            ("left", "left/2.JPG"),
            ("left/deep", "left/deep/1.bmp"),
            ("right", "right/1.tif"),
            ("right", "right/2.webp"),
        ]
        for frame in frames:
            assert frame.size == SIZE
            assert np.isnan(frame.K).all()
            assert np.isnan(frame.pose).all()

    def test_a_folder_within_does_not_part_its_sequence(self, tmp_path):
        for name in ("s/1.png", "s/2/1.png", "s/3.png", "s-1/1.png"):
            (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
            (tmp_path / name).touch()
        pairs = pair_frames(read_folder(str(tmp_path)))
        assert [(pair.frame1.name, pair.frame2.name) for pair in pairs] == [("s/1.png", "s/3.png")]

    def test_hidden(self, tmp_path):
        for name in (".thumbs/1.png", "._1.png", "1.png"):
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).touch()
        frames = read_folder(tmp_path)
        assert [(frame.name, frame.size) for frame in frames] == [("1.png", (0, 0))]

    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"no images \(\.bmp, .*\) in "):
            read_folder(tmp_path)
        with pytest.raises(FileNotFoundError, match=r"no folder at .*none"):
            read_folder(tmp_path / "none")


class TestSplits:
    def test_kitti(self, written):
        assert split_sequences("kitti", "train", written / "kitti") == ["00"]
        assert split_sequences("kitti", "test", str(written / "kitti")) == ["06"]

    def test_tum(self, written):
        assert split_sequences("tum", "train", written / "tum") == [FR1]
        assert split_sequences("tum", "val", written / "tum") == [FR3]
        assert split_sequences("tum", "val", written / "tum" / FR3) == [FR3]

    def test_cambridge(self, cambridge):
        with pytest.raises(
            FileNotFoundError, match=r"no test sequence of cambridge at .*: expected StMarysChurch, got Ch"
        ):
            split_sequences("cambridge", "test", cambridge)
        cambridge.rename(cambridge.with_name("StMarysChurch"))
        assert split_sequences("cambridge", "test", cambridge.parent) == ["StMarysChurch"]

    def test_no_sequence_is_in_two_splits(self):
        for dataset in ("kitti", "tum"):
            names = [name for split in SPLITS[dataset].values() for name in split or ()]
            assert len(names) == len(set(names))

    def test_wrong_arguments(self, written):
        with pytest.raises(ValueError, match="one of kitti, tum, cambridge, got 'kiti'"):
            split_sequences("kiti", "train", written)
        with pytest.raises(ValueError, match="a split of kitti must be one of train, test, got 'val'"):
            split_sequences("kitti", "val", written)
        with pytest.raises(
            FileNotFoundError, match=f"no train sequence of tum at .*: expected others than {FR3}, got {FR3}"
        ):
            split_sequences("tum", "train", written / "tum" / FR3)


def test_ground_truth_fits_the_images(written):
    for frames in (read_kitti(written / "kitti", ["06"], "image_3"), read_cambridge(written / "cambridge", "test")):
        assert all(epipoles_agree(pair) for pair in pair_frames(frames))


@pytest.mark.parametrize(
    ("reader", "folder", "sequence", "store", "count"),
    [
        (read_kitti, "kitti", "06", "kitti_06", 50),
        # That store takes the nearest pose whatever the difference, 0.067 s for the first frame.
        (partial(read_tum, max_difference=0.1), "tum", FR3, "tum_fr3_office", 19),
    ],
)
def test_real_data(reader, folder, sequence, store, count):
    """Cameras, motions and F are those of stores that other code made of the same frames."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    data = os.environ.get("LEARNNORM_DATA")
    if data is None:
        pytest.skip("LEARNNORM_DATA does not name a folder of real data")
    pairs = {
        (pair.frame1.path.name, pair.frame2.path.name): pair
        for pair in pair_frames(reader(Path(data) / folder, [sequence]))
    }
    with h5py.File(Path(data) / "correspondences" / f"{store}.h5") as file:
        rows = [(row, tuple(names)) for row, names in enumerate(file["names"].asstr()[:]) if tuple(names) in pairs]
        assert len(rows) == len(pairs) == count
        for row, names in rows:
            pair = pairs[names]
            R, t = pair.motion
            assert np.allclose(pair.F, file["F"][row], rtol=0, atol=1e-6)
            assert np.allclose(np.stack([pair.frame1.K, pair.frame2.K]), file["K"][row], rtol=0, atol=1e-6)
            assert np.allclose(R, file["R"][row], rtol=0, atol=1e-6)
            assert np.allclose(t, file["t"][row], rtol=0, atol=1e-6)
            assert [pair.frame1.size, pair.frame2.size] == [tuple(size) for size in file["image_size"][row]]


def test_real_frame_without_a_pose_near_enough():
    data = os.environ.get("LEARNNORM_DATA")
    if data is None:
        pytest.skip("LEARNNORM_DATA does not name a folder of real data")
    known = [bool(np.isfinite(frame.pose).all()) for frame in read_tum(Path(data) / "tum")]
    assert known == [False] + [True] * 19  # the motion capture starts 0.067 s after the first frame

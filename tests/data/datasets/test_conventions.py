"""Cameras and poses of KITTI, TUM and Cambridge, against the layouts that make_sequences.py writes."""

import shutil

import numpy as np
import pytest
from make_sequences import FR1, FR3, FRAMES, KITTI_BASELINES, KITTI_K, STEP, TUM_START, edit, moved, rotated

from kornia_learnnorm.data.datasets.cambridge import read_cambridge
from kornia_learnnorm.data.datasets.kitti import read_kitti
from kornia_learnnorm.data.datasets.tum import read_tum


@pytest.mark.parametrize("number", range(4))
def test_other_cameras_stand_beside_the_first(written, number):
    frames = read_kitti(str(written / "kitti"), ["06", "11"], f"image_{number}")
    for place, frame in enumerate(frames[:FRAMES]):
        assert np.allclose(frame.pose, moved(STEP * place + KITTI_BASELINES[number]), atol=1e-8)
    assert all(np.isnan(frame.pose).all() for frame in frames[FRAMES:])


def test_a_point_of_the_world_projects_through_every_camera(kitti):
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
    assert np.allclose(frame.K @ (np.linalg.inv(frame.pose) @ [*world, 1])[:3], P @ [*point, 1])


def test_frames_are_in_order_of_their_numbers(kitti):
    folder = kitti / "sequences/00/image_0"
    (folder / "000003.png").rename(folder / "10.png")
    (folder / "000000.png").rename(folder / "9.png")
    shutil.rmtree(kitti / "poses")
    assert [frame.path.stem for frame in read_kitti(kitti, ["00"])] == ["000001", "000002", "9", "10"]


def test_cameras(written):
    first, third = read_tum(written / "tum")[:: 2 * FRAMES - 1]
    assert np.array_equal(first.K, [[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
    assert first.distortion == (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    assert np.array_equal(third.K, [[535.4, 0, 320.1], [0, 539.2, 247.6], [0, 0, 1]])
    assert third.distortion == ()


@pytest.mark.parametrize(
    ("name", "known"), [("fr1_wall", True), ("tum-fr1", True), ("fr10", False), ("afr1", False), ("mine", False)]
)
def test_camera_is_told_by_the_name(tum, name, known):
    (tum / FR1).rename(tum / name)
    frame = read_tum(tum, [name])[0]
    assert np.isfinite(frame.K).all() == bool(frame.distortion) == known


def test_a_sequence_alone(written, monkeypatch):
    assert read_tum(written / "tum" / FR3)[0].name == f"rgb/{TUM_START:.6f}.png"
    monkeypatch.chdir(written / "tum" / FR3)
    assert [frame.sequence for frame in read_tum(".", [FR3])] == [FR3] * FRAMES


def test_the_nearest_pose(written):
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for number, frame in enumerate(read_tum(written / "tum" / FR3)):
        assert np.allclose(frame.pose, turn @ moved(STEP * number, 535.4), atol=1e-8)


def test_association(tum):
    for stamps, expected in [
        ([-0.01, 0.01], 0),  # a tie: the earlier
        ([0.01, -0.01], 1),  # unsorted
        ([0.02], 0),  # at the limit
        ([0.020001], None),
    ]:
        lines = [f"{TUM_START + stamp:.6f} {index} 0 0 0 0 0 1" for index, stamp in enumerate(stamps)]
        (tum / FR1 / "groundtruth.txt").write_text("\n".join(lines))
        x = read_tum(tum, [FR1])[0].pose[0, 3]
        assert np.isnan(x) if expected is None else x == expected


@pytest.mark.parametrize("norm", [0.01, 1.0])
def test_quaternion_of_any_norm(tum, norm):
    rng = np.random.default_rng(0)
    q, t, points = rng.normal(size=4), rng.normal(size=3), rng.normal(size=(5, 3))
    q /= np.linalg.norm(q)
    values = [TUM_START, *t.tolist(), *(norm * q[[1, 2, 3, 0]]).tolist()]
    (tum / FR1 / "groundtruth.txt").write_text(" ".join(map(repr, values)))
    pose = read_tum(tum, [FR1])[0].pose
    assert np.allclose(points @ pose[:3, :3].T + pose[:3, 3], rotated(q, points) + t)
    assert np.array_equal(pose[3], [0, 0, 0, 1])


def test_convention(cambridge):
    # Points of the world go to the camera by x = R(q) (X - C), as DSAC* and hloc read these files.
    rng = np.random.default_rng(0)
    q, C, points = rng.normal(size=4), rng.normal(size=3), rng.normal(size=(6, 3))
    q /= np.linalg.norm(q)
    edit(cambridge / "dataset_train.txt", 4, f"seq1/frame00001.png {' '.join(map(repr, [*C.tolist(), *q.tolist()]))}")
    world_to_camera = np.linalg.inv(read_cambridge(cambridge, "train")[0].pose)
    assert np.allclose(points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3], rotated(q, points - C))


def test_without_reconstruction(cambridge):
    edit(cambridge / "reconstruction.nvm", 4, None)
    edit(cambridge / "reconstruction.nvm", 3, "7")
    frames = read_cambridge(cambridge, "train")
    assert np.isnan(frames[0].K).all()
    assert np.isfinite(frames[1].K).all()
    (cambridge / "reconstruction.nvm").unlink()
    assert all(np.isnan(frame.K).all() for frame in read_cambridge(cambridge))


def test_an_unreadable_image_has_no_camera(cambridge):
    (cambridge / "seq1/frame00001.png").write_bytes(b"")
    frame = read_cambridge(cambridge)[0]
    assert frame.size == (0, 0)
    assert np.isnan(frame.K).all()

import shutil

import numpy as np
import pytest
from make_sequences import FRAMES, KITTI_BASELINES, KITTI_K, STEP, edit, moved

from kornia_learnnorm.data.datasets.kitti import read_kitti


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
    through = frame.K @ (np.linalg.inv(frame.pose) @ [*world, 1])[:3]
    assert np.allclose(through, P @ [*point, 1])


def test_frames_are_in_order_of_their_numbers(kitti):
    folder = kitti / "sequences/00/image_0"
    (folder / "000003.png").rename(folder / "10.png")
    (folder / "000000.png").rename(folder / "9.png")
    shutil.rmtree(kitti / "poses")
    assert [frame.path.stem for frame in read_kitti(kitti, ["00"])] == ["000001", "000002", "9", "10"]

import numpy as np
import pytest
from make_sequences import FR1, FR3, FRAMES, STEP, TUM_START, moved, rotated

from kornia_learnnorm.data.datasets.tum import read_tum


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

import json

import numpy as np
import pytest
from references import epipolar_distances

from kornia_learnnorm.data.matching.matchers import match_images
from kornia_learnnorm.data.synthetic.render import correspondences, render_pair, room, rotation, write_pair

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def pair():
    return render_pair()


def test_images(pair):
    for image in (pair.image1, pair.image2):
        assert (image.shape, image.dtype) == ((480, 640), np.uint8)
        assert image.std() > 40
        assert np.mean((image == 0) | (image == 255)) < 0.02  # no holes, hardly anything over- or underexposed
    assert np.mean(pair.image1 != pair.image2) > 0.5


def test_ground_truth_is_that_of_the_cameras(pair):
    assert pair.K.tolist() == [[576.0, 0.0, 319.5], [0.0, 576.0, 239.5], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(pair.R @ pair.R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(pair.R) == pytest.approx(1)
    assert 0.4 < np.linalg.norm(pair.t) < 0.9
    X1 = np.random.default_rng(0).uniform((-2, -1, 3), (2, 1, 7), (20, 3))  # Points in space, projected by hand.
    x1, x2 = X1 @ pair.K.T, (X1 @ pair.R.T + pair.t) @ pair.K.T
    x1, x2 = x1 / x1[:, 2:], x2 / x2[:, 2:]
    assert epipolar_distances(x1[:, :2], x2[:, :2], pair.F_mat).max() < 1e-9
    assert np.linalg.norm(pair.F_mat) == pytest.approx(1)


def test_matches_agree_with_the_ground_truth(pair):
    *points, ratio = match_images(pair.image1, pair.image2)
    distance = epipolar_distances(*(p[ratio < 0.8] for p in points), pair.F_mat)
    assert len(distance) >= 300
    assert np.mean(distance < 1) >= 0.8
    assert np.median(distance) < 0.3  # images and F agree to a fraction of a pixel


def test_the_seed_determines_the_pair():
    first, again, other = (render_pair(seed, width=96, height=72) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.image1, other.image1)
    assert not np.array_equal(first.F_mat, other.F_mat)


@pytest.mark.parametrize("wide", [False, True])
def test_correspondences_are_in_front_of_all_other_planes(wide):
    planes = room(np.random.default_rng(0), cv2, texels=0.5)
    K, size = np.array([[288.0, 0, 159.5], [0, 288.0, 119.5], [0, 0, 1]]), (320, 240)
    R = rotation(-0.25, 0.02, 0.01) if wide else rotation(0.01, 0.0, 0.0)
    t = -R @ (np.array([1.8, 0.2, 0.5]) if wide else np.array([0.1, 0.0, 0.0]))
    points1, points2 = correspondences(planes, K, R, t, size)
    assert len(points1) > 1000
    for points, R_view, t_view in ((points1, np.eye(3), np.zeros(3)), (points2, R, t)):
        rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(K).T @ R_view  # in the first frame
        centre, nearest = -R_view.T @ t_view, np.full(len(points), np.inf)
        for plane in planes:
            normal = np.cross(plane.right, plane.down)
            depth = (plane.corner - centre) @ normal / (rays @ normal)
            local = centre + depth[:, None] * rays - plane.corner
            u, v = np.linalg.lstsq(np.stack([plane.right, plane.down], -1), local.T, rcond=None)[0]
            hit = (depth > 0) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
            nearest = np.where(hit, np.minimum(nearest, depth), nearest)
        X = centre + nearest[:, None] * rays
        seen = [V[:, :2] / V[:, 2:] for V in (X @ K.T, (X @ R.T + t) @ K.T)]
        np.testing.assert_allclose(seen[0], points1, atol=1e-6)
        np.testing.assert_allclose(seen[1], points2, atol=1e-6)


def test_write_pair(tmp_path):
    folder, pair = tmp_path / "new" / "pair", render_pair(width=96, height=72)
    write_pair(str(folder), pair)
    assert sorted(path.name for path in folder.iterdir()) == ["ground_truth.json", "image1.png", "image2.png"]
    for name in ("image1", "image2"):
        image = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(image, getattr(pair, name))
    truth = json.loads((folder / "ground_truth.json").read_text())
    assert (truth["width"], truth["height"]) == (96, 72)
    for name in ("K", "R", "t", "F_mat"):
        assert np.array_equal(truth[name], getattr(pair, name))  # to the last bit


@pytest.mark.parametrize("values", [{"seed": -1}, {"width": 640, "height": 10}, {"width": 100, "height": 200}])
def test_bad_values(values):
    with pytest.raises(ValueError, match=" x ".join(map(str, values.values()))):
        render_pair(**values)

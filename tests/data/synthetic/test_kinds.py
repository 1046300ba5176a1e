import json

import numpy as np
import pytest
from two_view import epipolar_distances

from kornia_learnnorm.data.synthetic.kinds import KINDS, MAX_RELIEF, render_kind
from kornia_learnnorm.data.synthetic.planes import Plane, correspondences, relief_of, rotation
from kornia_learnnorm.data.synthetic.render import RenderedPair, render_pair, room, write_pair

cv2 = pytest.importorskip("cv2")

SIZE = (320, 240)
PAIRS = [(kind, seed) for kind in KINDS for seed in (0, 1)]


@pytest.fixture(scope="module")
def rendered():
    """Return pairs by kind and seed, each rendered once."""
    found = {}

    def pair(kind: str, seed: int) -> RenderedPair:
        if (kind, seed) not in found:
            found[kind, seed] = render_kind(kind, seed, *SIZE)
        return found[kind, seed]

    return pair


def mapped(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map points by a homography."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def depths(pair: RenderedPair) -> np.ndarray:
    """Depths in the first camera, from s2 x2 = s1 R x1 + t in least squares."""
    rays1, rays2 = (
        np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(pair.K).T
        for points in (pair.points1, pair.points2)
    )
    return np.array(
        [
            np.linalg.lstsq(np.stack([pair.R @ ray1, -ray2], -1), -pair.t, rcond=None)[0][0]
            for ray1, ray2 in zip(rays1, rays2, strict=True)
        ]
    )


@pytest.mark.parametrize(("kind", "seed"), PAIRS)
def test_images_show_the_correspondences(rendered, kind, seed):
    pair = rendered(kind, seed)
    assert pair.image1.shape == pair.image2.shape == SIZE[::-1]
    assert pair.image1.dtype == pair.image2.dtype == np.uint8
    assert len(pair.points1) == len(pair.points2) >= 500
    for points in (pair.points1, pair.points2):
        assert (points >= 0).all()
        assert (points <= np.array(SIZE) - 1).all()
    values = [
        cv2.remap(cv2.GaussianBlur(image, None, 1.0), points.astype(np.float32)[:, None], None, cv2.INTER_LINEAR)
        for image, points in ((pair.image1, pair.points1), (pair.image2, pair.points2))
    ]
    assert np.corrcoef(values[0].ravel(), values[1].ravel())[0, 1] > 0.85  # 0 for points that do not correspond


@pytest.mark.parametrize(("kind", "seed"), [pair for pair in PAIRS if pair[0] != "rotation"])
def test_correspondences_satisfy_the_fundamental_matrix(rendered, kind, seed):
    pair = rendered(kind, seed)
    assert epipolar_distances(pair.points1, pair.points2, pair.F_mat).max() < 1e-6
    assert np.linalg.norm(pair.F_mat) == pytest.approx(1)
    np.testing.assert_allclose(pair.R @ pair.R.T, np.eye(3), atol=1e-14)
    assert 0.02 * 6 - 1e-9 <= np.linalg.norm(pair.t) <= 0.35 * 6 + 1e-9
    assert depths(pair).min() > 0.5


@pytest.mark.parametrize(("kind", "seed"), PAIRS)
def test_sift_matches_agree_with_the_truth(rendered, kind, seed):
    pair = rendered(kind, seed)
    sift = cv2.SIFT_create()
    (keys1, desc1), (keys2, desc2) = (sift.detectAndCompute(image, None) for image in (pair.image1, pair.image2))
    good = [a for a, b in cv2.BFMatcher().knnMatch(desc1, desc2, k=2) if a.distance < 0.8 * b.distance]
    points1 = np.array([keys1[match.queryIdx].pt for match in good], np.float64)
    points2 = np.array([keys2[match.trainIdx].pt for match in good], np.float64)
    assert len(good) >= 150  # several hundred at 640 x 480
    if kind == "rotation":
        distance = np.linalg.norm(mapped(pair.K @ pair.R @ np.linalg.inv(pair.K), points1) - points2, axis=1)
    else:
        distance = epipolar_distances(points1, points2, pair.F_mat)
    assert np.mean(distance < 1) >= (0.35 if kind in ("repeated", "borders") else 0.75)


@pytest.mark.parametrize("kind", KINDS)
def test_kind_and_seed_determine_the_pair(kind):
    first, again, other = (render_kind(kind, seed, 96, 72) for seed in (1, 1, 2))
    for name, value in first._asdict().items():
        np.testing.assert_array_equal(value, getattr(again, name))  # NaN is equal to NaN
    assert not np.array_equal(first.image1, other.image1)
    assert not np.array_equal(first.R, other.R)


def test_rotation_has_a_homography_and_no_fundamental_matrix(rendered, tmp_path):
    pair = rendered("rotation", 0)
    assert pair.t.tolist() == [0, 0, 0]
    assert np.isnan(pair.F_mat).all()
    H = pair.K @ pair.R @ np.linalg.inv(pair.K)
    np.testing.assert_allclose(mapped(H, pair.points1), pair.points2, atol=1e-9)
    angle = np.degrees(np.arccos((np.trace(pair.R) - 1) / 2))
    assert 3 <= angle <= 16
    write_pair(tmp_path, pair)
    assert json.loads((tmp_path / "ground_truth.json").read_text())["F_mat"] is None


@pytest.mark.parametrize("seed", [0, 1])
def test_plane_has_a_homography(rendered, seed):
    pair = rendered("plane", seed)
    H, _ = cv2.findHomography(pair.points1, pair.points2, 0)
    np.testing.assert_allclose(mapped(H, pair.points1), pair.points2, atol=1e-6)
    assert pair.relief == 0


@pytest.mark.parametrize(("kind", "seed"), [("facade", 0), ("facade", 1), ("repeated", 0), ("repeated", 1)])
def test_relief_is_that_of_the_boards(rendered, kind, seed):
    pair = rendered(kind, seed)
    assert (0.03 if kind == "repeated" else 0) < pair.relief <= MAX_RELIEF
    # The wall has most of the points: a plane through them, and the distances of the points to it.
    _, on_wall = cv2.findHomography(pair.points1, pair.points2, cv2.RANSAC, 1e-3)
    X = np.column_stack([pair.points1, np.ones(len(pair.points1))]) @ np.linalg.inv(pair.K).T * depths(pair)[:, None]
    wall = np.linalg.lstsq(X[on_wall.ravel() > 0], np.ones(on_wall.sum()), rcond=None)[0]  # wall @ X = 1
    shares = 1 - X @ wall
    assert shares.max() == pytest.approx(pair.relief, abs=1e-6)
    assert shares.min() > -1e-6


def test_relief_differs_between_seeds():
    reliefs = [render_kind("facade", seed, 96, 72).relief for seed in range(4)]
    assert len(set(reliefs)) == 4


def test_a_frame_is_black_and_hides_its_correspondences(rendered):
    pair = rendered("borders", 0)
    black = (pair.image1 == 0) & (pair.image2 == 0)
    for side in (black[:, :8], black[:, -8:], black[:6], black[-6:]):
        assert side.all()
    assert black.mean() < 0.5
    for points in (pair.points1, pair.points2):
        x, y = points.round().astype(int).T
        assert black[y, x].mean() < 0.01


def test_a_caption_is_equal_in_both_images(rendered):
    pair = rendered("borders", 1)
    equal = pair.image1 == pair.image2
    assert equal[-12:].all()
    assert equal[:20, :20].all() or equal[:20, -20:].all()  # the logo
    assert pair.image1[-12:].std() > 20
    assert np.median(np.linalg.norm(pair.points1 - pair.points2, axis=1)) > 2
    for points in (pair.points1, pair.points2):
        assert points[:, 1].max() < SIZE[1] - 12


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


def test_relief_of_planes():
    texture = np.zeros((2, 2), np.float32)
    wall = Plane(np.array([-4.0, -3, 5]), np.array([8.0, 0, 0]), np.array([0, 6.0, 0]), texture)
    board = Plane(np.array([0.0, 0, 4]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), texture)
    assert relief_of([wall]) == 0
    assert relief_of([wall, board]) == pytest.approx(0.2)  # 1 m of 5 m


def test_the_first_example_has_correspondences():
    pair = render_pair(width=96, height=72)
    assert epipolar_distances(pair.points1, pair.points2, pair.F_mat).max() < 1e-6
    assert len(pair.points1) > 1000


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "garden"}, "garden.*room"),
        ({"kind": "room", "seed": -1}, "seed .* -1"),
        ({"kind": "room", "width": 640, "height": 10}, "640 x 10"),
        ({"kind": "room", "width": 100, "height": 200}, "100 x 200"),
    ],
)
def test_bad_values(values, message):
    with pytest.raises(ValueError, match=message):
        render_kind(**values)

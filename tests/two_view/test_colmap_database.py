"""Databases of COLMAP: read back and reconstructed by pycolmap, from exact projections of points that are known."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import raises, store_of

from kornia_learnnorm.data.images import read_image, stored_pixels
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.two_view.colmap_database import DatabaseCounts, check_images, export_colmap

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")

SIZE = 640, 480
K = np.array([[500.0, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]])
NAMES = [f"views/{number}.png" for number in range(4)]
ANGLES = ((0, 0), (0.1, 0.2), (-0.05, 0.4), (0.07, 0.6))  # about x and y, radians
ROTATIONS = [pycolmap.Rotation3d(np.array([x, y, 0.0])).matrix() for x, y in ANGLES]
CENTRE = np.array([0, 0, 6.0])  # of the points; the cameras look at it from six metres away
MATCHES = 120


def points(kind: str) -> np.ndarray:
    """A cloud, or a slanted plane."""
    X = np.random.default_rng(0).uniform(-1.5, 1.5, (MATCHES, 3))
    return CENTRE + (X if kind == "cloud" else np.column_stack([X[:, :2], 0.3 * X[:, 0]]))


def project(X, R):
    x = ((X - CENTRE) @ R.T + CENTRE) @ K.T
    return x[:, :2] / x[:, 2:]


def make_store(kind="cloud", noise=0.05, names=NAMES) -> CorrespondenceStore:
    """All pairs of four images, with noise on each point and every fourth match of a pair wrong."""
    rng = np.random.default_rng(1)
    views = [project(points(kind), R) + noise * rng.standard_normal((MATCHES, 2)) for R in ROTATIONS]
    pairs = [*combinations(range(4), 2)]
    first, second = (np.concatenate([views[pair[side]] for pair in pairs]).astype(np.float32) for side in (0, 1))
    wrong = np.arange(len(second)) % 4 == 3
    second[wrong] = second[wrong][::-1]
    ratio = np.where(wrong, 0.79, 0.5)
    return store_of(first, second, MATCHES * np.arange(len(pairs) + 1), [*combinations(names, 2)], SIZE, ratio)


@pytest.fixture
def images(tmp_path) -> Path:
    for name in NAMES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("L", SIZE).save(tmp_path / name)
    return tmp_path


def export(images, store=None, **options) -> tuple[DatabaseCounts, Path]:
    path = images / "written.db"
    return export_colmap(make_store() if store is None else store, images, path, jobs=1, **options), path


def read_pair(path, name1=NAMES[0], name2=NAMES[3]):
    """The matched keypoints of a pair, those that are inliers, and its geometry."""
    with pycolmap.Database.open(path) as file:
        first, second = (file.read_image_with_name(name).image_id for name in (name1, name2))
        keypoints = [file.read_keypoints(number)[:, :2] for number in (first, second)]
        geometry = file.read_two_view_geometry(first, second)
        tables = file.read_matches(first, second), np.array(geometry.inlier_matches, int).reshape(-1, 2)
    return *([points[column] for points, column in zip(keypoints, table.T, strict=True)] for table in tables), geometry


def test_reference(images):
    """Matrices and pose are those of the cameras, in COLMAP's pixels."""
    store = make_store()
    counts, path = export(images, store, K=K)
    assert counts._replace(inliers=0) == (4, 6, 6 * MATCHES, 6, 0, (), ())
    matched, inliers, geometry = read_pair(path)
    rows = slice(2 * MATCHES, 3 * MATCHES)
    np.testing.assert_allclose(matched, [store.points1[rows] + 0.5, store.points2[rows] + 0.5], atol=1e-4)
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    assert 0.95 < len(inliers[0]) / (0.75 * MATCHES) < 1.05

    x1, x2 = (project(points("cloud"), ROTATIONS[view]) + 0.5 for view in (0, 3))
    homogeneous = [np.column_stack([x, np.ones(MATCHES)]) for x in (x1, x2)]
    lines = homogeneous[0] @ geometry.F.T
    assert np.median(np.abs((lines * homogeneous[1]).sum(1)) / np.hypot(*lines[:, :2].T)) < 0.1
    np.testing.assert_allclose(geometry.cam2_from_cam1.rotation.matrix(), ROTATIONS[3], atol=2e-3)
    t = CENTRE - ROTATIONS[3] @ CENTRE
    np.testing.assert_allclose(geometry.cam2_from_cam1.translation, t / np.linalg.norm(t), atol=1e-2)
    corner = K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    E = corner.T @ geometry.F @ corner
    assert abs((geometry.E / np.linalg.norm(geometry.E) * E / np.linalg.norm(E)).sum()) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("known", [True, False])
def test_colmap_reconstructs(images, known):
    _, path = export(images, K=2 * K if known else None, single_camera=True)  # a multiple is the same camera
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size, options.random_seed, options.num_threads = 3, 0, 1
    if known:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    (images / "sparse").mkdir()
    (model,) = pycolmap.incremental_mapping(path, images, images / "sparse", options).values()
    assert model.num_reg_images() == 4
    found = {image.name: image.projection_center() for image in model.images.values()}
    truth = [CENTRE - R.T @ CENTRE for R in ROTATIONS]
    similarity = pycolmap.estimate_sim3d(np.array([found[name] for name in NAMES]), np.array(truth))
    errors = [np.linalg.norm(similarity * found[name] - centre) for name, centre in zip(NAMES, truth, strict=True)]
    assert max(errors) < 0.05
    if known:
        (camera,) = model.cameras.values()
        np.testing.assert_array_equal(camera.params, [500, 510, 320, 240])


def test_a_plane_without_cameras_is_one(images):
    counts, path = export(images, make_store("plane"))
    assert counts.verified == 6
    _, _, geometry = read_pair(path)
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC
    x1, x2 = (project(points("plane"), ROTATIONS[view]) + 0.5 for view in (0, 3))
    moved = np.column_stack([x1, np.ones(MATCHES)]) @ geometry.H.T
    assert np.median(np.linalg.norm(moved[:, :2] / moved[:, 2:] - x2, axis=1)) < 0.2


def test_cameras_of_its_own(images):
    for single, number in ((True, 1), (False, 4)):
        _, path = export(images, single_camera=single)
        _, _, geometry = read_pair(path)
        assert geometry.config == pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        with pycolmap.Database.open(path) as file:
            assert [camera.model_name for camera in file.read_all_cameras()] == number * ["SIMPLE_RADIAL"]
        path.unlink()


def test_images_that_do_not_match_have_no_geometry(images):
    store = make_store()
    store.points2[: 3 * MATCHES] = np.random.default_rng(2).uniform(0, 480, (3 * MATCHES, 2))  # of the first image
    counts, path = export(images, store)
    assert (counts.verified, counts.unverified) == (3, (NAMES[0],))
    matched, inliers, geometry = read_pair(path, *NAMES[:2])
    assert (len(matched[0]), len(inliers[0])) == (MATCHES, 0)
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.UNDEFINED


def test_a_pair_that_comes_twice(images):
    store = make_store()
    store.names[5] = NAMES[1], NAMES[0]
    assert export(images, store)[0].pairs == 5


@pytest.mark.parametrize("suffix", ["png", "tif"])  # Pillow itself turns a TIFF
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_of_images_that_exif_turns(tmp_path, orientation, suffix):
    """Against Pillow: the one bright pixel of a file, and where it is shown."""
    file = tmp_path / f"turned.{suffix}"
    values = np.zeros((5, 7), np.uint8)
    values[1, 2] = 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(values).save(file, exif=exif)
    shown = read_image(file)
    (place,) = np.argwhere(shown)
    stored, size = stored_pixels(file, place[None, ::-1], shown.shape[::-1])
    assert (stored.tolist(), size) == ([[2, 1]], (7, 5))
    same, size = stored_pixels(file, [[2, 1]], (7, 5), turned=False)
    assert (same.tolist(), size) == ([[2, 1]], (7, 5))


class TestErrors:
    def test_a_database_is_never_replaced(self, images):
        (images / "written.db").write_text("mine")
        raises(FileExistsError, r"written\.db exists already: remove it", export, images)
        assert (images / "written.db").read_text() == "mine"

    def test_skew_and_unreadable_and_missing_images(self, images):
        raises(ValueError, r"K must have no skew, .* got 5\.0", export, images, K=K + np.diag([5, 0], 1))
        (images / NAMES[1]).write_bytes(b"")
        raises(ValueError, r"views/1\.png is not an image that can be read", export, images)
        (images / NAMES[2]).unlink()
        raises(FileNotFoundError, r"1 of 4 images are not in .*, the first is views/2\.png", export, images)

    def test_images_that_colmap_does_not_take(self, images):
        (images / NAMES[1]).write_bytes(b"")
        raises(ValueError, r"leaves out 1 of 4 images, the first is views/1\.png", export, images, turned=False)
        Image.new("L", (320, 240)).save(images / NAMES[1])
        raises(ValueError, "leaves out 1 of 4 images", check_images, images, NAMES, single_camera=True)
        raises(ValueError, r"1\.png was matched at 640 x 480 .* reads 320 x 240", export, images, turned=True)
        assert not [*images.glob("*.db*"), *images.glob(".*")]  # nothing is left

"""The estimate of two images, against the true geometry of rendered ones, and its errors."""

import numpy as np
import pytest
import torch
from references import epipolar_distances
from scenes import raises

import kornia_learnnorm as kln
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.reading import read_dataset
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.two_view import estimate_pair as pair_module
from kornia_learnnorm.two_view.estimate_pair import estimate_pair, match_two_images
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")

from two_planes import HEIGHT, WIDTH, F, K, R, t  # noqa: E402 (needs OpenCV)


@pytest.fixture(scope="module")
def images(planes):
    return planes / "left.png", planes / "right.png"


def distances(points: PairEstimate, F_mat) -> np.ndarray:
    """Epipolar distances of the inliers of an estimate."""
    return epipolar_distances(points.points1[points.inliers], points.points2[points.inliers], F_mat)


class TestEstimatePair:
    def test_finds_the_true_geometry(self, result):
        assert result.num_inliers > max(150, 0.8 * result.num_matches)
        assert np.median(distances(result, F)) < 0.3
        # Exact projections of points between and behind the planes, which the estimate has not seen.
        X = np.random.default_rng(2).uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 12.0], (200, 3))
        x1, x2 = X @ K.T, (X @ R.T + t) @ K.T
        assert np.median(epipolar_distances(x1[:, :2] / x1[:, 2:], x2[:, :2] / x2[:, 2:], result.F_mat)) < 0.5

    def test_fields(self, images, result):
        """Among them the matches, which are distinct, and the inliers and errors, which belong to the returned F."""
        assert result.F_mat.dtype == result.points1.dtype == torch.float64
        assert abs(result.F_mat.norm().item() - 1) < 1e-12
        assert np.linalg.svd(result.F_mat.numpy())[1][2] < 1e-12
        assert (result.size1, result.size2) == ((WIDTH, HEIGHT), (WIDTH, HEIGHT))
        assert (result.path1, result.path2) == images
        for points in (result.points1, result.points2):
            assert len(points.unique(dim=0)) == result.num_matches == len(points)
        d = epipolar_distances(result.points1, result.points2, result.F_mat)
        assert np.array_equal(d < 1.0, result.inliers.numpy())
        assert result.median_distance == pytest.approx(np.median(d[d < 1]), rel=1e-6)
        assert 0 < result.predicted_error < 0.5
        assert (result.estimator, result.warnings) == ("RANSAC", ())

    def test_matches_are_estimated_by_several_methods(self, images, result):
        matched = match_two_images(*images)
        assert torch.equal(matched.estimate().F_mat, result.F_mat)
        other = matched.estimate(LearnedEightPoint.from_pretrained("robust-tiny"))
        assert other.estimator == "LearnedEightPoint"
        assert other.weights[other.inliers].mean() > other.weights[~other.inliers].mean() + 0.3
        assert torch.equal(other.points1, result.points1)
        assert not other.F_mat.requires_grad
        assert abs(other.num_inliers - result.num_inliers) < 0.05 * result.num_inliers
        assert np.median(distances(other, F)) < 0.3

    def test_arrays_give_what_files_give(self, images):
        """Grey values of any strides in NumPy, with a mask that leaves nothing out, and colours in PyTorch."""
        grey = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in images]
        turned = [image[::-1, ::-1].copy()[::-1, ::-1] for image in grey]
        colours = [torch.from_numpy(np.stack([image] * 3, -1)) for image in grey]
        expected = vars(match_two_images(*images)) | {"path1": None, "path2": None}
        for arrays, mask in ((turned, torch.ones(HEIGHT, WIDTH, dtype=torch.bool)), (colours, None)):
            torch.testing.assert_close(vars(match_two_images(*arrays, mask1=mask)), expected, rtol=0, atol=0)

    def test_the_size_of_matching(self, images, result):
        """Points and matrices are those of the full image, in which all exact points lie on their lines."""
        found = estimate_pair(*images, max_size=240)
        assert (found.size1, found.size2) == ((WIDTH, HEIGHT), (WIDTH, HEIGHT))
        assert found.points1[:, 0].max() > 240
        assert found.threshold == pytest.approx(WIDTH / 240, rel=0.01)
        assert np.median(distances(result, found.F_mat)) < 0.5
        first, second = (cv2.imread(str(image)) for image in images)
        second = cv2.resize(second, None, fx=2, fy=2)  # a homography's distances are those in image 2
        assert estimate_pair(first, second, max_size=WIDTH, model="homography").threshold == 2

    def test_refined_matches(self, images, result):
        """An untrained refiner moves nothing; the trained one moves points within its bound, nearer to their lines."""
        found, same = (match_two_images(*images, refiner=refiner) for refiner in (None, kln.MatchRefiner()))
        torch.testing.assert_close(same.points1, found.points1, rtol=0, atol=1e-3)
        refiner = kln.MatchRefiner.from_pretrained()
        moved = match_two_images(*images, refiner=refiner)
        assert 0.01 < (moved.points2 - found.points2).norm(dim=1).max() <= refiner.bound / 2 + 1e-6
        assert np.median(distances(estimate_pair(*images, refiner=refiner), F)) < np.median(distances(result, F))

    def test_masks(self, images, result):
        left = np.zeros((HEIGHT, WIDTH), bool)
        left[:, : WIDTH // 2] = True
        found = match_two_images(*images, mask1=left)
        assert found.points1[:, 0].max() < WIDTH // 2
        assert 8 < found.mutual.sum() < result.num_matches

    def test_cameras(self, images):
        found = estimate_pair(*images, K1=K, K2=torch.from_numpy(K))
        assert np.rad2deg(np.arccos((np.trace(found.R.numpy().T @ R) - 1) / 2)) < 0.5
        assert found.t @ torch.from_numpy(t / np.linalg.norm(t)) > np.cos(np.deg2rad(3))
        assert np.allclose(np.linalg.svd(found.E_mat)[1], [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
        assert found.front[found.inliers].double().mean() > 0.95
        E_mat = K.T @ found.F_mat.numpy() @ K
        assert np.allclose(abs((E_mat / np.linalg.norm(E_mat) * found.E_mat.numpy()).sum()), 1)


def test_scores_of_lightglue_are_kept(planes, cached_weights):
    cached_weights("xfeat.pt", "xfeat-lighterglue.pt")
    pair = match_two_images(planes / "left.png", planes / "right.png", detector="xfeat", matcher="lightglue")
    assert pair.ratio is None
    assert pair.mutual.all()
    assert 0.1 < pair.scores.min() < 0.3  # no limit of 0.8 applies
    assert pair.scores.max() <= 1
    found = pair.estimate()
    assert found.as_dict()["ratio"] is None
    assert {*found.scores.tolist()} <= {*pair.scores.tolist()}


class TestErrors:
    def test_images_without_a_matrix(self, planes):
        for first, second, code, message, ratio in [
            ("blank", "right", "blank", r"blank\.png and .*right\.png: image 1 is blank", 0.8),
            ("left", "blank", "blank", "image 2 is blank", 0.8),
            ("left", "right", "few_matches", r"\d distinct matches of \d+ are left, at least 9", 0.001),
            ("left", "left", "no_motion", "no motion", 0.8),
            ("left", "noisy", "no_motion", "no motion", 0.8),
        ]:
            with pytest.raises(NoReliableMatrixError, match=message) as caught:
                estimate_pair(planes / f"{first}.png", planes / f"{second}.png", ratio=ratio)
            assert caught.value.code == code
            assert "\n" not in str(caught.value)

    def test_options_are_checked_before_the_work(self, monkeypatch):
        monkeypatch.setattr(pair_module.images, "read_image", lambda *_: pytest.fail("an image was read"))
        for options, error, message in [
            ({"K1": K, "K2": K * np.nan}, ValueError, "K2 must be finite and invertible"),
            ({"threshold": np.nan}, ValueError, "threshold must be positive"),
            ({"ratio": "x"}, TypeError, "ratio must be a number, got 'x'"),
            *(({"ratio": ratio}, ValueError, "ratio must be above 0") for ratio in (0.0, 1.5, np.nan)),
            ({"refiner": "robust"}, TypeError, "refiner must be a MatchRefiner or None, got str"),
            ({"max_size": 99.5}, TypeError, "max_size must be a whole number, got 99.5"),
            ({"max_size": 10}, ValueError, "max_size must be at least 64"),
            ({"detector": "surf"}, ValueError, "detector must be one of sift, .*, got 'surf'"),
            ({"matcher": "lightglue"}, ValueError, "lightglue needs detector .*, keynet, got sift"),
            ({"detector": "disk", "matcher": "lightglue", "ratio": 0.7}, ValueError, "0.7 is for matcher nearest"),
        ]:
            raises(error, message, estimate_pair, "left.png", "right.png", **options)

    def test_wrong_masks(self, images):
        with pytest.raises(TypeError, match="a mask must be an array of bool, got uint8"):
            match_two_images(*images, mask1=np.ones((HEIGHT, WIDTH), np.uint8))
        with pytest.raises(ValueError, match=r"shape of its image, \(240, 320\), got \(320, 240\)"):
            match_two_images(*images, mask1=np.ones((WIDTH, HEIGHT), bool))

    def test_what_is_no_image(self, planes, images):
        for image, error, message in [
            (np.zeros((8, 8)), TypeError, "an image must .* got float64: try values from 0 to 255 in uint8"),
            (3, TypeError, r"an image must .* got <class 'int'>: try numpy\.asarray"),
            *((np.zeros(s, np.uint8), ValueError, text) for s, text in (((8, 8, 4), ":3"), ((3, 8, 8), "movedim"))),
            ("no.png", FileNotFoundError, r"no\.png does not exist"),
            ("half.png", ValueError, r"half\.png.*truncated or corrupt"),
        ]:
            raises(error, message, estimate_pair, images[0], planes / image if isinstance(image, str) else image)


@pytest.mark.parametrize(
    ("dataset", "options", "first", "inliers", "own", "true"),
    [
        ("kitti", {"sequences": ["06"]}, 40, 500, 0.3, 1.0),
        # Images are not undistorted and poses the nearest in time: the ground truth is good to about 3 px.
        ("tum", {"max_difference": 0.1}, 0, 300, 0.5, 4.0),
    ],
)
def test_real_images(real_data, dataset, options, first, inliers, own, true):
    frames = read_dataset(dataset, real_data / dataset, **options)
    pair = FramePair(*frames[first : first + 2])
    result = estimate_pair(pair.frame1.path, pair.frame2.path)
    assert result.num_inliers > inliers
    assert result.median_distance < own
    assert np.median(distances(result, pair.F)) < true

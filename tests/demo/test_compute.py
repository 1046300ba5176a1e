"""What the page of ``learnnorm demo`` computes, without a browser."""

from __future__ import annotations

import io
import json
import math

import numpy as np
import pytest
import torch
from two_view import epipolar_distances

from kornia_learnnorm.demo import compute as module
from kornia_learnnorm.demo.compute import METHODS, compare, epipolar_segment, read_picture, render_example
from kornia_learnnorm.two_view.estimate_pair import estimate_pair
from kornia_learnnorm.two_view.result import NoReliableMatrixError

pytest.importorskip("cv2", reason="OpenCV is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")


def png(width: int, height: int, value: int = 90) -> bytes:
    """An image file of one grey value."""
    file = io.BytesIO()
    Image.fromarray(np.full((height, width), value, np.uint8)).save(file, "png")
    return file.getvalue()


@pytest.fixture(scope="module")
def example():
    return render_example("Room")


@pytest.fixture(scope="module")
def comparison(example):
    return compare(example.picture1, example.picture2)


class TestPictures:
    def test_the_full_size_is_kept_and_the_pixels_are_reduced(self):
        picture = read_picture("wide.png", png(2400, 30))
        assert (picture.name, picture.size, picture.pixels.shape) == ("wide.png", (2400, 30), (15, 1200, 3))

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "empty"),
            (b"no pixels at all", "not an image"),
            (png(200, 100)[:60], "truncated or corrupt"),
            (png(200, 100) + bytes(3000), "at most 0 MB"),
            (png(400, 300), "400 x 300 pixels, at most 0 million"),
        ],
    )
    def test_bad_files_are_named_without_their_folder(self, monkeypatch, content, message):
        monkeypatch.setattr(module, "MAX_BYTES", 3000)
        monkeypatch.setattr(module, "MAX_PIXELS", 100_000)
        with pytest.raises(ValueError, match=message) as caught:
            read_picture("holiday.png", content)
        assert str(caught.value).startswith("holiday.png ")
        assert "/" not in str(caught.value)


class TestComparison:
    def test_it_is_what_the_command_estimates(self, example, comparison, tmp_path):
        for number, picture in enumerate((example.picture1, example.picture2), 1):
            (tmp_path / f"{number}.png").write_bytes(picture.content)
        expected = estimate_pair(tmp_path / "1.png", tmp_path / "2.png")
        found = comparison.results["RANSAC"]
        assert torch.allclose(found.estimate.F_mat, expected.F_mat, atol=1e-9)
        assert torch.equal(comparison.points1, expected.points1)
        content = json.loads(json.dumps(found.as_dict(), allow_nan=False))
        assert content.keys() == expected.as_dict().keys()
        assert content["image1"] == {"file": "image1.png", "width": 640, "height": 480}

    def test_hartley_takes_all_matches_and_predicts_nothing(self, comparison):
        result = comparison.results["Hartley"]
        points = comparison.points1.numpy(), comparison.points2.numpy()
        distances = epipolar_distances(*points, result.estimate.F_mat.numpy())
        assert np.array_equal(result.estimate.inliers.numpy(), distances < 1)
        assert result.as_dict()["predicted_error_px"] is None
        assert result.estimate.warnings == ()

    def test_the_robust_methods_are_nearer_to_the_truth(self, example, comparison):
        for method in METHODS:
            F_mat = comparison.results[method].estimate.F_mat.numpy()
            expected = np.median(epipolar_distances(example.points1.numpy(), example.points2.numpy(), F_mat))
            assert comparison.true_error(method, example) == pytest.approx(expected, rel=1e-6)
            assert (comparison.true_error(method, example) < 0.5) == (method != "Hartley")
            assert (comparison.distance(method) < 0.5) == (method != "Hartley")
            assert comparison.results[method].seconds > 0

    def test_the_points_of_a_plane_show_no_error(self):
        plane = module.render_example("Plane (F undetermined)")
        assert math.isnan(compare(plane.picture1, plane.picture2).true_error("RANSAC", plane))

    def test_a_method_without_a_matrix_says_why(self, example, monkeypatch):
        def fail(*_):
            raise NoReliableMatrixError("no_consensus", "1 and 2: nothing agrees")

        estimate = module.MatchedPair.estimate
        monkeypatch.setattr(module.MatchedPair, "estimate", lambda self, layer: (fail if layer else estimate)(self))
        failed = compare(example.picture1, example.picture2)
        result = failed.results["Learned"]
        assert (result.estimate, result.failure) == (None, "nothing agrees")
        assert math.isnan(failed.true_error("Learned", example))
        assert math.isnan(failed.distance("Learned"))
        with pytest.raises(ValueError, match="nothing agrees"):
            result.as_dict()

    def test_pairs_without_a_matrix_are_an_error_without_paths(self, example):
        blank = read_picture("blank.png", png(300, 200))
        for second, message in ((example.picture1, "no motion"), (blank, "image 2 is blank")):
            with pytest.raises(NoReliableMatrixError, match=message) as caught:
                compare(example.picture1, second)
            assert "/" not in str(caught.value)


class TestEpipolarSegments:
    @pytest.mark.parametrize("seed", range(20))
    def test_the_ends_lie_on_the_line_and_on_the_border(self, seed):
        generator = torch.Generator().manual_seed(seed)
        F_mat = torch.rand(3, 3, dtype=torch.float64, generator=generator) - 0.5
        F_mat[2] *= 20  # so that some lines meet the image
        line = F_mat.numpy() @ [3.0, 5.0, 1.0]
        ends = epipolar_segment(F_mat, (3.0, 5.0), (40, 30))
        corners = np.array([[-0.5, -0.5, 1], [39.5, -0.5, 1], [39.5, 29.5, 1], [-0.5, 29.5, 1]]) @ line
        assert (ends is not None) == (corners.min() < 0 < corners.max())
        for x, y in ends or ():
            assert abs(line @ [x, y, 1]) < 1e-9 * np.abs(line).sum()
            outside = max(-0.5 - x, x - 39.5, -0.5 - y, y - 29.5)
            assert abs(outside) < 1e-9

    def test_an_epipole_and_a_line_beside_the_image_have_none(self):
        forward = torch.tensor([[0.0, -1, 10], [1, 0, -20], [-10, 20, 0]])
        assert epipolar_segment(forward, (20.0, 10.0), (40, 30)) is None
        sideways = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        assert epipolar_segment(sideways, (3.0, 31.0), (40, 30)) is None

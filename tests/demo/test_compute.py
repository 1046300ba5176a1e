"""What the page of ``learnnorm demo`` computes, without a browser."""

from __future__ import annotations

import io
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import epipolar_distances, uniform

from kornia_learnnorm.data.synthetic.render import render_pair
from kornia_learnnorm.demo import compute as module
from kornia_learnnorm.demo.compute import compare, epipolar_segment, read_file
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
    """A rendered pair of half of the page's size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "render_pair", lambda: render_pair(0, 320, 240))
        return module.render_example.__wrapped__()


@pytest.fixture(scope="module")
def results(example):
    return compare(*example.images)


class TestFiles:
    def test_the_full_size_is_kept_and_the_pixels_are_reduced(self):
        image = read_file("wide.png", png(2400, 30))
        assert (image.name, image.size, image.pixels.shape) == ("wide.png", (2400, 30), (15, 1200, 3))

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "0 bytes"),
            (png(200, 100) + bytes(3000), "at most 0 MB"),
            (png(400, 300), "exceeds limit of 100000 pixels"),
        ],
    )
    def test_bad_files_are_named_without_their_folder(self, monkeypatch, content, message):
        monkeypatch.setattr(module, "MAX_BYTES", 3000)
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 50_000)
        with pytest.raises(ValueError, match=message) as caught:
            read_file("holiday.png", content)
        assert str(caught.value).startswith("holiday.png ")
        assert "/" not in str(caught.value)


class TestCompare:
    def test_it_is_what_the_command_estimates(self, example, results, tmp_path):
        paths = [tmp_path / "1.png", tmp_path / "2.png"]
        for path, image in zip(paths, example.images, strict=True):
            path.write_bytes(image.content)
        expected = estimate_pair(*paths)
        found = results["RANSAC"]
        assert torch.allclose(found.estimate.F_mat, expected.F_mat, atol=1e-9)
        assert torch.equal(found.estimate.points1, expected.points1)
        content = json.loads(json.dumps(found.as_dict(), allow_nan=False))
        assert content.keys() == expected.as_dict().keys()
        assert content["image1"] == {"file": "image1.png", "width": 320, "height": 240}

    def test_the_robust_methods_are_nearer_to_the_truth(self, example, results):
        ransac = results["RANSAC"].estimate
        inliers = ransac.points1[ransac.inliers], ransac.points2[ransac.inliers]
        for method, result in results.items():
            error = result.median_distance(example.points1, example.points2)
            expected = epipolar_distances(example.points1, example.points2, result.estimate.F_mat)
            assert error == pytest.approx(np.median(expected), rel=1e-6)
            assert (error < 0.5) == (method != "Hartley")
            assert (result.median_distance(*inliers) < 0.5) == (method != "Hartley")
            assert result.seconds > 0
        assert results["Hartley"].as_dict()["predicted_error_px"] is None

    def test_a_method_without_a_matrix_says_why(self, example, results, monkeypatch):
        def estimate(matched, layer, model):
            if layer is not None:
                raise NoReliableMatrixError("no_consensus", "1 and 2: nothing agrees")
            return results["RANSAC"].estimate

        monkeypatch.setattr(module.MatchedPair, "estimate", estimate)
        result = compare(*example.images)["Learned"]
        assert (result.estimate, result.failure) == (None, "nothing agrees")
        assert math.isnan(result.median_distance(example.points1, example.points2))
        with pytest.raises(ValueError, match="nothing agrees"):
            result.as_dict()

    def test_pairs_without_a_matrix_are_an_error_without_paths(self, example):
        first, blank = example.images[0], read_file("blank.png", png(300, 200))
        for second, message in ((first, "no motion"), (blank, "image 2 is blank")):
            with pytest.raises(NoReliableMatrixError, match=message) as caught:
                compare(first, second)
            assert "/" not in str(caught.value)


class TestEpipolarSegments:
    @given(st.integers(0, 2**31))
    def test_the_ends_lie_on_the_line_and_on_the_border(self, seed):
        F_mat = uniform(3, 3, low=-0.5, high=0.5, seed=seed)
        F_mat[2] *= 20  # so that some lines meet the image
        line = F_mat.numpy() @ [3.0, 5.0, 1.0]
        ends = epipolar_segment(F_mat, (3.0, 5.0), (40, 30))
        corners = np.array([[-0.5, -0.5, 1], [39.5, -0.5, 1], [39.5, 29.5, 1], [-0.5, 29.5, 1]]) @ line
        assert (ends is not None) == (corners.min() < 0 < corners.max())
        for x, y in () if ends is None else ends:
            assert abs(line @ [x, y, 1]) < 1e-9 * np.abs(line).sum()
            outside = max(-0.5 - x, x - 39.5, -0.5 - y, y - 29.5)
            assert abs(outside) < 1e-9

    def test_an_epipole_and_a_line_beside_the_image_have_none(self):
        forward = torch.tensor([[0.0, -1, 10], [1, 0, -20], [-10, 20, 0]])
        assert epipolar_segment(forward, (20.0, 10.0), (40, 30)) is None
        sideways = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        assert epipolar_segment(sideways, (3.0, 31.0), (40, 30)) is None

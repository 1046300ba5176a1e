"""Pictures of an estimate."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
import torch

from kornia_learnnorm.two_view.drawing import draw_line, draw_pair, import_matplotlib
from kornia_learnnorm.two_view.result import PairEstimate
from kornia_learnnorm.two_view.warnings import PairWarning

pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
image_module = pytest.importorskip("matplotlib.image")


def make_pair(width: int = 160, height: int = 120, points: int = 30) -> tuple[np.ndarray, np.ndarray, PairEstimate]:
    """Two grey images and an estimate whose epipolar lines are the rows; the last five matches are outliers."""
    rng = np.random.default_rng(0)
    image1, image2 = (rng.integers(0, 256, (height, width), dtype=np.uint8) for _ in range(2))
    points1 = torch.from_numpy(rng.uniform(10, [width - 10, height - 10], (points, 2)))
    points2 = points1 + torch.tensor([6.0, 0.0])
    points2[-5:, 1] += 9
    inliers = torch.arange(points) < points - 5
    F_mat = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64) / 2**0.5
    size = (width, height)
    estimate = PairEstimate(
        F_mat=F_mat,
        E_mat=None,
        R=None,
        t=None,
        estimator="RANSAC",
        points1=points1,
        points2=points2,
        scores=torch.ones(points),
        weights=inliers.double(),
        inliers=inliers,
        front=None,
        predicted_error=0.1,
        warnings=(),
        size1=size,
        size2=size,
        ratio=0.8,
        threshold=1.0,
        seed=0,
    )
    return image1, image2, estimate


@pytest.mark.parametrize(
    ("line", "ends"),
    [
        ((0, 1, -5), [(-0.5, 5), (19.5, 5)]),  # y = 5
        ((1e-9, 0, -3e-9), [(3, -0.5), (3, 9.5)]),  # x = 3
        ((-2, 2, 0), [(-0.5, -0.5), (9.5, 9.5)]),  # y = x
    ],
)
def test_draw_line_from_border_to_border(line, ends):
    axes = import_matplotlib().figure.Figure().add_subplot(xlim=(-0.5, 19.5), ylim=(9.5, -0.5))
    drawn = draw_line(axes, np.array(line, float))
    found = (drawn.get_transform() - axes.transData).transform([(0, 0), (1, 1)])
    assert np.allclose(sorted(map(tuple, found)), ends)


def test_draw_line_at_infinity():
    axes = import_matplotlib().figure.Figure().add_subplot()
    assert draw_line(axes, np.array([0.0, 0.0, 1.0])) is None
    assert not axes.lines


class TestDrawPair:
    @pytest.mark.parametrize(("width", "height", "ratio"), [(160, 120, 0.42), (300, 100, 0.75), (90, 120, 0.72)])
    def test_layout_follows_the_shape(self, tmp_path, width, height, ratio):
        draw_pair(*make_pair(width, height), tmp_path / "pair.png")
        picture = image_module.imread(tmp_path / "pair.png")
        assert picture.shape[1] == 1200
        assert picture.shape[0] / picture.shape[1] == pytest.approx(ratio, abs=0.05)
        assert [path.name for path in tmp_path.iterdir()] == ["pair.png"]

    def test_colours_of_inliers_and_outliers(self, tmp_path):
        image1, image2, estimate = make_pair()
        draw_pair(image1, image2, estimate, tmp_path / "pair.png", num_lines=0)
        picture = (image_module.imread(tmp_path / "pair.png")[50:, :590, :3] * 255).round()
        blue = (np.abs(picture - [0x45, 0xA1, 0xFF]).max(2) < 8).sum()
        red = (np.abs(picture - [0xFF, 0x5C, 0x5C]).max(2) < 40).sum()
        assert blue > 200
        assert red > 20

    def test_deterministic_and_seeded(self, tmp_path):
        pair = make_pair()
        for name, seed in (("a", 0), ("b", 0), ("c", 1)):
            draw_pair(*pair, tmp_path / f"{name}.png", num_lines=5, seed=seed)
        a, b, c = (image_module.imread(tmp_path / f"{name}.png") for name in "abc")
        assert np.array_equal(a, b)
        assert not np.array_equal(a, c)

    def test_images_of_different_shapes_and_no_outliers(self, tmp_path):
        image1, image2, estimate = make_pair(300, 100)
        estimate = dataclasses.replace(estimate, size2=(70, 100), inliers=torch.ones(30, dtype=torch.bool))
        draw_pair(image1, image2[:, :70], estimate, tmp_path / "pair.png", num_lines=1000)

    def test_colours_of_the_images(self, tmp_path):
        _, image2, estimate = make_pair()
        green = np.zeros((60, 80, 3), np.uint8)  # half of the size: where the image was large
        green[..., 1] = 255
        draw_pair(green, image2, estimate, tmp_path / "pair.png")
        picture = image_module.imread(tmp_path / "pair.png")[..., :3]
        assert (picture == [0, 1, 0]).all(2).mean() > 0.3

    def test_warnings_are_written_below(self, tmp_path):
        image1, image2, estimate = make_pair()
        draw_pair(image1, image2, estimate, tmp_path / "good.png")
        doubted = dataclasses.replace(estimate, warnings=(PairWarning("planar", "a plane " * 30),))
        draw_pair(image1, image2, doubted, tmp_path / "doubted.png")
        good, bad = (image_module.imread(tmp_path / f"{name}.png") for name in ("good", "doubted"))
        assert bad.shape[0] > good.shape[0] + 40
        assert (np.abs(bad[good.shape[0] :, :, :3] - np.array([0xFF, 0x5C, 0x5C]) / 255).max(2) < 0.1).any()

    @pytest.mark.parametrize("suffix", ["jpg", "webp", "tiff", "pdf", "svg"])
    def test_formats(self, tmp_path, suffix):
        draw_pair(*make_pair(), tmp_path / f"pair.{suffix}")
        assert (tmp_path / f"pair.{suffix}").stat().st_size > 1000

    @pytest.mark.parametrize(
        ("name", "error", "message"),
        [("pair.xyz", ValueError, "not supported"), ("none/pair.png", FileNotFoundError, "does not exist")],
    )
    def test_places_that_are_refused(self, tmp_path, name, error, message):
        with pytest.raises(error, match=message):
            draw_pair(*make_pair(), tmp_path / name)
        assert not list(tmp_path.iterdir())

    def test_wrong_arguments(self, tmp_path):
        image1, image2, estimate = make_pair()
        with pytest.raises(ValueError, match=r"160 x 120 pixels, got shape \(120, 80\)"):
            draw_pair(image1, image2[:, :80], estimate, tmp_path / "pair.png")
        with pytest.raises(ValueError, match="num_lines must not be negative, got -1"):
            draw_pair(image1, image2, estimate, tmp_path / "pair.png", num_lines=-1)

    def test_without_matplotlib(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        with pytest.raises(ImportError, match=r"pip install '\.\[report\]'"):
            draw_pair(*make_pair(), tmp_path / "pair.png")

"""Pictures of an estimate."""

import dataclasses

import numpy as np
import pytest
import torch

from kornia_learnnorm.two_view.drawing import draw_line, draw_pair, import_matplotlib
from kornia_learnnorm.two_view.pair_warnings import PairWarning
from kornia_learnnorm.two_view.result import ModelChoice, PairEstimate

image_module = pytest.importorskip("matplotlib.image")  # Matplotlib may not be installed


def make_pair(width: int = 160, height: int = 120, points: int = 30) -> tuple[np.ndarray, np.ndarray, PairEstimate]:
    """Two grey images and an estimate whose epipolar lines are the rows; the last five matches are outliers."""
    rng = np.random.default_rng(0)
    image1, image2 = (rng.integers(0, 256, (height, width), dtype=np.uint8) for _ in range(2))
    points1 = torch.from_numpy(rng.uniform(10, [width - 10, height - 10], (points, 2)))
    points2 = points1 + torch.tensor([6.0, 0.0])
    points2[-5:, 1] += 9
    inliers = torch.arange(points) < points - 5
    F_mat = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64) / 2**0.5
    matches = (points1, points2, torch.ones(points), inliers.double(), inliers)
    sizes, settings = ((width, height), (width, height)), (0.8, 1.0, 0)  # ratio, threshold, seed
    choice = ModelChoice("fundamental", "")
    estimate = PairEstimate(choice, F_mat, None, "RANSAC", *matches, 0.1, (), *sizes, *settings)
    return image1, image2, estimate


@pytest.fixture(scope="module")
def draw(tmp_path_factory):
    """A function that draws a pair and returns the picture, (H, W, 3)."""
    folder = tmp_path_factory.mktemp("pictures")

    def call(image1, image2, estimate):
        draw_pair(image1, image2, estimate, folder / "pair.png")
        assert [path.name for path in folder.iterdir()] == ["pair.png"]
        return image_module.imread(folder / "pair.png")[..., :3]

    return call


@pytest.fixture(scope="module")
def picture(draw):
    return draw(*make_pair())


def test_draw_line_from_border_to_border():
    for line, ends in [
        ((0, 1, -5), [(-0.5, 5), (19.5, 5)]),  # y = 5
        ((1e-9, 0, -3e-9), [(3, -0.5), (3, 9.5)]),  # x = 3
        ((-2, 2, 0), [(-0.5, -0.5), (9.5, 9.5)]),  # y = x
    ]:
        axes = import_matplotlib().figure.Figure().add_subplot(xlim=(-0.5, 19.5), ylim=(9.5, -0.5))
        drawn = draw_line(axes, np.array(line, float))
        found = (drawn.get_transform() - axes.transData).transform([(0, 0), (1, 1)])
        assert np.allclose(sorted(map(tuple, found)), ends)
        assert draw_line(axes, np.array([0.0, 0.0, 1.0])) is None  # at infinity
        assert len(axes.lines) == 1


class TestDrawPair:
    def test_colours_of_inliers_and_outliers(self, picture):
        levels = (picture[70:, :590] * 255).round()
        blue = (np.abs(levels - [0x45, 0xA1, 0xFF]).max(2) < 8).sum()
        red = (np.abs(levels - [0xFF, 0x5C, 0x5C]).max(2) < 40).sum()
        assert blue > 200
        assert red > 20

    def test_images_of_different_shapes_and_no_outliers(self, draw):
        """Image 1 is three times as wide as high and fills the width, image 2 stands below in its own shape."""
        image1, _, estimate = make_pair(300, 100)
        estimate = dataclasses.replace(estimate, size2=(70, 100), inliers=torch.ones(30, dtype=torch.bool))
        green = np.tile(np.uint8([0, 255, 0]), (100, 70, 1))
        picture = draw(image1, green, estimate)
        height, width = (np.ptp(places) for places in (picture == [0, 1, 0]).all(2).nonzero())
        assert width / height == pytest.approx(0.7, abs=0.02)
        assert picture.shape[0] > 1200 / 3 + height

    def test_a_homography_moves_image_1(self, draw):
        """A shift by half of image 1, which is green, over a magenta image 2: grey where both are."""
        image1, image2 = (np.tile(np.uint8(colour), (120, 160, 1)) for colour in ([0, 255, 0], [255, 0, 255]))
        shift = torch.tensor([[1.0, 0, 80], [0, 1, 0], [0, 0, 1]]).double()
        choice = ModelChoice("homography", "")
        picture = draw(image1, image2, dataclasses.replace(make_pair()[2], choice=choice, H_mat=shift))
        share = [(np.abs(picture - colour).max(2) < 0.01).mean() for colour in ([1, 0, 1], [0.5, 0.5, 0.5])]
        assert share[0] == pytest.approx(share[1], rel=0.1)
        assert share[0] > 0.1

    def test_warnings_are_written_below(self, draw, picture):
        image1, image2, estimate = make_pair()
        doubted = dataclasses.replace(estimate, warnings=(PairWarning("planar", "a plane " * 30),))
        bad = draw(image1, image2, doubted)
        assert bad.shape[0] > picture.shape[0] + 40
        assert (np.abs(bad[picture.shape[0] :] - np.array([0xFF, 0x5C, 0x5C]) / 255).max(2) < 0.1).any()

    def test_what_is_refused(self, tmp_path):
        image1, image2, estimate = make_pair()
        with pytest.raises(ValueError, match=r"160 x 120 pixels, got shape \(120, 80\)"):
            draw_pair(image1, image2[:, :80], estimate, tmp_path / "pair.png")
        with pytest.raises(ValueError, match="not supported"):
            draw_pair(image1, image2, estimate, tmp_path / "pair.xyz")
        assert not list(tmp_path.iterdir())

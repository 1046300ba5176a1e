"""The fundamental matrix of two image files and the command around it."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from make_sequences import texture
from two_view import epipolar_distances

from kornia_learnnorm.cli import estimate as command_module
from kornia_learnnorm.cli.estimate import add_arguments, run
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.reading import read_dataset
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.evaluation import pair as module
from kornia_learnnorm.evaluation.pair import PairEstimate, estimate_pair, write_json
from kornia_learnnorm.files import atomic_write

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")

WIDTH, HEIGHT = 320, 240
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def warp(image: np.ndarray, R: np.ndarray, t: np.ndarray, depth: float) -> np.ndarray:
    """Image 2 of the plane Z = depth: X2 = R X1 + t gives the homography K (R + t n^T / depth) K^-1."""
    H = K @ (R + np.outer(t, [0, 0, 1]) / depth) @ np.linalg.inv(K)
    return cv2.warpPerspective(image, H, (WIDTH, HEIGHT))


class Scene:
    """Two images of two planes, the left half nearer than the right one, and the true F."""

    def __init__(self, folder: Path) -> None:
        R, t = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0], np.array([0.3, 0.05, 0.1])
        self.R, self.t = R, t
        self.F = np.linalg.inv(K).T @ np.cross(t, np.eye(3)).T @ R @ np.linalg.inv(K)
        image, near = texture(0, WIDTH, HEIGHT), np.zeros((HEIGHT, WIDTH), np.uint8)
        near[:, : WIDTH // 2] = 255
        moved = np.where(warp(near, R, t, 4.0) > 127, warp(image, R, t, 4.0), warp(image, R, t, 9.0))
        noisy = np.clip(image + np.random.default_rng(1).normal(0, 1, image.shape), 0, 255).astype(np.uint8)
        images = {"left": image, "right": moved, "blank": np.zeros_like(image), "noisy": noisy}
        for name, pixels in {**images, "plane": warp(image, R, t, 4.0)}.items():
            cv2.imwrite(str(folder / f"{name}.png"), pixels)
        self.folder = folder
        self.left, self.right, self.blank = (folder / f"{name}.png" for name in ("left", "right", "blank"))
        (folder / "half.png").write_bytes(self.left.read_bytes()[:5000])


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def result(scene) -> PairEstimate:
    return estimate_pair(scene.left, scene.right)


class TestEstimatePair:
    def test_finds_the_true_geometry(self, scene, result):
        inlying = result.points1[result.inliers], result.points2[result.inliers]
        assert result.num_inliers > 150
        assert result.num_inliers > 0.8 * result.num_matches
        assert np.median(epipolar_distances(*inlying, scene.F)) < 0.3
        # Exact projections of points between and behind the planes, which the estimate has not seen.
        X = np.random.default_rng(2).uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 12.0], (200, 3))
        x1, x2 = X @ K.T, (X @ scene.R.T + scene.t) @ K.T
        unseen = epipolar_distances(x1[:, :2] / x1[:, 2:], x2[:, :2] / x2[:, 2:], result.F_mat)
        assert np.median(unseen) < 0.5

    def test_fields(self, scene, result):
        """Among them the matches, which are distinct, and the inliers and errors, which belong to the returned F."""
        assert result.F_mat.dtype == result.points1.dtype == torch.float64
        assert result.F_mat.shape == (3, 3)
        assert abs(result.F_mat.norm().item() - 1) < 1e-12
        assert np.linalg.svd(result.F_mat.numpy())[1][2] < 1e-12
        assert result.points1.shape == result.points2.shape == (result.num_matches, 2)
        assert (result.size1, result.size2) == ((WIDTH, HEIGHT), (WIDTH, HEIGHT))
        assert (result.path1, result.path2) == (scene.left, scene.right)
        for points in (result.points1, result.points2):
            assert len(points.unique(dim=0)) == result.num_matches
        assert result.estimator == "RANSAC"
        d = epipolar_distances(result.points1, result.points2, result.F_mat)
        assert np.array_equal(d < 1.0, result.inliers.numpy())
        assert result.mean_distance == pytest.approx(d[d < 1].mean(), rel=1e-6)
        assert result.median_distance == pytest.approx(np.median(d[d < 1]), rel=1e-6)

    def test_seeds(self, scene, result):
        """The same files and seed give the same estimate, other seeds a similar one."""
        again = estimate_pair(str(scene.left), str(scene.right))
        assert torch.equal(again.F_mat, result.F_mat)
        assert torch.equal(again.inliers, result.inliers)
        other = estimate_pair(scene.left, scene.right, seed=7)
        assert abs(other.num_inliers - result.num_inliers) < 0.05 * result.num_inliers

    def test_a_layer_estimates_as_well(self, scene, result):
        layer = LearnedEightPoint.from_pretrained()
        other = estimate_pair(scene.left, scene.right, layer)
        assert other.estimator == "LearnedEightPoint"
        assert torch.equal(other.points1, result.points1)
        assert not other.F_mat.requires_grad
        assert abs(other.num_inliers - result.num_inliers) < 0.05 * result.num_inliers
        inlying = other.points1[other.inliers], other.points2[other.inliers]
        assert np.median(epipolar_distances(*inlying, scene.F)) < 0.3

    def test_matches_that_share_a_point_count_once(self):
        points1 = torch.tensor([[float(10 * i), 5.0] for i in range(12)])
        points2 = points1 + torch.tensor([3.0, 1.0])
        ratios = torch.linspace(0.1, 0.6, 12)
        points2[9:] = points2[3]  # four onto one point, of which the first has the smallest ratio
        points1[8] = points1[2]
        order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
        found = module._one_to_one_matches(points1[order], points2[order], ratios[order], 0.8)
        for value, expected in zip(found, (points1[:8], points2[:8], 1 - ratios[:8].double()), strict=True):
            assert torch.equal(value, expected.double())


class TestErrors:
    @pytest.mark.parametrize(
        ("first", "second", "message", "options"),
        [
            ("left", "half", r"half\.png.*truncated or corrupt", {}),
            ("blank", "right", r"blank\.png and .*right\.png: image 1 is blank", {}),
            ("left", "blank", "image 2 is blank", {}),
            ("left", "right", r"\d distinct matches of \d+ pass the ratio test 0\.001", {"ratio": 0.001}),
            ("left", "left", "no motion", {}),
            ("left", "noisy", "no motion", {}),
            ("left", "right", r"of \d+ matches agree .* within 1e-09 px", {"threshold": 1e-9}),
            ("left", "plane", "degenerate: one homography explains", {}),
            *(("left", "right", "ratio must be above 0", {"ratio": ratio}) for ratio in (0.0, -1.0, 1.5, np.nan)),
            *(("left", "right", "threshold must be positive", {"threshold": t}) for t in (0.0, -1.0, np.inf, np.nan)),
        ],
    )
    def test_images_or_options(self, scene, first, second, message, options):
        with pytest.raises(ValueError, match=message) as caught:
            estimate_pair(scene.folder / f"{first}.png", scene.folder / f"{second}.png", **options)
        assert "\n" not in str(caught.value)

    def test_missing_file(self, scene):
        with pytest.raises(FileNotFoundError, match=r"no\.png does not exist"):
            estimate_pair(scene.left, scene.folder / "no.png")


class TestWriting:
    def test_json(self, result, tmp_path):
        write_json(tmp_path / "F.json", result)
        content = json.loads((tmp_path / "F.json").read_text())
        assert content["F"] == result.F_mat.tolist()
        assert content["matches"] == result.num_matches
        assert content["inliers"] == result.num_inliers
        assert content["image1"] == {"file": str(result.path1), "width": WIDTH, "height": HEIGHT}
        assert content["inlier_symmetric_epipolar_distance_px"]["median"] == result.median_distance
        assert (content["ratio"], content["threshold_px"]) == (0.8, 1.0)
        assert [path.name for path in tmp_path.iterdir()] == ["F.json"]

    @pytest.mark.parametrize(
        ("path", "error", "message"),
        [
            ("none/F.json", FileNotFoundError, "the folder none does not exist"),
            (".", ValueError, "not a regular file"),
            ("/dev/null", ValueError, "not a regular file"),
            ("F.json", PermissionError, "is not writable"),
        ],
    )
    def test_places_that_are_refused(self, result, tmp_path, monkeypatch, path, error, message):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(os, "access", lambda path, mode: False)
        with pytest.raises(error, match=message):
            write_json(path, result)

    def test_failure_keeps_the_old_file(self, tmp_path):
        path = tmp_path / "F.json"
        path.write_text("old")
        with pytest.raises(RuntimeError, match="stop"), atomic_write(path) as temporary:  # noqa: PT012
            temporary.write_text("half")
            raise RuntimeError("stop")
        assert path.read_text() == "old"
        assert [path.name for path in tmp_path.iterdir()] == ["F.json"]


@pytest.fixture
def command(scene, tmp_path, monkeypatch):
    """Run the command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments, images=(scene.left, scene.right)):
        parser = argparse.ArgumentParser()
        add_arguments(parser)
        return run(parser.parse_args([*map(str, images), *arguments]))

    return call


class TestCommand:
    def test_prints_the_estimate(self, command, result, capsys):
        assert command() == 0
        lines = capsys.readouterr().out.splitlines()
        printed = [[float(value) for value in line.split()] for line in lines[1:4]]
        assert np.allclose(printed, result.F_mat.numpy(), rtol=1e-8)
        assert re.match(r"by +RANSAC", lines[4])
        assert re.match(rf"matches +{result.num_matches} \(ratio test 0\.8\)", lines[5])
        assert re.match(rf"inliers +{result.num_inliers} ", lines[6])
        assert f"mean {result.mean_distance:.3f} px, median {result.median_distance:.3f} px" in lines[7]
        assert len(lines) == 8
        assert not list(Path().iterdir())

    def test_writes_picture_and_json(self, command, capsys):
        pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
        LearnedEightPoint.from_pretrained("robust").save_pretrained("mine.safetensors")
        assert (
            command("--out", "pair.png", "--json", "F.json", "--estimator", "learned", "--weights", "mine.safetensors")
            == 0
        )
        Path("mine.safetensors").unlink()
        assert sorted(path.name for path in Path().iterdir()) == ["F.json", "pair.png"]
        assert cv2.imread("pair.png").shape[1] == 1200
        assert capsys.readouterr().out.splitlines()[-2:] == ["wrote    pair.png", "wrote    F.json"]
        command("--ratio", "0.7", "--threshold", "2")
        printed = capsys.readouterr().out
        assert "(ratio test 0.7)" in printed
        assert "< 2 px" in printed

    @pytest.mark.parametrize(
        ("arguments", "error", "message"),
        [
            (["--out", "pair.txt"], ValueError, r"--out pair\.txt: expected a name that ends in one of \.png"),
            (["--out", "pair"], ValueError, "--out pair: expected"),
            (["--out", "none/pair.png"], FileNotFoundError, "folder none does not exist"),
            (["--json", "none/F.json"], FileNotFoundError, "folder none does not exist"),
            (["--json", "."], ValueError, "not a regular file"),
            (["--out", "a.png", "--json", "a.png"], ValueError, "would overwrite another file"),
            (["--out", "pair.png"], ImportError, r"pip install '\.\[report\]'"),  # without Matplotlib
            (["--weights", "robust"], ValueError, "--weights robust: only --estimator learned has weights"),
        ],
    )
    def test_bad_outputs_are_refused_before_the_work(self, command, arguments, error, message, monkeypatch, capsys):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        monkeypatch.setattr(command_module, "estimate_pair", lambda *_: pytest.fail("the work was begun"))
        with pytest.raises(error, match=message):
            command(*arguments)
        assert not list(Path().iterdir())
        assert capsys.readouterr().out == ""

    def test_images_are_not_overwritten(self, command, scene):
        with pytest.raises(ValueError, match=r"--out .*left\.png: would overwrite"):
            command("--out", str(scene.left))

    def test_failures_write_nothing(self, command, scene, monkeypatch, capsys):
        """Not even the picture, when the last step fails."""

        def full(path, estimate):
            Path(path).write_text("half")
            raise OSError("no space left")

        monkeypatch.setattr(command_module, "write_json", full)
        for second, error, message in (
            (scene.blank, ValueError, "image 2 is blank"),
            (scene.right, OSError, "no space left"),
        ):
            with pytest.raises(error, match=message):
                command("--out", "pair.png", "--json", "F.json", images=(scene.left, second))
            assert not list(Path().iterdir())
            assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("dataset", "options", "first", "inliers", "own", "true"),
    [
        *(("kitti", {"sequences": ["06"]}, first, 500, 0.3, 1.0) for first in (10, 20, 40)),
        # Images are not undistorted and poses the nearest in time: the ground truth is good to about 3 px.
        *(("tum", {"max_difference": 0.1}, first, 300, 0.5, 4.0) for first in (0, 12)),
    ],
)
def test_real_images(real_data, dataset, options, first, inliers, own, true):
    frames = read_dataset(dataset, real_data / dataset, **options)
    pair = FramePair(*frames[first : first + 2])
    result = estimate_pair(pair.frame1.path, pair.frame2.path)
    assert result.num_inliers > inliers
    assert result.median_distance < own
    inlying = result.points1[result.inliers], result.points2[result.inliers]
    assert np.median(epipolar_distances(*inlying, pair.F)) < true


@pytest.mark.parametrize(("inliers", "chance"), [(12, True), (16, True), (29, False), (60, False)])
def test_support_that_chance_would_give(inliers, chance):
    """By hand for 12 of 100 in 1226 x 370: 10^(15.0 + 2.9 + 2.0 - 5 * 2.25) models expected, far more than one."""
    message = f"{inliers} of 100 matches agree .* no more than chance would give"
    with pytest.raises(ValueError, match=message) if chance else contextlib.nullcontext():
        module._check_chance(100, inliers, 1.0, (370, 1226))

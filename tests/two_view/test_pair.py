"""The fundamental matrix of two image files and the command around it."""

from __future__ import annotations

import argparse
import json
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
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.reading import read_dataset
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.two_view import pair as pair_module
from kornia_learnnorm.two_view.many_pairs import read_pair_list
from kornia_learnnorm.two_view.pair import estimate_pair, match_pair
from kornia_learnnorm.two_view.pair_estimate import NoReliableMatrixError, PairEstimate

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
        assert 0 < result.predicted_error < 0.5
        assert result.warnings == ()
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

    def test_arrays_give_what_files_give(self, scene, result):
        """Grey values and colours, NumPy and PyTorch."""
        grey = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (scene.left, scene.right)]
        colours = [torch.from_numpy(np.stack([image] * 3, -1)) for image in grey]
        for images in (grey, colours):
            found = estimate_pair(*images)
            assert torch.equal(found.F_mat, result.F_mat)
            assert (found.path1, found.path2) == (None, None)

    def test_the_size_of_matching(self, scene, result):
        """Points and matrices are those of the full image, in which all exact points lie on their lines."""
        found = estimate_pair(scene.left, scene.right, max_size=240)
        assert (found.size1, found.size2) == ((WIDTH, HEIGHT), (WIDTH, HEIGHT))
        assert found.points1[:, 0].max() > 240
        assert found.threshold == pytest.approx(WIDTH / 240, rel=0.01)
        inlying = result.points1[result.inliers], result.points2[result.inliers]
        assert np.median(epipolar_distances(*inlying, found.F_mat)) < 0.5

    def test_masks(self, scene, result):
        left = np.zeros((HEIGHT, WIDTH), bool)
        left[:, : WIDTH // 2] = True
        found = estimate_pair(scene.left, scene.right, mask1=left)
        assert found.points1[:, 0].max() < WIDTH // 2
        assert found.num_matches < result.num_matches
        with pytest.raises(ValueError, match=r"shape of its image, \(240, 320\), got \(320, 240\)"):
            estimate_pair(scene.left, scene.right, mask2=left.T)

    def test_arrays_of_any_strides(self, scene, result):
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[::-1, ::-1].copy() for path in (scene.left, scene.right)]
        mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        found = estimate_pair(*(image[::-1, ::-1] for image in images), mask1=mask)
        assert torch.equal(found.F_mat, result.F_mat)

    def test_cameras(self, scene):
        found = estimate_pair(scene.left, scene.right, K1=K, K2=torch.from_numpy(K))
        angle = np.rad2deg(np.arccos((np.trace(found.R.numpy().T @ scene.R) - 1) / 2))
        assert angle < 0.5
        assert found.t @ torch.from_numpy(scene.t / np.linalg.norm(scene.t)) > np.cos(np.deg2rad(3))
        assert np.allclose(np.linalg.svd(found.E_mat)[1], [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
        assert found.front[found.inliers].double().mean() > 0.95
        E_mat = K.T @ found.F_mat.numpy() @ K
        assert np.allclose(abs((E_mat / np.linalg.norm(E_mat) * found.E_mat.numpy()).sum()), 1)
        with pytest.raises(ValueError, match="K1 and K2 must be given together"):
            estimate_pair(scene.left, scene.right, K1=K)


def test_matches_of_one_pair_are_estimated_by_several_methods(scene):
    layer = LearnedEightPoint.from_pretrained("robust-tiny")
    matched = match_pair(scene.left, scene.right, max_size=160)
    assert (matched.size1, matched.full_size1, matched.scale) == ((160, 120), (WIDTH, HEIGHT), 0.5)
    for method in (None, layer):
        expected = estimate_pair(scene.left, scene.right, method, max_size=160)
        found = matched.estimate(method)
        assert found.estimator == expected.estimator
        assert (found.size1, found.path1) == ((WIDTH, HEIGHT), scene.left)
        assert torch.equal(found.points1, expected.points1)
        assert torch.allclose(found.F_mat, expected.F_mat, atol=1e-9)


class TestErrors:
    @pytest.mark.parametrize(
        ("first", "second", "message", "options"),
        [
            ("left", "half", r"half\.png.*truncated or corrupt", {}),
            ("blank", "right", r"blank\.png and .*right\.png: image 1 is blank", {}),
            ("left", "blank", "image 2 is blank", {}),
            ("left", "right", r"\d distinct matches of \d+ are left, at least 9", {"ratio": 0.001}),
            ("left", "left", "no motion", {}),
            ("left", "noisy", "no motion", {}),
            ("left", "right", r"of \d+ matches agree .* within 1e-09 px", {"threshold": 1e-9}),
            ("left", "right", "detector must be one of sift, .*, got 'surf'", {"detector": "surf"}),
            ("left", "right", "max_size must be at least 64", {"max_size": 10}),
            *(("left", "right", "ratio must be above 0", {"ratio": ratio}) for ratio in (0.0, -1.0, 1.5, np.nan)),
            *(("left", "right", "threshold must be positive", {"threshold": t}) for t in (0.0, -1.0, np.inf, np.nan)),
        ],
    )
    def test_images_or_options(self, scene, first, second, message, options):
        with pytest.raises(ValueError, match=message) as caught:
            estimate_pair(scene.folder / f"{first}.png", scene.folder / f"{second}.png", **options)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            ({"K1": np.zeros((3, 3)), "K2": K}, ValueError, "K1 must be finite and invertible"),
            ({"K1": K, "K2": K * np.nan}, ValueError, "K2 must be finite and invertible"),
            ({"K1": K[None], "K2": K}, ValueError, r"K1 must have shape \[3, 3\], got \[1, 3, 3\]"),
            ({"K1": K}, ValueError, "K1 and K2 must be given together"),
            ({"threshold": "x"}, TypeError, "threshold must be a number, got 'x'"),
            ({"ratio": "x"}, TypeError, "ratio must be a number, got 'x'"),
            ({"max_size": 99.5}, TypeError, "max_size must be a whole number, got 99.5"),
            ({"seed": -1}, ValueError, "seed must lie in"),
            ({"layer": K}, TypeError, "layer must be a LearnedEightPoint or None"),
            ({"matcher": "lightglue"}, ValueError, "matcher lightglue needs detector disk, got sift"),
        ],
    )
    def test_options_are_checked_before_the_work(self, options, error, message, monkeypatch):
        monkeypatch.setattr(pair_module, "read_image", lambda *_: pytest.fail("an image was read"))
        with pytest.raises(error, match=message):
            estimate_pair("left.png", "right.png", **options)

    def test_masks_of_other_types(self, scene):
        with pytest.raises(TypeError, match="a mask must be an array of bool, got uint8"):
            estimate_pair(scene.left, scene.right, mask1=np.ones((HEIGHT, WIDTH), np.uint8))

    @pytest.mark.parametrize(("second", "code"), [("blank", "blank"), ("left", "no_motion"), ("noisy", "no_motion")])
    def test_images_without_a_matrix(self, scene, second, code):
        with pytest.raises(NoReliableMatrixError) as caught:
            estimate_pair(scene.left, scene.folder / f"{second}.png")
        assert caught.value.code == code

    def test_a_plane_is_doubted(self, scene):
        found = estimate_pair(scene.left, scene.folder / "plane.png")
        assert "planar" in [warning.code for warning in found.warnings]
        assert "\nwarning  planar: one homography explains" in found.summary()

    @pytest.mark.parametrize("image", [np.zeros((8, 8)), np.zeros((8, 8, 4), np.uint8), 3])
    def test_arrays_that_are_no_images(self, scene, image):
        with pytest.raises((TypeError, ValueError), match="an image must"):
            estimate_pair(image, scene.right)

    def test_missing_file(self, scene):
        with pytest.raises(FileNotFoundError, match=r"no\.png does not exist"):
            estimate_pair(scene.left, scene.folder / "no.png")


class TestWriting:
    def test_json(self, result):
        content = json.loads(json.dumps(result.as_dict(), allow_nan=False))
        assert content["F"] == result.F_mat.tolist()
        assert (content["E"], content["R"], content["t"], content["in_front"]) == (None, None, None, None)
        assert (content["num_matches"], content["num_inliers"]) == (result.num_matches, result.num_inliers)
        for name in ("points1", "points2", "scores", "weights", "inliers"):
            assert content[name] == getattr(result, name).tolist()
        assert content["image1"] == {"file": str(result.path1), "width": WIDTH, "height": HEIGHT}
        assert (content["predicted_error_px"], content["warnings"]) == (result.predicted_error, [])
        assert (content["estimator"], content["seed"]) == ("RANSAC", 0)
        assert (content["ratio"], content["threshold_px"]) == (0.8, 1.0)
        assert content["versions"]["torch"] == torch.__version__.split("+")[0] or "+" in content["versions"]["torch"]

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
        assert re.match(r"by +RANSAC, seed 0", lines[4])
        assert re.match(rf"matches +{result.num_matches} \(ratio test 0\.8\)", lines[5])
        assert re.match(rf"inliers +{result.num_inliers} ", lines[6])
        assert f"predicted error of F: {result.predicted_error:.2f} px (typical error of epipolar lines" in lines[7]
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

    def test_json_to_standard_output(self, command, result, capsys):
        assert command("--json", "-", "--K", "300,300,160,120") == 0
        content = json.loads(capsys.readouterr().out)
        assert content["num_matches"] == result.num_matches
        assert np.array(content["R"]).shape == (3, 3)

    def test_exit_codes(self, command, scene, capsys):
        """3 with a warning, and where there is no matrix; nothing is written in the latter case."""
        assert command("--json", "F.json", images=(scene.left, scene.folder / "plane.png")) == 3
        assert "warning  planar: one homography explains" in capsys.readouterr().out
        assert "planar" in [warning["code"] for warning in json.loads(Path("F.json").read_text())["warnings"]]
        Path("F.json").unlink()
        assert command("--json", "F.json", images=(scene.left, scene.left)) == 3
        captured = capsys.readouterr()
        assert captured.out == "wrote    F.json\n"
        assert "no reliable matrix (no_motion): " in captured.err
        failure = json.loads(Path("F.json").read_text())
        assert [failure[name] for name in ("F", "E", "R", "t", "predicted_error_px")] == [None] * 5
        assert [warning["code"] for warning in failure["warnings"]] == ["no_motion"]
        assert "no motion" in failure["warnings"][0]["text"]
        assert failure["image1"] == {"file": str(scene.left), "width": WIDTH, "height": HEIGHT}
        assert (failure["estimator"], failure["seed"], failure["ratio"], failure["threshold_px"]) == (
            "RANSAC",
            0,
            0.8,
            1,
        )
        assert command("--json", "-", "--out", "pair.png", images=(scene.left, scene.left)) == 3
        assert json.loads(capsys.readouterr().out) == failure
        assert [path.name for path in Path().iterdir()] == ["F.json"]

    def test_masks(self, command, result, capsys):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, WIDTH // 2 :] = 0
        cv2.imwrite("mask.png", mask)
        command("--mask", "mask.png")
        matches = int(re.search(r"matches +(\d+)", capsys.readouterr().out)[1])
        assert 8 <= matches < result.num_matches

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
            (["--K", "1,2"], ValueError, "camera 1,2: expected fx,fy,cx,cy, .* got 2 numbers"),
            (["--K", "a", "b", "c"], ValueError, "--K: one value for both images or one for each expected, got 3"),
            (["--mask", "none.png"], FileNotFoundError, "none.png"),
            (["--jobs", "3"], ValueError, "--jobs: only for --pairs LIST, which was not given"),
            (["--jobs", "3", "--dask", "tcp://a:1"], ValueError, "--jobs and --dask: only for --pairs"),
            (["--pairs", "l.txt"], ValueError, r"--pairs l\.txt: cannot be combined with image files$"),
            (["--pairs", "l.txt", "--json", "-"], ValueError, "cannot be combined with image files and --json$"),
            (["--matcher", "lightglue"], ValueError, "matcher lightglue needs detector disk, got sift"),
            (["--ratio", "2"], ValueError, "ratio must be above 0 and at most 1, got 2"),
            (["--weights", "robust"], ValueError, "--weights robust: only --estimator learned has weights"),
        ],
    )
    def test_bad_outputs_are_refused_before_the_work(self, command, arguments, error, message, monkeypatch, capsys):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        monkeypatch.setattr(command_module, "estimate_pair", lambda *_, **__: pytest.fail("the work was begun"))
        with pytest.raises(error, match=message):
            command(*arguments)
        assert not list(Path().iterdir())
        assert capsys.readouterr().out == ""

    @pytest.mark.parametrize("seed", ["-1", "1.5", "x", str(2**63)])
    def test_seeds_are_checked_while_parsing(self, command, seed, capsys):
        with pytest.raises(SystemExit, match="2"):
            command("--seed", seed)
        assert f"a whole number from 0 to 2^63 - 1 expected, got {seed}" in capsys.readouterr().err

    def test_help_fits_a_screen(self, monkeypatch, capsys):
        monkeypatch.setenv("COLUMNS", "100")
        with pytest.raises(SystemExit, match="0"):
            main(["estimate", "--help"])
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) <= 45
        assert max(map(len, lines)) <= 100
        assert [line.split()[:2] for line in lines[-2:]] == [["learnnorm", "estimate"]] * 2

    def test_images_are_not_overwritten(self, command, scene):
        with pytest.raises(ValueError, match=r"--out .*left\.png: would overwrite"):
            command("--out", str(scene.left))

    def test_failures_write_nothing(self, command, monkeypatch, capsys):
        """Not even the picture, when the last step fails."""

        def full(path, text):
            Path(path).write_text("half")
            raise OSError("no space left")

        monkeypatch.setattr(command_module, "write_text", full)
        with pytest.raises(OSError, match="no space left"):
            command("--out", "pair.png", "--json", "F.json")
        assert not list(Path().iterdir())
        assert capsys.readouterr().out == ""


class TestManyPairs:
    def test_one_line_a_pair_and_what_is_done_stays(self, command, scene, result, monkeypatch, capsys):
        names = [("left", "right"), ("left", "blank"), ("left", "half")]
        Path("list.txt").write_text("".join(f"{scene.folder}/{a}.png {scene.folder}/{b}.png\n\n" for a, b in names[:2]))
        many = ("--pairs", "list.txt", "--out", "found", "--jobs", "1")
        assert command(*many, images=()) == 3
        printed = capsys.readouterr()
        assert printed.out.endswith("wrote found: 1 of 2 pairs solved, 1 failed\n")
        assert f"failed: {scene.left} {scene.blank}: " in printed.err
        assert "(blank)" in printed.err
        path = Path("found/pairs.jsonl")
        first = path.read_text()
        path.write_text(first + '{"F": nu')  # as a killed run leaves it
        with Path("list.txt").open("a") as file:
            file.write(f"{scene.folder}/left.png {scene.folder}/half.png\n")
        assert command(*many, images=()) == 3
        assert path.read_text().startswith(first)
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        assert [line["warnings"][0]["code"] if line["warnings"] else None for line in lines] == [
            None,
            "blank",
            "unreadable",
        ]
        assert np.allclose(lines[0]["F"], result.F_mat)
        assert lines[1]["F"] is None
        assert lines[1]["image2"] == {"file": str(scene.blank), "width": WIDTH, "height": HEIGHT}
        assert lines[1]["versions"] == lines[0]["versions"]
        with pytest.raises(ValueError, match="results with other options"):
            command(*many, "--ratio", "0.7", images=())

    def test_failures_and_warnings_are_counted_apart(self, capsys):
        warning = [{"code": "why", "text": "A reason"}]
        images = {"image1": {"file": "a"}, "image2": {"file": "b"}}
        solved, doubtful, failed = (
            {"F": F, "warnings": w, **images} for F, w in ((1, []), (1, warning), (None, warning))
        )
        command_module._print_pairs([solved, solved], Path("found"))
        command_module._print_pairs([solved, doubtful, *7 * [failed]], Path("found"))
        printed = capsys.readouterr()
        assert printed.out.splitlines() == [
            "wrote found: 2 of 2 pairs solved",
            "wrote found: 2 of 9 pairs solved, 7 failed; 1 solved with warnings",
        ]
        *named, more = printed.err.splitlines()
        assert named == 5 * ["failed: a b: A reason (why)"]
        assert more.startswith("and 2 more: ")

    def test_names_with_spaces_and_comments(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("list.txt").write_text("# two images\n'a b.png' c.png\n")
        assert read_pair_list("list.txt") == [(Path("a b.png"), Path("c.png"))]

    def test_what_was_unreadable_is_tried_again(self, command, scene):
        Path("list.txt").write_text(f"{scene.folder}/left.png late.png\n")
        many = ("--pairs", "list.txt", "--out", "found", "--jobs", "1")
        assert command(*many, images=()) == 3
        Path("late.png").write_bytes(scene.right.read_bytes())
        assert command(*many, images=()) == 0
        (line,) = Path("found/pairs.jsonl").read_text().splitlines()
        assert json.loads(line)["warnings"] == []

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (["--out", "file"], ValueError, "--out file: a folder expected with --pairs, got a file"),
            ([], ValueError, "--out FOLDER is needed"),
            (["--out", "found", "--mask", "a.png"], ValueError, r"--pairs list\.txt: cannot be combined with --mask$"),
            (["--out", "found", "--jobs", "2", "--dask", "tcp://a:1"], ValueError, "exclude each other"),
            (["--out", "found", "--threshold", "-1"], ValueError, "threshold must be positive"),
            (["--out", "found", "--estimator", "learned", "--weights", "no"], (ValueError, OSError), "no"),
        ],
    )
    def test_bad_options_are_refused_before_the_work(self, command, scene, options, error, message):
        Path("list.txt").write_text(f"{scene.left} {scene.right}\n")
        Path("file").write_text("")
        with pytest.raises(error, match=message):
            command("--pairs", "list.txt", *options, images=())
        assert not Path("found").exists()

    def test_cameras_are_read_before_the_work(self, command, scene):
        Path("list.txt").write_text(f"{scene.left} {scene.right}\n")
        with pytest.raises(FileNotFoundError, match=r"camera none\.txt"):
            command("--pairs", "list.txt", "--out", "found", "--K", "none.txt", images=())
        assert not Path("found").exists()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("'a.png b.png\n", "line 1: No closing quotation"),
            ("a.png b.png c.png\n", "line 1: two image files expected, got 3"),
            ("\n", "lists no pairs"),
        ],
    )
    def test_bad_lists(self, command, text, message):
        Path("list.txt").write_text(text)
        with pytest.raises(ValueError, match=message):
            command("--pairs", "list.txt", "--out", "found", images=())
        assert not Path("found").exists()


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

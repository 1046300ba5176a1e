"""The command ``learnnorm estimate`` on one pair and on many."""

import argparse
import csv
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import raises

from kornia_learnnorm.cli import estimate as command_module
from kornia_learnnorm.cli.estimate import add_arguments, run
from kornia_learnnorm.two_view.many_pairs import read_pair_list

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")

from two_planes import HEIGHT, WIDTH, K, R, t  # noqa: E402 (needs OpenCV)

MANY = ["--pairs", "list.txt"]


@pytest.fixture
def command(planes, tmp_path, monkeypatch):
    """Run the command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments, images=("left", "right")):
        parser = argparse.ArgumentParser()
        add_arguments(parser)
        return run(parser.parse_args([*(f"{planes}/{name}.png" for name in images), *arguments]))

    return call


class TestOnePair:
    def test_prints_the_estimate(self, command, result, capsys):
        assert command() == 0
        lines = capsys.readouterr().out.splitlines()
        printed = [[float(value) for value in line.split()] for line in lines[1:4]]
        assert np.allclose(printed, result.F_mat.numpy(), rtol=1e-8)
        about = re.sub(" +", " ", "\n".join(lines[4:]))
        for fact in ("model fundamental", "RANSAC, seed 0", "ratio test 0.8", f"{result.predicted_error:.2f} px"):
            assert fact in about
        assert f"\nmatches {result.num_matches} (" in about
        assert f"\ninliers {result.num_inliers} " in about
        assert not list(Path().iterdir())

    def test_writes_picture_and_json(self, command, capsys):
        pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
        estimator = ("--estimator", "learned", "--weights", "robust-tiny", "--ratio", "0.7", "--threshold", "2")
        assert command("--out", "pair.png", "--json", "F.json", *estimator) == 0
        assert sorted(path.name for path in Path().iterdir()) == ["F.json", "pair.png"]
        assert cv2.imread("pair.png").shape[1] == 1200
        printed = capsys.readouterr().out
        assert printed.splitlines()[-2:] == ["wrote    pair.png", "wrote    F.json"]
        assert all(text in printed for text in ("by       LearnedEightPoint", "(ratio test 0.7)", "< 2 px"))

    def test_exit_codes(self, command, planes, capsys):
        """4 with a warning, 3 where there is no matrix; no picture is written in the latter case."""
        plane = ("--model", "fundamental", "--json", "F.json")
        assert command("--strict", *plane, images=("left", "plane")) == 3
        assert command(*plane, images=("left", "plane")) == 4
        assert "points1" not in json.loads(Path("F.json").read_text())
        assert "\nwarning  planar: one homography explains" in capsys.readouterr().out
        assert "planar" in [warning["code"] for warning in json.loads(Path("F.json").read_text())["warnings"]]
        assert command("--K", "600,600,320,240") == 4  # of images of twice the size
        assert "\nwarning  cameras: the principal point of K1" in capsys.readouterr().out
        assert command("--json", "F.json", "--out", "pair.png", images=("left", "left")) == 3
        captured = capsys.readouterr()
        assert captured.out == "wrote    F.json\n"
        assert "no reliable matrix (no_motion): " in captured.err
        failure = json.loads(Path("F.json").read_text())
        assert [failure[name] for name in ("model", "choice", "F", "R", "other_pose", "num_inliers")] == [None] * 6
        assert [warning["code"] for warning in failure["warnings"]] == ["no_motion"]
        assert failure["image1"] == {"file": f"{planes}/left.png", "width": WIDTH, "height": HEIGHT}
        assert [failure[name] for name in ("estimator", "seed", "ratio", "threshold_px")] == ["RANSAC", 0, 0.8, 1]
        assert [path.name for path in Path().iterdir()] == ["F.json"]

    def test_a_plane_is_solved_by_its_homography(self, command, capsys):
        pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
        camera = ("--K", "300,300,160,120")
        assert command("--out", "pair.png", "--json", "H.json", *camera, images=("left", "plane")) == 0
        assert capsys.readouterr().out.startswith("H (x2 ~ H x1 in pixels, unit Frobenius norm)\n")
        content = json.loads(Path("H.json").read_text())
        assert (content["model"], content["warnings"]) == ("homography", [])
        true = K @ (R + np.outer(t, [0, 0, 1]) / 4) @ np.linalg.inv(K)
        assert np.allclose(content["H"], true / np.linalg.norm(true), atol=2e-3)
        assert cv2.imread("pair.png").shape[1] == 1200

    def test_mask_camera_refined_matches_and_json_to_standard_output(self, command, result, capsys):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, WIDTH // 2 :] = 0
        cv2.imwrite("mask.png", mask)
        command("--mask", "mask.png", "--json", "-", "--matches", "--K", "300,300,160,120", "--refine", "2")
        content = json.loads(capsys.readouterr().out)
        assert np.array(content["R"]).shape == (3, 3)
        assert max(np.array(content[name])[:, 0].max() for name in ("points1", "points2")) < WIDTH // 2
        assert not {*map(tuple, content["points1"])} & {*map(tuple, result.points1.tolist())}  # all have moved
        assert 8 <= content["num_matches"] < result.num_matches

    def test_bad_options_are_refused_before_the_work(self, command, planes, monkeypatch):
        Path("list.txt").write_text(f"{planes}/left.png {planes}/right.png\n")
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        monkeypatch.setattr(command_module, "estimate_pair", lambda *_, **__: pytest.fail("the work was begun"))
        for arguments, error, message in [
            (["--refine", "-1"], ValueError, "refine must be from 0 to 100 passes, got -1"),
            (["--matches"], ValueError, "--matches: only for --json or --pairs"),
            (["--out", "pair.txt"], ValueError, r"--out pair\.txt: expected a name that ends in one of \.png"),
            (["--json", "none/F.json"], FileNotFoundError, "folder none does not exist"),
            (["--out", f"{planes}/left.png"], ValueError, r"--out .*left\.png: would overwrite"),
            (["--K", "list.txt", "--json", "list.txt"], ValueError, r"--json list\.txt: would overwrite"),
            (["--out", "pair.png"], ImportError, r"pip install '\.\[report\]'"),  # without Matplotlib
            (["--K", "1,2"], ValueError, "camera 1,2: expected fx,fy,cx,cy, .* got 2 numbers"),
            (["--K", "a", "b", "c"], ValueError, "--K: one value for both images or one for each expected, got 3"),
            (["--estimator", "learned", "--model", "homography"], ValueError, "only for fundamental matrices"),
            (["--dask", "tcp://a:1"], ValueError, "--dask: only for --pairs"),
            (["--gap", "2"], ValueError, "--gap or --exhaustive: only for --pairs"),
            (["--pairs", "l.txt", "--json", "-"], ValueError, "cannot be combined with image files and --json$"),
            (["--weights", "robust"], ValueError, "--weights robust: only --estimator learned has weights"),
            ([*MANY, "--out", "list.txt"], ValueError, r"--out list\.txt: a folder expected with --pairs, got a file"),
            (MANY, ValueError, "--out FOLDER is needed"),
            ([*MANY, "--out", "o", "--mask", "a.png"], ValueError, r"--pairs list\.txt: cannot .* with --mask$"),
            ([*MANY, "--out", "o", "--estimator", "learned", "--weights", "no"], OSError, "no"),
            ([*MANY, "--out", "o", "--K", "none.txt"], FileNotFoundError, r"camera none\.txt"),
            ([*MANY, "--out", "o", "--exhaustive"], ValueError, r"--gap and --exhaustive are for a folder of images"),
            ([*MANY, "--out", "o", "--exhaustive", "--gap", "1"], SystemExit, "2"),  # one excludes the other
        ]:
            raises(error, message, command, *arguments, images=() if arguments[:2] == MANY else ("left", "right"))
            assert [*Path().iterdir()] == [Path("list.txt")]


class TestManyPairs:
    def test_one_line_a_pair_and_what_is_done_stays(self, command, planes, result, capsys):
        options, path = (*MANY, "--out", "found", "--jobs", "1"), Path("found/pairs.jsonl")
        Path("list.txt").write_text(f"{planes}/left.png {planes}/right.png\n\n{planes}/left.png late.png\n")
        Path("late.png").write_bytes((planes / "half.png").read_bytes())
        assert command(*options, images=()) == 3
        printed = capsys.readouterr()
        assert printed.out.endswith("wrote found: 1 of 2 pairs solved, 1 failed\n")
        assert f"failed: {planes}/left.png late.png: " in printed.err
        first = path.read_text()
        lines = [json.loads(line) for line in first.splitlines()]
        assert [[warning["code"] for warning in line["warnings"]] for line in lines] == [[], ["unreadable"]]
        assert np.allclose(lines[0]["F"], result.F_mat)
        assert (lines[1]["F"], lines[1]["versions"]) == (None, lines[0]["versions"])
        with pytest.raises(ValueError, match=r"results of other options, write elsewhere: ratio \S+, now 0\.7$"):
            command(*options, "--ratio", "0.7", images=())
        path.write_text(first + '{"F": nu')  # as a killed run leaves it
        Path("late.png").write_bytes((planes / "blank.png").read_bytes())  # what was unreadable is tried again
        assert command(*options, images=()) == 3
        solved, failed = path.read_text().splitlines()
        assert solved == first.splitlines()[0]
        assert [warning["code"] for warning in json.loads(failed)["warnings"]] == ["blank"]
        assert json.loads(failed)["image2"] == {"file": "late.png", "width": WIDTH, "height": HEIGHT}
        for text in ("{}}\n", "{}\n", "3\n"):
            path.write_text(text)
            raises(ValueError, r"pairs\.jsonl is damaged: remove it", command, *options, images=())

    @pytest.mark.parametrize(("options", "pairs"), [([], 2), (["--gap", "2"], 1), (["--exhaustive"], 3)])
    def test_a_folder(self, planes, command, options, pairs):
        """One pair is solved, those with a blank image are not; the table says what the lines say."""
        Path("photos").mkdir()
        for name, source in (("a", "left"), ("b", "right"), ("c", "blank")):
            shutil.copy(planes / f"{source}.png", f"photos/{name}.png")
        assert command("--pairs", "photos", "--out", "found", "--jobs", "1", *options, images=()) == 3
        lines = [json.loads(line) for line in Path("found/pairs.jsonl").read_text().splitlines()]
        rows = [*csv.DictReader(Path("found/pairs.csv").read_text().splitlines())]
        assert len(rows) == len(lines) == pairs
        for row, line in zip(rows, lines, strict=True):
            assert row["image1"] == line["image1"]["file"]
            assert row["F"].split() == ([str(value) for value in np.ravel(line["F"])] if line["F"] else [])
            assert row["warnings"].split() == [warning["code"] for warning in line["warnings"]]
        assert command("--pairs", "photos", "--out", "found", "--jobs", "1", "--gap", "2", images=()) == 3
        table, lines = (Path(f"found/pairs.{suffix}").read_text().splitlines() for suffix in ("csv", "jsonl"))
        assert len(table) == 1 + len(lines)  # pairs of the first run that the second has not, too

    def test_lists(self, tmp_path):
        path = tmp_path / "list.txt"
        path.write_text("# two images\n'a b.png' c.png\n", encoding="utf-8-sig")
        assert read_pair_list(path) == [(tmp_path / "a b.png", tmp_path / "c.png")]
        wrong = {"'a.png b.png\n": "line 1: No clos", "a b c\n": "line 1: .* got 'a b c'", "\n": "no pairs"}
        for text, message in wrong.items():
            path.write_text(text)
            raises(ValueError, message, read_pair_list, path)

"""The command that makes stores of correspondences from images."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("cv2", reason="OpenCV is not installed")
pytest.importorskip("h5py", reason="h5py is not installed")
pytest.importorskip("joblib", reason="joblib is not installed")

from make_sequences import FR3

from kornia_learnnorm.cli import match
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.matching.frame_matching import collect_matches
from kornia_learnnorm.data.matching.matchers import one_to_one
from kornia_learnnorm.data.store import read_store


def command(reader: str, root: Path, out: Path, *args: str) -> list[str]:
    return ["match", reader, str(root), "--out", str(out), "--jobs", "1", "--num-features", "200", *args]


def run(*args) -> int:
    return main(command(*args))


@pytest.mark.parametrize(
    ("reader", "args", "pairs", "known"),
    [
        ("kitti", ["--sequences", "11"], 3, 0),  # it has no poses
        ("kitti", ["--split", "test", "--gap", "2", "--camera", "image_1"], 2, 2),
        ("tum", ["--split", "val", "--max-difference", "0.001"], 3, 0),  # no pose is so near
        ("cambridge", ["--split", "train"], 3, 3),
        ("folder", ["--exhaustive"], 21, 0),
    ],
)
def test_readers(written, tmp_path, capsys, reader, args, pairs, known):
    assert run(reader, written / reader, tmp_path / "s.h5", *args) == 0
    assert f"{pairs} pairs, {known} with ground truth" in capsys.readouterr().out
    assert len(read_store(tmp_path / "s.h5")) == pairs


@pytest.mark.parametrize("args", [[], ["--pairs"], ["--min-points", "5"]])
def test_colmap(written, tmp_path, args):
    root = written / "colmap"
    more = [*args, str(root / "pairs.txt")] if args == ["--pairs"] else args
    assert run("colmap", root / "images", tmp_path / "s.h5", "--model", str(root / "model"), *more) == 0
    assert np.isfinite(read_store(tmp_path / "s.h5").F).all()


def test_resized_images_and_cameras_agree(written, tmp_path):
    assert run("kitti", written / "kitti", tmp_path / "s.h5", "--sequences", "06", "--resize", "320", "240") == 0
    store = read_store(tmp_path / "s.h5")
    assert store.image_size[0].tolist() == [[320, 240]] * 2
    assert "resized to 320x240" in store.dataset
    assert store.K[0, 0, 0, 0] == 260  # twice the focal length


def test_errors_are_one_line(written, tmp_path, refused):
    for reader, args, message in [
        ("folder", ["--sequences", "06"], "sequences is for kitti and tum, got folder"),
        ("kitti", ["--sequences", "06", "--split", "test"], "exclude each other"),
        ("kitti", ["--gap", "9"], "no pairs of frames to match (frames 9 apart) among 12 frames"),
        ("kitti", ["--matcher", "lightglue"], "needs detector rootsift, aliked, disk, xfeat, keynet, got sift"),
        ("kitti", ["--min-points", "5"], "min_points 5 needs a COLMAP model, got none"),
        ("colmap", [], "colmap needs a model"),
    ]:
        refused(command(reader, written / reader, tmp_path / "s.h5", *args), message)
        assert not (tmp_path / "s.h5").exists()


def test_rerun_says_that_the_store_exists(written, tmp_path, capsys):
    args = ("kitti", written / "kitti", tmp_path / "s.h5", "--sequences", "06")
    for prefix, error in (("wrote ", ""), ("", "exists already")):
        assert run(*args) == 0
        captured = capsys.readouterr()
        assert captured.out.startswith(f"{prefix}{tmp_path / 's.h5'}: 3 pairs, ")
        assert error in captured.err
    assert run(*args, "--gap", "2") == 2
    assert "elsewhere: pairs 'consecutive frames', now 'frames 2 apart'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("reader", "args", "lost", "expected"),
    [
        ("kitti", ["--sequences", "06"], "poses/06.txt", "no pose known for sequence 06: no file {}/poses/06.txt"),
        ("tum", [], f"{FR3}/groundtruth.txt", f"no pose known for sequence {FR3}: no file {{}}/{FR3}/groundtruth.txt"),
        ("tum", [], FR3, "no camera known for sequence household: its name has no fr1, fr2 or fr3"),
        ("cambridge", [], "reconstruction.nvm", "no camera known: no file {}/reconstruction.nvm"),
    ],
)
def test_missing_ground_truth_is_named(written, tmp_path, capsys, monkeypatch, reader, args, lost, expected):
    def stop(*_):
        raise ValueError("before the first pair")

    root = shutil.copytree(written / reader, tmp_path / "root")
    (root / lost).rename(root / "household")
    monkeypatch.setattr(match, "collect_matches", stop)
    assert run(reader, root, tmp_path / "s.h5", *args) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("no ")]
    assert lines == [expected.format(root)]


def test_options_are_checked_before_images_are_read(written, tmp_path, refused, monkeypatch):
    monkeypatch.setattr(match, "read_dataset", None)
    for args, message in [
        (["--jobs", "-7"], "jobs must be a number of processes"),
        (["--max-matches", "7"], "max_matches must be at least 8, or None (a command's 0) for all, got 7"),
        (["--out", "none/s.h5"], "cannot write none/s.h5: the folder none does not exist"),
        (["--out", "own.txt"], "own.txt: expected the name of a store, which ends in .h5 or .hdf5"),
    ]:
        refused(command("kitti", written / "kitti", tmp_path / "s.h5", *args), message)


@pytest.mark.parametrize(
    ("reader", "args", "reference"),
    [
        ("kitti", ["--sequences", "06"], "kitti_06"),
        # That store takes the nearest pose whatever the difference, 0.067 s for the first frame.
        ("tum", ["--max-difference", "0.1"], "tum_fr3_office"),
    ],
)
def test_real_data_gives_the_stores_that_other_code_made(real_data, tmp_path, monkeypatch, reader, args, reference):
    limit = 3
    monkeypatch.setattr(match, "collect_matches", lambda pairs, *rest: collect_matches(pairs[:limit], *rest))
    out = tmp_path / "s.h5"
    options = ["--jobs", "1", "--max-matches", "0", *args]
    assert main(["match", reader, f"{real_data}/{reader}", "--out", str(out), *options]) == 0
    reference = f"{real_data}/correspondences/{reference}.h5"
    ours, theirs = read_store(out), read_store(f"{reference}@0:{limit}")
    assert [tuple(Path(name).name for name in pair) for pair in ours.names] == theirs.names
    for name in ("image_size", "F", "K", "R", "t"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=0, atol=1e-6)
    for place in range(limit):
        one, two = (read_store(f"{path}@{place}:{place + 1}") for path in (out, reference))
        # The other code keeps OpenCV's points, 0.25 px off, and matches that share one, 1,000 that pass the ratio test.
        # The best of those that share one may be among those it left out: at most 0.5 % of these pairs.
        kept = one_to_one(*map(torch.from_numpy, (two.points1, two.points2, two.ratio))).numpy()
        wanted = np.hstack([two.points1, two.points2])[kept[two.ratio[kept] < 0.8]] - 0.25
        distance = np.abs(wanted[:, None] - np.hstack([one.points1, one.points2])[None]).max(-1).min(1)
        assert (distance < 0.01).mean() >= 0.99

"""The command that writes a COLMAP database."""

import ast
import shlex

import pytest

pytest.importorskip("cv2", reason="OpenCV is not installed")
pytest.importorskip("h5py", reason="h5py is not installed")
pytest.importorskip("pycolmap", reason="pycolmap is not installed")

import h5py
import numpy as np
import pycolmap

from kornia_learnnorm.cli.main import main


def command(root, out, *args):
    return ["export-colmap", str(root), "--out", str(out), "--jobs", "1", "--num-features", "300", *map(str, args)]


@pytest.fixture
def photos(written):
    return written / "kitti/sequences/06/image_0"


@pytest.mark.parametrize(("args", "pairs"), [([], 6), (["--overlap", "2"], 5), (["--pairs"], 1)])
def test_a_folder(photos, tmp_path, capsys, args, pairs):
    names = sorted(path.name for path in photos.iterdir())
    (tmp_path / "pairs.txt").write_text(f"{names[0]} {names[3]}")
    args = [*args, tmp_path / "pairs.txt"] if args == ["--pairs"] else args
    assert main(command(photos, tmp_path / "photo's.db", *args)) == 0
    printed = capsys.readouterr()
    assert f"of {pairs} pairs verified" in printed.out
    assert ast.parse(shlex.split(printed.err)[-1]).body[1].value.args[0].value == str(tmp_path / "photo's.db")
    with pycolmap.Database.open(tmp_path / "photo's.db") as file:
        assert file.num_matched_image_pairs() == pairs


def test_matches_are_kept_beside_and_taken_again(photos, tmp_path, capsys):
    out = tmp_path / "photos.db"
    assert main(command(photos, out, "--K", "400,400,320,240")) == 0
    assert "warning: the principal point of K is at" in (printed := capsys.readouterr().err)
    assert "ba_refine_focal_length=False" in printed
    out.unlink()
    assert main(command(photos, out, "--weights", "robust-tiny")) == 0
    assert "photos.h5 exists already" in capsys.readouterr().err
    out.unlink()
    assert main(command(photos, out, "--matches", out.with_suffix(".h5"), "--single-camera")) == 0
    with pycolmap.Database.open(out) as file:
        assert file.num_cameras() == 1


def test_hloc(photos, tmp_path):
    """All points are keypoints of one pair of images, and match in reverse order."""
    names, points = sorted(path.name for path in photos.iterdir())[:2], np.arange(40.0).reshape(20, 2)
    features, matches = tmp_path / "features.h5", tmp_path / "matches.h5"
    with h5py.File(features, "w") as file:
        for name in names:
            file[f"{name}/keypoints"], file[f"{name}/image_size"] = points, (160, 120)
    with h5py.File(matches, "w") as file:
        file[f"{names[0]}/{names[1]}/matches0"] = np.arange(20)[::-1].copy()
        file[f"{names[0]}/{names[1]}/matching_scores0"] = np.full(20, 0.5)
    assert main(command(photos, tmp_path / "photos.db", "--matches", features, matches)) == 0
    with pycolmap.Database.open(tmp_path / "photos.db") as file:
        first, second = (file.read_image_with_name(name).image_id for name in names)
        np.testing.assert_array_equal(file.read_keypoints(first)[:, :2], points + 0.5)
        np.testing.assert_array_equal(np.sort(file.read_matches(first, second), 0)[:, 0], np.arange(20))
        assert file.read_matches(first, second).sum(1).tolist() == [19] * 20


def test_errors(photos, tmp_path, refused):
    (tmp_path / "there.db").touch()
    out = tmp_path / "photos.db"
    for args, message in [
        (command(photos, tmp_path / "there.db"), "there.db exists already: remove it, or write elsewhere"),
        (command(photos, tmp_path / "no" / "photos.db"), "the folder"),
        (command(tmp_path / "none", out), "no folder at"),
        (command(photos, out, "--K", "1,2,3"), "got 3 numbers"),
        (command(photos, out, "--seed", "-1"), "seed must"),
        (command(photos, tmp_path / "a.h5"), "a.h5: this is where the matches go"),
        (command(photos, out, "--weights", "none"), "none"),
        (command(photos, out, "--matches", "a", "b", "c"), "got 3 files"),
        (command(photos, out, "--jobs", "-2"), "jobs"),
        (command(tmp_path, out), "no images"),
    ]:
        refused(args, message)
    assert not out.exists()

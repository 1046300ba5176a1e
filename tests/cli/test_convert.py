"""The subcommand that converts stores, from the command line's words on."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from kornia_learnnorm.cli.convert import add_arguments, run
from kornia_learnnorm.cli.synthesize import synthetic_store
from kornia_learnnorm.data.store import read_store, write_store


def convert(*words):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args([str(word) for word in words]))


@pytest.fixture
def path(tmp_path):
    write_store(tmp_path / "store.h5", synthetic_store(pairs=1, points=30, seed=1))
    return tmp_path / "store.h5"


@pytest.mark.parametrize("kind", ["kitti-flow", "ngransac", "hloc"])
def test_there_and_back(path, tmp_path, capsys, kind):
    folder, back = tmp_path / "new" / "folder", tmp_path / "back.h5"
    assert convert(path, folder, "--to", kind) == 0
    line = capsys.readouterr().out
    left = line.startswith(f"wrote {folder}: 3 pairs, 90 matches, 0 left out")
    assert left or kind == "kitti-flow"
    assert line.count("\n") == 1
    assert ("; names with white space or empty, written with _: 2" in line) == (kind == "kitti-flow")
    assert convert(folder, back, "--from", kind) == 0
    got = read_store(back)
    known, ratios = 3 * (kind == "ngransac"), "; there are no ratios in" if kind == "kitti-flow" else "\n"
    line = f"wrote {back}: 3 pairs, {known} with ground truth, {len(got.ratio)} matches{ratios}"
    assert capsys.readouterr().out.startswith(line)
    assert len(got) == 3
    if kind != "kitti-flow":
        assert len(got.ratio) == 90
        assert np.isin(got.ratio, read_store(path).ratio).all()
    with pytest.raises(ValueError, match="already holds"):
        convert(path, folder, "--to", kind)


def test_some_pairs(path, tmp_path, capsys):
    convert(f"{path}@1:2", tmp_path / "folder", "--to", "ngransac")
    assert "1 pairs, 30 matches" in capsys.readouterr().out
    assert [file.name for file in (tmp_path / "folder").iterdir()] == ["pair_0_1.npy"]


def test_matches_that_are_left_out_are_counted(path, tmp_path, capsys):
    store = read_store(path)
    store.points1[:2] = -1  # outside of the image
    write_store(tmp_path / "cut.h5", store)
    convert(tmp_path / "cut.h5", tmp_path / "folder", "--to", "kitti-flow")
    line = capsys.readouterr().out
    assert "; matches outside image 1: 2; " in line
    convert(tmp_path / "folder", tmp_path / "back.h5", "--from", "kitti-flow")
    got = len(read_store(tmp_path / "back.h5").ratio)
    assert f": 3 pairs, {got} matches, {90 - got} left out; " in line


def test_existing_store_is_not_replaced(path, tmp_path):
    convert(path, tmp_path / "folder", "--to", "hloc")
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"cannot write .*store\.h5: it is there already"):
        convert(tmp_path / "folder", path, "--from", "hloc")
    assert path.read_bytes() == before


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
def test_unwritable_target(path, tmp_path):
    convert(path, tmp_path / "folder", "--to", "ngransac")
    with pytest.raises(OSError, match=r"^cannot write /proc/out\.h5: "):
        convert(tmp_path / "folder", "/proc/out.h5", "--from", "ngransac")
    with pytest.raises(OSError, match=r"^cannot export to /proc/out: "):
        convert(path, "/proc/out", "--to", "ngransac")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "one of the arguments --from --to is required"),
        (["--from", "hloc", "--to", "hloc"], "not allowed with argument"),
        (["--to", "colmap"], "invalid choice: 'colmap'"),
    ],
)
def test_wrong_words(words, message, capsys):
    with pytest.raises(SystemExit):
        convert("a", "b", *words)
    assert message in capsys.readouterr().err


def test_errors(path, tmp_path):
    with pytest.raises(FileNotFoundError, match="no store at"):
        convert(tmp_path, tmp_path / "new", "--to", "hloc")
    with pytest.raises(FileNotFoundError, match=r"no file of hloc at .*features\.h5"):
        convert(tmp_path, tmp_path / "back.h5", "--from", "hloc")
    with pytest.raises(FileNotFoundError, match="no folder at"):
        convert(tmp_path / "none", tmp_path / "back.h5", "--from", "ngransac")
    with pytest.raises(ValueError, match="it is a file, expected a folder"):
        convert(path, path, "--to", "hloc")
    assert [file.name for file in tmp_path.iterdir()] == ["store.h5"]

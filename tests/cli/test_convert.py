"""The subcommand that converts stores, from the command line's words on."""

from __future__ import annotations

import numpy as np
import pytest

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.synthetic.stores import synthetic_store
from kornia_learnnorm.data.writer import write_store


def convert(*words) -> int:
    return main(["convert", *map(str, words)])


@pytest.fixture
def path(tmp_path):
    write_store(tmp_path / "store.h5", synthetic_store(pairs=1, points=30, seed=1))
    return tmp_path / "store.h5"


def test_there_and_back(path, tmp_path, capsys):
    folder, back = tmp_path / "new" / "folder", tmp_path / "back.h5"
    assert convert(path, folder, "--to", "hloc") == 0
    assert capsys.readouterr().out == f"wrote {folder}: 3 pairs, 90 matches, 0 left out\n"
    assert sorted(file.name for file in folder.iterdir()) == ["features.h5", "matches.h5"]
    assert convert(folder, back, "--from", "hloc") == 0
    assert capsys.readouterr().out == f"wrote {back}: 3 pairs without ground truth, 90 matches\n"
    got = read_store(back)
    assert (len(got), len(got.ratio)) == (3, 90)
    assert np.isin(got.ratio, read_store(path).ratio).all()


def test_some_pairs_with_matches_left_out_and_without_ratios(path, tmp_path, capsys):
    store = read_store(path)
    store.points1[30:33] = 7  # of the second pair
    store.ratio[:] = 0
    write_store(tmp_path / "same.h5", store)
    convert(f"{tmp_path / 'same.h5'}@1:2", tmp_path / "folder", "--to", "hloc")
    line = "1 pairs, 28 matches, 2 left out; matches of a keypoint that has a better one: 2\n"
    assert capsys.readouterr().out.endswith(line)
    convert(tmp_path / "folder", tmp_path / "back.h5", "--from", "hloc")
    assert "all ratios are 0, which passes every ratio test" in capsys.readouterr().out


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["folder", "store.h5", "--from", "hloc"], "store.h5: it exists already, remove it or write elsewhere"),
        (["store.h5", "folder", "--to", "hloc"], "features.h5: it exists already, remove it or write elsewhere"),
        (["store.h5", "store.h5", "--to", "hloc"], "it is a file, expected a folder"),
        (["folder", "new", "--to", "hloc"], "no store at"),
        (["new", "back.h5", "--from", "hloc"], "no file of hloc at"),
        (["folder", "new/back.h5", "--from", "hloc"], "does not exist"),
        (["store.h5", "store.h5/folder", "--to", "hloc"], "Not a directory"),
    ],
)
def test_errors_are_one_line_and_replace_nothing(path, tmp_path, monkeypatch, refused, words, message):
    convert(path, tmp_path / "folder", "--to", "hloc")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*.h5")}
    monkeypatch.chdir(tmp_path)
    refused(["convert", *words], message)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*.h5")} == before

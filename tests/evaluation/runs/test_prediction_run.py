"""Runs of predictions: what is computed, kept, refused and left out."""

import importlib
import json
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from references import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.evaluation.methods import find_method
from kornia_learnnorm.evaluation.runs import prediction_run
from kornia_learnnorm.evaluation.runs.prediction_run import ERRORS, SampleOptions, consensus, predict, read_run
from kornia_learnnorm.evaluation.runs.results_store import file_name
from kornia_learnnorm.metrics.inliers import f1_score
from kornia_learnnorm.protocol import THRESHOLDS


def assert_same(one, other):
    """The second run has the numbers of the first; it may have fewer quantities."""
    for cell, again in zip(one.cells, other.cells, strict=True):
        assert (cell.title, cell.drawn) == (again.title, again.drawn)
        assert cell.predictions.keys() == again.predictions.keys()
        for name, found in again.predictions.items():
            for key, values in found.items():
                np.testing.assert_array_equal(cell.predictions[name][key], values)


def test_a_temporary_run_of_methods_in_another_order_has_the_same_numbers(run, store, command):
    methods = command[3:-1]
    found = prediction_run.temporary_run({"scenes": str(store)}, methods[::-1], SampleOptions())
    assert [*found.about["methods"]] == methods[::-1]
    assert_same(read_run(run), found)
    assert {*found.cells[1].predictions["Hartley+LM"]} == {*ERRORS}
    assert found.about | {"commands": read_run(run).about["commands"]} == read_run(run).about


def test_another_run_computes_nothing_and_adds_what_is_new(copied, command, monkeypatch):
    files = {path: path.stat().st_mtime_ns for path in copied.rglob("*.npz")}
    with monkeypatch.context() as patch:
        patch.setattr(prediction_run, "predict", pytest.fail)
        assert main([*command, str(copied)]) == 0
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*.npz")} == files
    assert main([*command[:3], "reweighted", "--out", str(copied)]) == 0
    assert [*read_run(copied).about["methods"]] == [*command[3:-1], "reweighted"]
    assert len([*copied.rglob("*.npz")]) == len(files) + 2


def test_a_run_of_other_options_is_refused(copied, command, refused):
    message = f"{copied} is a run of other options, remove it or write elsewhere: "
    refused([*command, copied, "--max-samples", "9"], f"{message}max_samples 16000, now 9")
    refused([*command, copied, "--size", "9"], f"{message}size 8, now 9")
    about = json.loads((copied / "run.json").read_text())
    about["evaluate"]["methods"] = {"crossview": "crossview 0000"}
    (copied / "run.json").write_text(json.dumps(about))
    refused([*command, copied], f"{message}crossview 'crossview 0000', now 'crossview ")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("run.json", b"{", "run.json is damaged, it is not JSON"),
        ("run.json", b"{}", "a run of format None, expected 4: another version of the package made it, remove it"),
        ("run.json", b'{"format": 4, "evaluate": 1}', "evaluate must be an object, got 1"),
        ("run.json", b'{"format": 4, "evaluate": {"stores": {}}}', "methods, trained_on, versions, size, seed"),
        ("scenes/filtered/crossview.npz", b"PK", "crossview.npz is damaged, remove it"),
        ("scenes/filtered/samples.npz", b"PK", "samples.npz is damaged, remove it"),
    ],
)
def test_damaged_or_of_another_version(copied, reading, refused, name, content, message):
    (copied / name).write_bytes(content)
    for again in reading:
        refused(again, message)


def test_other_samples(copied, reading, refused):
    """Files of the unfiltered samples in the place of the filtered ones."""
    filtered = copied / "scenes/filtered"
    shutil.copy(copied / "scenes/unfiltered/none.npz", filtered / "none.npz")
    for again in reading:
        refused(again, "none.npz is of other samples, remove it: expected")
    np.savez(filtered / "none.npz", own=np.zeros(3))
    for again in reading:
        refused(again, "expected arrays F_mat, heldout")
    shutil.copytree(copied / "scenes/unfiltered", filtered, dirs_exist_ok=True)
    refused(reading[1], "samples.npz is of other samples, remove it")


def test_a_store_that_joins_later_changes_no_number(copied, command, tmp_path):
    write_store(tmp_path / "other.h5", synthetic_store(pairs=2, points=330, seed=2))
    before = read_run(copied)
    assert main([command[0], str(tmp_path / "other.h5"), *command[2:], str(copied)]) == 0
    after = read_run(copied)
    assert [*after.about["stores"]] == ["scenes", "other"]
    assert_same(before, after._replace(cells=after.cells[:2]))


class TestOwnCode:
    GOOD = "from kornia_learnnorm import Whitening as Mine\n"

    @pytest.fixture(autouse=True)
    def here(self, tmp_path, monkeypatch):
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        monkeypatch.chdir(tmp_path)

    def write(self, text):
        Path("own_normaliser.py").write_text(text)
        sys.modules.pop("own_normaliser", None)
        importlib.invalidate_caches()

    def evaluate(self, store, text):
        self.write(text)
        methods = ["own_normaliser:Mine", "Hartley"]
        return main(["evaluate", str(store), "--out", "run", "--methods", *methods, "--max-samples", "40"])

    def test_one_that_is_no_normaliser(self):
        for text, message in [
            ("def Mine(a, b):\n    pass", "Mine() takes 2 positional arguments"),
            ("def Mine(a, b, c):\n    return 1", "must return two transforms of shape"),
            ("def Mine(a, b, c):\n    return 2 * [float('nan') * a.new_ones(len(a), 3, 3)]", "are not finite"),
            ("class Mine:\n    def __init__(self, size):\n        pass", "cannot be made without arguments"),
            ("Mine = (", "SyntaxError"),
            ("1 / 0", "ZeroDivisionError"),
        ]:
            self.write(text)
            before = [*sys.path]
            with pytest.raises(ValueError, match=re.escape(message)):
                find_method("own_normaliser:Mine").estimate(*torch.rand(2, 3, 8, 2, dtype=torch.float64))
            assert sys.path == before

    def test_one_that_fails_is_left_out(self, store, capsys):
        assert self.evaluate(store, "def Mine(a, b, c):\n    raise RuntimeError('boom')") == 2
        error = capsys.readouterr().err
        assert "RuntimeError: boom" in error
        assert "own_normaliser:Mine failed, called with" in error
        assert error.splitlines()[-1].endswith("All others are in run")
        assert [*read_run("run").about["methods"]] == ["Hartley"]
        assert self.evaluate(store, self.GOOD) == 0
        assert len(read_run("run").cells[0].predictions) == 2

    def test_one_that_fails_late_leaves_nothing(self, store):
        """There is a file of the filtered samples when the unfiltered ones fail."""
        text = "n = []\ndef Mine(a, b, c):\n    n.append(a)\n    return Whitening()(a, b, c) if len(n) < 2 else None\n"
        assert self.evaluate(store, "from kornia_learnnorm import Whitening\n" + text) == 2
        assert not [*Path("run").rglob("own_normaliser*")]

    def test_edited_code_is_refused(self, store, capsys):
        assert self.evaluate(store, self.GOOD) == 0
        assert len([*Path("run").rglob("own_normaliser_Mine-*.npz")]) == 2
        assert self.evaluate(store, self.GOOD) == 0
        assert self.evaluate(store, self.GOOD + "# edited") == 2
        assert "is a run of other options, remove it or write elsewhere: own_normaliser:Mine" in capsys.readouterr().err


def test_pairs_with_few_matches_have_nothing_held_out(tmp_path):
    """Of nine matches eight are a sample, and the last of those left over may be held out; of eight none."""
    few = synthetic_store(pairs=2, points=60, seed=1, outliers=0.0)
    few.ratio[:] = 0.9
    few.ratio[few.offsets[1] : few.offsets[1] + 9] = few.ratio[:8] = 0.5
    write_store(tmp_path / "few.h5", few)
    command = ["evaluate", str(tmp_path / "few.h5"), "--out", str(tmp_path / "run"), "--methods", "Hartley"]
    assert main([*command, "--max-residual", "inf"]) == 0
    filtered, unfiltered = read_run(tmp_path / "run").cells
    assert filtered.predictions["Hartley"]["heldout"].isnan().tolist() == [True, False]
    assert torch.equal(unfiltered.predictions["Hartley"]["heldout"].isnan(), unfiltered.pair != 1)
    assert main(["report", str(tmp_path / "run")]) == 0


def test_options_that_are_refused(store, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    Path("FILE").touch()
    for options, message in [
        (["--out", ""], "--out is empty: expected a folder"),
        (["--size", "999"], "scenes, filtered: no pair of the store has 999 correspondences"),
        (["--out", "FILE"], "FILE is a file: expected a folder"),
        (["--out", "RUN", "--max-samples", "-1"], "--max-samples must be 0, for all, or more, got -1"),
        (["--out", "RUN", "--max-residual", "-1"], "--max-residual must be 0 or more, inf for all, got -1"),
        (["--out", "RUN", "--size", "7"], "a sample needs at least 8 correspondences, got size=7"),
        (["--max-residual", "0"], "scenes, filtered: none of "),
    ]:
        refused(["evaluate", store, "--methods", "none", *options], message)
        assert not Path("RUN").exists()


def test_names_become_different_files():
    for name in ("tum@0:9", "a/b", "..", "name.", " ", "", "ä", 300 * "n", "a*?<>|\"'"):
        found = file_name(name)
        assert re.fullmatch(r"[A-Za-z0-9+_-][A-Za-z0-9+_.-]{0,99}", found)
        assert not found.endswith(".")
    names = ["a:b", "a/b", "a_b", 99 * "n", 98 * "n", "Hartley", "Hartley+LM", "RANSAC.", "RANSAC"]
    assert len({file_name(name) for name in names}) == len(names)
    plain = ["a_b", "Hartley+LM", "tum_fr3_office"]
    assert [file_name(name) for name in plain] == plain


def test_predictions_of_the_true_matrix_and_of_each_constraint():
    store = synthetic_store(pairs=4, points=64, seed=3, noise=0.5, outliers=0.0, scenes=["orbit"])
    points1, points2 = (torch.from_numpy(p).reshape(4, 64, 2) for p in (store.points1, store.points2))
    samples = MatchSets(points1, points2, points1[:, :1], points2[:, :1], torch.arange(4))
    F_mat = torch.from_numpy(store.F)
    exact = SimpleNamespace(normalizer=kln.Hartley(), rank2="projection", solve=lambda *_: F_mat)
    found = predict(exact, samples, store, None)
    assert found["own"] == pytest.approx(epipolar_distances(points1.double(), points2.double(), store.F).mean(1))
    assert (found["f1"] == 1).all()
    assert found["rotation_error"].max() < 1e-6
    assert found["translation_error"].max() < 1e-4
    assert found["distance1"] == pytest.approx(2**0.5)
    for name, rank2 in (("Hartley", "projection"), ("Hartley+optimal", "optimal")):
        expected = kln.find_fundamental(points1.double(), points2.double(), rank2=rank2).numpy()
        np.testing.assert_allclose(predict(find_method(name), samples, store, None)["F_mat"], expected, atol=1e-9)


@pytest.mark.parametrize("max_ratio", [0.8, None])
def test_consensus_is_that_of_the_metrics(max_ratio):
    store = synthetic_store(pairs=3, points=60, seed=5)
    store.F[2] = np.nan
    pair = torch.tensor([0, 2, 1, 0, 1])
    F_mat = torch.from_numpy(np.nan_to_num(store.F, nan=0.3))[pair]
    F_mat *= 1 + 1e-4 * torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    F_mat[3] = torch.nan  # a failed estimate
    found = consensus(F_mat, pair, store, max_ratio)
    for row, index in enumerate(pair.tolist()):
        x1, x2 = (torch.from_numpy(points).double() for points in store.matches(index, max_ratio)[:2])
        true = torch.from_numpy(store.F[index])
        for place, threshold in enumerate(THRESHOLDS):
            score = f1_score(x1, x2, F_mat[row], true, threshold)
            near = kln.symmetric_epipolar_distance(x1, x2, F_mat[row]) < threshold
            assert found["inliers"][row, place] == near.double().mean()
            assert found["f1"][row, place] == pytest.approx(score, nan_ok=True)
    assert found["inliers"][3].tolist() == found["f1"][3].nan_to_num().tolist() == [0, 0]
    assert found["f1"][1].isnan().all()
    assert (found["f1"][0] > 0).any()

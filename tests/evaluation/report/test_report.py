"""Runs of predictions."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.cli import evaluate
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.samples import plain_residual
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.synthetic.stores import synthetic_store
from kornia_learnnorm.data.writer import write_store
from kornia_learnnorm.evaluation.methods import find_method, identify_method, short_names
from kornia_learnnorm.evaluation.report.tables import report_tables
from kornia_learnnorm.evaluation.runs import example, record
from kornia_learnnorm.evaluation.runs import predict as predict_run
from kornia_learnnorm.evaluation.runs.motion import pair_motions
from kornia_learnnorm.evaluation.runs.run import read_run
from kornia_learnnorm.normalizers.learned import WEIGHTS

pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
METHODS = ["none", "Hartley", "whitening", "crossview", "Hartley+optimal", "Hartley+LM"]


class TestMethods:
    def scene(self):
        store = synthetic_store(pairs=1, points=40, seed=4, outliers=0.0)
        return (torch.from_numpy(p).double().reshape(3, 40, 2)[:, :9] for p in (store.points1, store.points2))

    def test_closed_forms_and_weights(self):
        x1, x2 = self.scene()
        for name, normalizer in {
            "Hartley": kln.Hartley(),
            "crossview": kln.LearnedNormalizer.from_pretrained(),
        }.items():
            expected = kln.find_fundamental(x1, x2, normalizer=normalizer)
            assert torch.equal(find_method(name).estimate(x1, x2), expected)

    def test_an_own_normaliser(self):
        x1, x2 = self.scene()
        for name in ("kornia_learnnorm.normalizers.closed_form:Whitening", "kornia_learnnorm:Whitening"):
            expected = kln.find_fundamental(x1, x2, normalizer=kln.Whitening())
            assert torch.equal(find_method(name).estimate(x1, x2), expected)

    def test_refined_is_the_better_fit(self):
        x1, x2 = self.scene()
        plain, refined = (
            kln.sampson_distance(x1, x2, find_method(n).estimate(x1, x2)) for n in ("Hartley", "Hartley+LM")
        )
        assert (refined.square().sum(-1) <= plain.square().sum(-1)).all()

    @pytest.mark.parametrize(
        ("name", "error", "message"),
        [
            ("nothing", FileNotFoundError, "no weights 'nothing'"),
            ("hartley+LM", FileNotFoundError, r"expected none, Hartley, .*paper, .*module:Name, .*\+LM or \+optimal"),
            ("Hartley+foo", FileNotFoundError, r"no weights 'Hartley\+foo'"),
            ("Hartley+optimal+LM", FileNotFoundError, "expected none, Hartley"),
            (":Whitening", ValueError, "expected module:Name"),
            ("no.such.module:Thing", ValueError, "no normaliser at"),
            ("kornia_learnnorm:Nothing", ValueError, "no normaliser at"),
            ("kornia_learnnorm:__version__", ValueError, "cannot be called"),
        ],
    )
    def test_unknown(self, name, error, message):
        with pytest.raises(error, match=message):
            find_method(name)

    def test_names(self, tmp_path):
        path = str(tmp_path / "mine" / "weights.safetensors")
        assert short_names([path, path + "+LM", "paper"]) == {path: "mine", path + "+LM": "mine+LM", "paper": "paper"}
        assert identify_method("paper").startswith("paper ")
        assert identify_method("Hartley+LM") == "Hartley+LM"
        with pytest.raises(ValueError, match="same name"):
            short_names([path, path])


def test_predictions_are_those_of_the_functions(run, store):
    read, found = read_store(store), read_run(run)
    cell = found.cells[0]
    samples, drawn = predict_run.draw(read, 0.8, 0, None), cell.drawn
    assert drawn == len(samples.pair)
    raw = np.load(run / "scenes" / "filtered" / "crossview.npz")
    samples = samples.select(plain_residual(samples.points1, samples.points2) < 60)
    x1, x2 = samples.points1.double(), samples.points2.double()
    with torch.no_grad():
        F_mat = find_method("crossview").estimate(x1[:2048], x2[:2048])
    np.testing.assert_array_equal(raw["F_mat"][:2048], F_mat)
    own = kln.symmetric_epipolar_distance(x1, x2, torch.from_numpy(raw["F_mat"])).mean(-1)
    np.testing.assert_allclose(raw["own"], own, rtol=1e-12)


def test_another_run_computes_nothing_and_adds_what_is_new(copied, store, monkeypatch):
    files = {path: path.stat().st_mtime_ns for path in copied.rglob("*.npz")}
    monkeypatch.setattr(record, "predict", pytest.fail)
    assert main(["evaluate", str(store), "--out", str(copied), "--methods", *METHODS]) == 0
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*.npz")} == files
    monkeypatch.undo()
    monkeypatch.setattr(example, "TRIALS", 20)
    assert main(["evaluate", str(store), "--out", str(copied), "--methods", "reweighted"]) == 0
    assert [*read_run(copied).about["methods"]] == [*METHODS, "reweighted"]
    assert len([*copied.rglob("*.npz")]) == len(files) + 3


def test_a_run_of_other_options_is_refused(copied, store, capsys):
    command = ["evaluate", str(store), "--out", str(copied), "--methods", *METHODS]
    assert main([*command, "--seed", "1"]) == 2
    assert "is a run of other options" in capsys.readouterr().err
    assert main([*command, "--max-samples", "9"]) == 2
    about = json.loads((copied / "run.json").read_text())
    about["methods"]["crossview"] = "crossview 0000"
    (copied / "run.json").write_text(json.dumps(about))
    assert main(command) == 2
    assert "crossview 0000" in capsys.readouterr().err


def test_a_run_of_an_older_format_is_refused(copied, store, capsys):
    about = json.loads((copied / "run.json").read_text())
    for key in ("format", "trained_on"):
        del about[key]
    (copied / "run.json").write_text(json.dumps(about))
    assert main(["evaluate", str(store), "--out", str(copied), "--methods", *METHODS]) == 2
    assert "format None, expected 2" in capsys.readouterr().err
    assert main(["report", str(copied)]) == 2
    assert "another version of the package made it" in capsys.readouterr().err


def test_a_store_that_joins_later_changes_no_figure(copied, store, tmp_path, monkeypatch):
    """Errors by the number of correspondences stay those of the pair that the run began with."""
    monkeypatch.setattr(example, "TRIALS", 20)
    write_store(tmp_path / "other.h5", synthetic_store(pairs=2, points=330, seed=2))
    before = read_run(copied)
    (copied / "sizes" / "Hartley.npz").unlink()
    assert main(["evaluate", str(tmp_path / "other.h5"), "--out", str(copied), "--methods", *METHODS]) == 0
    after = read_run(copied)
    assert [*after.about["stores"]] == ["scenes", "other"]
    assert str(after.example["store"]) == "scenes"
    np.testing.assert_array_equal(after.sizes["Hartley"]["own"], before.sizes["Hartley"]["own"])


def test_names_do_not_change_numbers(store, tmp_path, monkeypatch):
    """The same weights under exchanged names: the numbers go with the weights."""
    monkeypatch.setattr(example, "TRIALS", 5)
    numbers = []
    for first, second in (("crossview", "paper"), ("paper", "crossview")):
        folder = tmp_path / first
        folder.mkdir()
        shutil.copy(WEIGHTS / f"{first}.safetensors", folder / "one.safetensors")
        shutil.copy(WEIGHTS / f"{second}.safetensors", folder / "two.safetensors")
        methods = ["Hartley", str(folder / "one.safetensors"), str(folder / "two.safetensors")]
        record.record_run(folder / "run", {"scenes": str(store)}, methods)
        rows = report_tables(read_run(folder / "run"))[0].rows
        numbers.append({row[0]: row[1:] for row in rows})
    assert numbers[0]["one"] == numbers[1]["two"]
    assert numbers[0]["two"] == numbers[1]["one"]
    assert numbers[0]["one"] != numbers[0]["two"]


def test_order_does_not_change_numbers(run, store, tmp_path, monkeypatch):
    monkeypatch.setattr(example, "TRIALS", 20)
    assert main(["evaluate", str(store), "--out", str(tmp_path / "run"), "--methods", *METHODS[::-1]]) == 0
    first, second = read_run(run), read_run(tmp_path / "run")
    assert [*first.about["methods"]] == [*second.about["methods"]][::-1] == METHODS
    for one, other in zip(report_tables(first), report_tables(second), strict=True):
        assert (one.title, one.text, one.header) == (other.title, other.text, other.header)
        assert sorted(one.rows) == sorted(other.rows)
    for name in METHODS:
        for key, values in first.sizes[name].items():
            np.testing.assert_array_equal(values, second.sizes[name][key])


class TestDamage:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("{", "run.json is damaged, it is not JSON"),
            ("[1]", "run.json is damaged: expected an object of JSON, got list"),
            ('{"format": 2}', "run.json is damaged: stores, methods, trained_on, versions, seed, max_samples not as"),
        ],
    )
    def test_what_is_no_run(self, copied, store, capsys, text, message):
        (copied / "run.json").write_text(text)
        for command in (["report", str(copied)], ["evaluate", str(store), "--out", str(copied)]):
            assert main(command) == 2
            assert message in capsys.readouterr().err

    @pytest.mark.parametrize("name", ["scenes/filtered/crossview", "scenes/pairs", "sizes/none", "example"])
    def test_damaged(self, copied, store, capsys, name):
        path = copied / f"{name}.npz"
        path.write_bytes(path.read_bytes()[:200])
        for command in (["report", str(copied)], ["evaluate", str(store), "--out", str(copied), "--methods", *METHODS]):
            assert main(command) == 2
            assert f"{path.name} is damaged, remove it" in capsys.readouterr().err

    def test_other_samples(self, copied, store, capsys):
        """Files of the unfiltered samples in the place of the filtered ones."""
        commands = ["report", str(copied)], ["evaluate", str(store), "--out", str(copied), "--methods", *METHODS]
        shutil.copy(copied / "scenes" / "unfiltered" / "none.npz", copied / "scenes" / "filtered" / "none.npz")
        for command in commands:
            assert main(command) == 2
            assert "none.npz is of other samples, remove it: expected" in capsys.readouterr().err
        np.savez(copied / "scenes" / "filtered" / "none.npz", own=np.zeros(3))
        for command in commands:
            assert main(command) == 2
            assert "expected arrays F_mat, heldout" in capsys.readouterr().err
        shutil.rmtree(copied / "scenes" / "filtered")
        shutil.copytree(copied / "scenes" / "unfiltered", copied / "scenes" / "filtered")
        assert main(commands[1]) == 2
        assert "samples.npz is of other samples, remove it" in capsys.readouterr().err


class TestOwnCode:
    """Normalisers in the folder that the command is called in."""

    GOOD = "from kornia_learnnorm import Whitening as Mine\n"
    PLACE = staticmethod(lambda folder: folder / "scenes" / "filtered" / "own_normaliser_Mine.npz")

    @pytest.fixture(autouse=True)
    def here(self, tmp_path, monkeypatch):
        monkeypatch.setattr(example, "TRIALS", 5)
        monkeypatch.setattr(sys, "path", [*sys.path])
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        monkeypatch.chdir(tmp_path)

    def evaluate(self, store, folder, text):
        Path("own_normaliser.py").write_text(text)
        sys.modules.pop("own_normaliser", None)
        importlib.invalidate_caches()
        methods = ["own_normaliser:Mine", "Hartley"]
        return main(["evaluate", str(store), "--out", str(folder), "--methods", *methods, "--max-samples", "40"])

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("def Mine(a, b, c):\n    raise RuntimeError('boom')", "RuntimeError: boom"),
            ("def Mine(a, b):\n    pass", "Mine() takes 2 positional arguments"),
            ("def Mine(a, b, c):\n    return 1", "must return two transforms of shape"),
            ("def Mine(a, b, c):\n    return 2 * [float('nan') * a.new_ones(len(a), 3, 3)]", "are not finite"),
        ],
    )
    def test_one_that_fails_is_left_out(self, store, tmp_path, capsys, text, message):
        folder = tmp_path / "run"
        assert self.evaluate(store, folder, text) == 2
        error = capsys.readouterr().err
        assert message in error
        assert "own_normaliser:Mine failed, called with" in error
        assert error.splitlines()[-1].endswith(f"All others are in {folder}")
        assert [*read_run(folder).about["methods"]] == ["Hartley"]
        assert main(["report", str(folder)]) == 0
        assert self.evaluate(store, folder, self.GOOD) == 0
        assert len(read_run(folder).cells[0].predictions) == 2

    def test_one_that_fails_late_leaves_nothing(self, store, tmp_path):
        """Of the filtered samples there is a file when the unfiltered ones fail."""
        text = "n = []\ndef Mine(a, b, c):\n    n.append(a)\n    return Whitening()(a, b, c) if len(n) < 2 else None\n"
        assert self.evaluate(store, tmp_path / "run", "from kornia_learnnorm import Whitening\n" + text) == 2
        assert not self.PLACE(tmp_path / "run").exists()

    def test_edited_code_is_refused(self, store, tmp_path, capsys):
        assert self.evaluate(store, tmp_path / "run", self.GOOD) == 0
        assert self.PLACE(tmp_path / "run").exists()
        assert self.evaluate(store, tmp_path / "run", self.GOOD) == 0
        assert self.evaluate(store, tmp_path / "run", self.GOOD + "# edited") == 2
        assert "is a run of other options, remove it or write elsewhere: own_normaliser:Mine" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("class Mine:\n    def __init__(self, size):\n        pass", "cannot be made without arguments"),
            ("Mine = (", "SyntaxError"),
            ("1 / 0", "ZeroDivisionError"),
        ],
    )
    def test_what_cannot_be_made(self, store, tmp_path, capsys, text, message):
        assert self.evaluate(store, tmp_path / "run", text) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "run").exists()


def test_a_store_without_ground_truth_has_no_example(tmp_path, capsys):
    read = synthetic_store(pairs=2, points=60, seed=1)
    write_store(tmp_path / "short.h5", read)
    command = ["evaluate", str(tmp_path / "short.h5"), "--out", str(tmp_path / "run"), "--methods", "Hartley"]
    assert main(command) == 0
    assert "without Figures 10 and 11: no pair has 256 matches" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "run")]) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "RUN", "--weights", "paper"], "with --out, weights are among --methods"),
        (["--out", "RUN", "--max-residual", "60"], "the limit is 60 px"),
        (["--out", ""], "--out is empty: expected a folder"),
        (["--out", "FILE"], "FILE is a file: expected a folder"),
        (["--out", "RUN", "--max-samples", "-1"], "--max-samples must be 0, for all, or more, got -1"),
    ],
)
def test_options_that_are_refused(store, tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    Path("FILE").touch()
    assert main(["evaluate", str(store), *options]) == 2
    assert message in capsys.readouterr().err
    assert not Path("RUN").exists()


def test_methods_need_a_run(store, capsys):
    assert main(["evaluate", str(store), "--methods", "Hartley"]) == 2
    assert "give --out too" in capsys.readouterr().err


@pytest.mark.parametrize(("options", "most"), [(["--max-samples", "50"], 50), ([], 60), (["--max-samples", "0"], None)])
def test_a_few_samples(store, tmp_path, monkeypatch, options, most):
    monkeypatch.setattr(example, "TRIALS", 5)
    monkeypatch.setattr(evaluate, "MAX_SAMPLES", 60)
    folder = tmp_path / "run"
    assert main(["evaluate", str(store), "--out", str(folder), "--methods", "Hartley", *options]) == 0
    assert json.loads((folder / "run.json").read_text())["max_samples"] == most
    everything = [len(predict_run.draw(read_store(store), ratio, 0, None).pair) for ratio in (0.8, None)]
    assert [cell.drawn for cell in read_run(folder).cells] == ([most, most] if most else everything)


def test_motions_by_hand():
    store = synthetic_store(pairs=2, points=100, seed=0, outliers=0.0)
    found = pair_motions(store)
    angle = np.degrees(np.arccos((np.trace(store.R, axis1=1, axis2=2) - 1) / 2))
    np.testing.assert_allclose(found["rotation"], angle, atol=1e-4)
    np.testing.assert_allclose(found["forward"], np.abs(store.t[:, 2]) / np.linalg.norm(store.t, axis=1))
    assert (found["parallax"] > 0).all()
    assert (found["inliers"] > 0.4).all()
    store.F[0] = np.nan
    assert np.isnan(pair_motions(store)["parallax"][0])

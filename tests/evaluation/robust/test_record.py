"""Runs of robust estimators and minimal solvers."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.synthetic.synthetic_store import synthetic_store
from kornia_learnnorm.data.writer import write_store
from kornia_learnnorm.evaluation.robust import peers, record
from kornia_learnnorm.evaluation.robust.estimators import find_estimator
from kornia_learnnorm.evaluation.robust.matches import draw_matches, measure
from kornia_learnnorm.evaluation.robust.run import estimate_path, hypotheses_path, read_robust


@pytest.fixture(autouse=True)
def _small(small_budgets):
    with small_budgets():
        yield


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}


def test_files(robust_run):
    assert len(times(robust_run / "robust")) == 2 * 2 * 6  # protocols, thresholds, estimators
    assert len(times(robust_run / "hypotheses")) == 2 * 3
    cell = read_robust(robust_run).cells[1]
    assert cell.title == "kitti_06, unfiltered"
    assert cell.estimates["count:Hartley"][0.1]["f1"].shape == (3, 2)
    assert cell.estimates["RANSAC"][1.0]["F_mat"].shape == (3, 1, 3, 3)
    assert cell.hypotheses["whitening"]["error"].shape == (3, 30)


def test_figures_are_those_of_the_estimator(robust_run, robust_store):
    drawn = draw_matches(read_store(robust_store), 2, "filtered", 0, 1)
    (found,) = find_estimator("count:whitening")(drawn, 1, [1.0])
    figures = read_robust(robust_run).cells[0].estimates["count:whitening"][1.0]
    assert torch.equal(figures["F_mat"][2, 1], found.F_mat)
    for key, value in measure(drawn, found.F_mat, 1.0).items():
        assert figures[key][2, 1].item() == value


def test_again_computes_nothing(robust_copied, robust_again, monkeypatch):
    before = times(robust_copied)
    monkeypatch.setattr(record, "run_estimator", pytest.fail)
    monkeypatch.setattr(record, "hypothesis_quality", pytest.fail)
    assert main(robust_again) == 0
    assert times(robust_copied) == before


def test_resumes_with_what_is_missing(robust_copied, robust_again, robust_run):
    paths = [
        estimate_path(robust_copied, "kitti_06", "filtered", 1.0, "count:Hartley"),
        hypotheses_path(robust_copied, "kitti_06", "unfiltered", "Hartley"),
    ]
    names = [path.relative_to(robust_copied) for path in paths]
    for name in names:
        (robust_copied / name).unlink()
    assert main(robust_again) == 0
    for name in names:
        new, old = np.load(robust_copied / name), np.load(robust_run / name)
        for key in {*old.files} - {"seconds"}:
            np.testing.assert_array_equal(new[key], old[key])


def test_redo(robust_copied, robust_again, refused):
    before = times(robust_copied)
    about = json.loads((robust_copied / "run.json").read_text())
    about["robust"]["estimators"]["RANSAC"] = "RANSAC of old"
    (robust_copied / "run.json").write_text(json.dumps(about))
    refused(robust_again, "is a run of other options, remove it or write elsewhere: RANSAC 'RANSAC of old'")
    assert main([*robust_again, "--redo", "RANSAC"]) == 0
    changed = {path.name for path, time in times(robust_copied).items() if time != before[path]}
    assert changed == {"RANSAC.npz"}
    refused([*robust_again, "--redo", "poselib"], "--redo poselib: not among the estimators and solvers")


def test_other_options_are_refused(robust_again, refused):
    for option in ("--seeds", "--pairs", "--seed", "--slow-seeds", "--hypotheses"):
        refused([*robust_again, option, "3"], "is a run of other options")
    refused([*robust_again, "--seeds", "0"], "seeds must be 1 or more, got 0")
    refused([*robust_again, "--pairs", "-1"], "pairs must be 0 or more, got -1")


def test_estimators_and_stores_join(robust_copied, tmp_path):
    write_store(tmp_path / "other.h5", synthetic_store(pairs=1, points=40, seed=2, scenes=["orbit"]))
    before = [*read_robust(robust_copied).about["estimators"]]
    options = ["--seeds", "2", "--solvers", "--estimators", "count:Hartley", "count:reweighted"]
    assert main(["robust", str(tmp_path / "other.h5"), *options, "--out", str(robust_copied)]) == 0
    found = read_robust(robust_copied)
    assert [*found.about["stores"]] == ["kitti_06", "other"]
    assert [*found.about["estimators"]] == [*before, "count:reweighted"]
    assert [*found.cells[3].estimates] == ["count:Hartley", "count:reweighted"]


def test_a_package_that_is_not_installed(robust_copied, robust_store, monkeypatch):
    monkeypatch.setitem(peers.PEERS, "poselib", peers.PeerPackage(pytest.fail, "no_such_module", "poselib"))
    options = ["--seeds", "2", "--estimators", "poselib", "--solvers"]
    assert main(["robust", str(robust_store), *options, "--out", str(robust_copied)]) == 0
    assert read_robust(robust_copied).about["estimators"]["poselib"] is None


def test_damaged(robust_copied, robust_again, refused):
    path = robust_copied / "robust/kitti_06/filtered/1px/RANSAC.npz"
    whole = path.read_bytes()
    for content in (b"", b"bad", whole[:100]):
        path.write_bytes(content)
        for again in (["report", robust_copied], robust_again):
            refused(again, f"{path} is damaged, remove it")
    (robust_copied / "run.json").write_text('{"format": 4, "robust": {"stores": {}}}')
    for again in (["report", robust_copied], robust_again):
        refused(again, "run.json is damaged: estimators, solvers, versions, pairs")


def test_what_fails_is_left_out_and_others_go_on(robust_store, tmp_path, monkeypatch, capsys):
    text = "from kornia_learnnorm import Hartley\ndef Bad(points1, points2, weights):\n    raise RuntimeError('boom')\n"
    (tmp_path / "own.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    out = tmp_path / "run"
    command = ["robust", str(robust_store), "--pairs", "1", "--seeds", "1", "--out", str(out), "--estimators"]
    assert main([*command, "RANSAC:own:Bad", "RANSAC", "--solvers", "own:Bad", "own:Hartley"]) == 2
    error = capsys.readouterr().err
    assert "boom" in error
    assert f"All others are in {out}" in error
    found = read_robust(out)
    assert found.missing == []
    assert [*found.cells[0].estimates] == ["RANSAC"]
    assert [*found.cells[0].hypotheses] == ["own:Hartley"]
    assert found.cells[0].estimates["RANSAC"][1.0]["samples"].min() >= 1
    assert main(["report", str(out)]) == 0

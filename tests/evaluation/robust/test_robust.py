"""Robust estimators by name, and runs of them: what is computed, kept, refused and left out."""

import json
import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from scenes import raises, shaken_estimator

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.evaluation.robust import peers, robust_estimators
from kornia_learnnorm.evaluation.robust.robust_estimators import DEFAULT_ESTIMATORS, find_estimator, run_estimator
from kornia_learnnorm.evaluation.robust.robust_run import estimate_path, measure, read_robust, shuffled_pair


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}


def matches(noise=0.2, outliers=0.2):
    """The correspondences of a synthetic image pair."""
    store = synthetic_store(1, 300, seed=3, noise=noise, outliers=outliers, scenes=["hand-held"])
    return shuffled_pair(store, 0, "unfiltered", 0)


def test_files_and_numbers(robust_run, robust_store):
    assert len(times(robust_run / "robust")) == 2 * 2 * 4  # protocols, thresholds, estimators
    filtered, unfiltered = read_robust(robust_run).cells
    assert unfiltered.title == "kitti_06, unfiltered"
    assert unfiltered.estimates["opencv-usac"][0.1]["f1"].shape == (2, 2)
    assert unfiltered.estimates["RANSAC"][1.0]["F_mat"].shape == (2, 1, 3, 3)
    drawn = shuffled_pair(read_store(robust_store), 2, "filtered", 0, 1)
    found = run_estimator(find_estimator("opencv-usac"), drawn, 1, 1.0)
    figures = filtered.estimates["opencv-usac"][1.0]
    assert torch.equal(figures["F_mat"][1, 1], found.F_mat)
    for key, value in measure(drawn, found.F_mat, 1.0).items():
        assert figures[key][1, 1].item() == value


def test_again_computes_nothing_but_what_is_missing(robust_copied, robust_again, robust_run, monkeypatch):
    path = estimate_path(robust_copied, "kitti_06", "filtered", 1.0, "RANSAC")
    path.unlink()
    before = times(robust_copied)
    assert main(robust_again) == 0
    new, old = np.load(path), np.load(robust_run / path.relative_to(robust_copied))
    for key in {*old.files} - {"seconds"}:
        np.testing.assert_array_equal(new[key], old[key])
    monkeypatch.setattr("kornia_learnnorm.evaluation.robust.robust_run.run_estimator", pytest.fail)
    assert main(robust_again) == 0
    assert {name: time for name, time in times(robust_copied).items() if name != path} == before


def test_redo(robust_copied, robust_again, refused):
    before = times(robust_copied)
    about = json.loads((robust_copied / "run.json").read_text())
    about["robust"]["estimators"]["opencv-usac"] = "opencv 1"
    (robust_copied / "run.json").write_text(json.dumps(about))
    refused(robust_again, "is a run of other options, remove it or write elsewhere: opencv-usac 'opencv 1'")
    assert main([*robust_again, "--redo", "opencv-usac"]) == 0
    changed = {path.name for path, time in times(robust_copied).items() if time != before[path]}
    assert changed == {"opencv-usac.npz"}
    refused([*robust_again, "--redo", "poselib"], "--redo poselib: not among the estimators of this command")


def test_other_options_are_refused(robust_again, refused):
    for option in ("--seeds", "--pairs", "--seed", "--slow-seeds"):
        refused([*robust_again, option, "3"], "is a run of other options")
    refused([*robust_again, "--seeds", "0"], "seeds must be 1 or more, got 0")
    refused([*robust_again, "--pairs", "-1"], "pairs must be 0 or more, got -1")


def test_a_package_that_is_not_installed(robust_copied, robust_store, monkeypatch):
    monkeypatch.setitem(peers.PEERS, "poselib", ("no_such_module", pytest.fail))
    options = ["--pairs", "2", "--seeds", "2", "--out", str(robust_copied), "--estimators", "poselib"]
    assert main(["robust", str(robust_store), *options]) == 2  # nothing to run
    assert main(["robust", str(robust_store), *options, "RANSAC"]) == 0
    assert read_robust(robust_copied).about["estimators"]["poselib"] is None


def test_what_fails_is_left_out_and_others_go_on(robust_store, tmp_path, monkeypatch, capsys):
    text = "from kornia_learnnorm import Hartley\ndef Bad(points1, points2, weights):\n    raise RuntimeError('boom')\n"
    (tmp_path / "own.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    out = tmp_path / "run"
    command = ["robust", str(robust_store), "--pairs", "1", "--seeds", "1", "--out", str(out), "--estimators"]
    assert main([*command, "RANSAC:own:Bad", "RANSAC"]) == 2
    error = capsys.readouterr().err
    assert all(text in error for text in ("boom", f"All others are in {out}"))
    found = read_robust(out)
    assert (found.missing, [*found.cells[0].estimates]) == ([], ["RANSAC"])
    assert found.cells[0].estimates["RANSAC"][1.0]["samples"].min() >= 1
    assert main(["report", str(out)]) == 0
    store = replace(read_store(robust_store), K=np.full((len(read_store(robust_store)), 2, 3, 3), np.nan))
    write_store(tmp_path / "bare.h5", store)
    options = ["--out", str(tmp_path / "other"), "--estimators", "RANSAC-calibrated"]
    assert main(["robust", str(tmp_path / "bare.h5"), *options]) == 2
    assert "RANSAC-calibrated need cameras, store bare has none: leave out either" in capsys.readouterr().err


def test_protocols_and_order():
    store = synthetic_store(2, 1500, seed=1, scenes=["orbit"])
    rows = slice(1500, 3000)
    everything = shuffled_pair(store, 1, "unfiltered", 0)
    assert {*map(tuple, everything.points1.float().tolist())} == {*map(tuple, store.points1[rows].tolist())}
    first, second, again = (shuffled_pair(store, 1, "filtered", 0, order).points1 for order in (0, 1, 0))
    assert len(first) == 1000
    ratio = {tuple(p): r for p, r in zip(store.points1[rows].tolist(), store.ratio[rows], strict=True)}
    assert max(ratio[tuple(p)] for p in first.float().tolist()) < 0.8
    assert not torch.equal(first, second)
    assert torch.equal(*(torch.unique(points, dim=0) for points in (first, second)))
    assert torch.equal(first, again)


def test_measure():
    drawn = matches()
    true = measure(drawn, drawn.F_mat, 0.5)
    assert true["f1"] == 1
    assert max(true["rotation_error"], true["translation_error"]) < 1e-4
    failed = measure(drawn, torch.full((3, 3), torch.nan, dtype=torch.float64), 1.0)
    assert failed["inliers"] == failed["f1"] == 0
    assert failed["error"] == failed["rotation_error"] == failed["translation_error"] == math.inf
    unknown = drawn._replace(F_mat=drawn.F_mat * torch.nan, R=drawn.R * torch.nan, t=drawn.t * torch.nan)
    found = measure(unknown, drawn.F_mat, 1.0)
    assert found["inliers"] > 0.5
    assert all(math.isnan(found[key]) for key in ("f1", "error", "rotation_error", "translation_error"))


KNOWN_CAMERAS = ["RANSAC-calibrated", "poselib-calibrated", "opencv-usac-magsac-calibrated"]


@pytest.mark.parametrize("name", [*DEFAULT_ESTIMATORS, *KNOWN_CAMERAS, "RANSAC:Hartley+optimal"])
def test_each_finds_the_truth(name):
    try:
        estimator = find_estimator(name)
    except ImportError as error:
        pytest.skip(str(error))
    drawn = matches()
    found = run_estimator(estimator, drawn, 0, 1.0)
    assert (found.F_mat.shape, found.F_mat.dtype) == ((3, 3), torch.float64)
    assert found.seconds > 0
    figures = measure(drawn, found.F_mat, 1.0)
    assert figures["error"] < 1.5
    assert figures["f1"] > 0.5


@pytest.mark.parametrize("name", KNOWN_CAMERAS)
def test_known_cameras(name):
    """The matrix has the essential one's equal singular values; without cameras there is none."""
    if name.startswith("poselib"):
        pytest.importorskip("poselib", reason="PoseLib is not installed")
    drawn, estimator = matches(), find_estimator(name)
    found = run_estimator(estimator, drawn, 0, 1.0)
    values = np.linalg.svd((drawn.K[1].mT @ found.F_mat @ drawn.K[0]).numpy())[1]
    assert values[1] == pytest.approx(values[0], rel=1e-6)
    assert measure(drawn, found.F_mat, 1.0)["rotation_error"] < 1
    assert run_estimator(estimator, drawn._replace(K=drawn.K * torch.nan), 0, 1.0).F_mat.isnan().all()


@pytest.mark.parametrize("name", ["learned:{}", "learned:{}+LM", "guided:{}"])
def test_learned_weights_in_a_file(name, tmp_path):
    layer, file = shaken_estimator(), tmp_path / "mine.safetensors"
    layer.save_pretrained(file)
    drawn = matches(outliers=0.0)
    found = run_estimator(find_estimator(name.format(file)), drawn, 0, 1.0)
    points1, points2 = drawn.points1[None], drawn.points2[None]
    with torch.no_grad():
        expected, weights = (layer.estimate(points1, points2)[i] for i in (0, 4))
    if name.endswith("+LM"):
        expected = kln.refine_fundamental(points1, points2, expected, loss=kln.GemanMcClure(1.0)).F_mat
    if name.startswith("guided"):
        expected = kln.RANSAC(seed=0)(drawn.points1, drawn.points2, weights[0])[0][None]
    assert torch.allclose(found.F_mat, expected[0], rtol=1e-6, atol=1e-12)
    assert file.name in robust_estimators.identify_estimator(name.format(file))


def test_learned_relative_pose_takes_cameras_and_scores(tmp_path):
    layer, drawn = kln.LearnedRelativePose(width=16, depth=1).eval(), matches(outliers=0.2)
    layer.save_pretrained(tmp_path / "pose.safetensors")
    name = f"learned:{tmp_path / 'pose.safetensors'}"
    found = run_estimator(find_estimator(f"{name}+scores"), drawn, 0, 1.0).F_mat
    with torch.no_grad():
        points = drawn.points1[None], drawn.points2[None]
        expected = layer.estimate(*points, *drawn.K, scores=drawn.scores[None]).F_mat[0]
    assert torch.allclose(found / found.norm(), expected) or torch.allclose(-found / found.norm(), expected)
    unknown = drawn._replace(K=drawn.K * torch.nan)
    assert run_estimator(find_estimator(name), unknown, 0, 1.0).F_mat.isnan().all()
    assert robust_estimators.identify_estimator(f"{name}+scores").startswith(f"{name}+scores ")
    raises(ValueError, "refined by themselves", find_estimator, f"{name}+LM")


def test_the_seed_decides():
    drawn, estimator = matches(noise=0.5, outliers=0.4), find_estimator("RANSAC:Hartley")
    first, again, other = (run_estimator(estimator, drawn, seed, 1.0).F_mat for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_what_fails_is_a_failure(monkeypatch):
    for wrong in (None, np.zeros((9, 3))):
        monkeypatch.setitem(peers.PEERS, "poselib", ("math", lambda *_, wrong=wrong: wrong))
        assert run_estimator(find_estimator("poselib"), matches(), 0, 1.0).F_mat.isnan().all()
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    monkeypatch.setattr(cv2, "findFundamentalMat", Mock(side_effect=cv2.error("an assertion in USAC")))
    assert run_estimator(find_estimator("opencv-usac-magsac"), matches(), 0, 1.0).F_mat.isnan().all()
    few = matches()._replace(points1=torch.rand(7, 2).double(), points2=torch.rand(7, 2).double())
    assert run_estimator(find_estimator("RANSAC"), few, 0, 1.0).F_mat.isnan().all()


def test_unknown():
    for name, error, message in [
        *((name, ValueError, "no estimator") for name in ("nothing", "learned:", "guided:", "RANSAC:")),
        ("RANSAC:Hartley+LM", ValueError, "refines by itself"),
        ("RANSAC:nothing", FileNotFoundError, "no weights 'nothing'"),
    ]:
        raises(error, message, find_estimator, name)


def test_names(tmp_path):
    path = str(tmp_path / "mine" / "weights.safetensors")
    short = ["learned:mine", "learned:mine+scores", "RANSAC:mine", "poselib", "RANSAC:kornia_learnnorm:Whitening"]
    names = [name.replace("mine", path) for name in short]
    assert [*robust_estimators.estimator_names(names).values()] == short
    raises(ValueError, "same name", robust_estimators.estimator_names, ["RANSAC", "RANSAC"])
    kinds = ("poselib", "RANSAC:crossview", "learned:robust", "opencv-lmeds")
    assert [*filter(robust_estimators.is_slow, kinds)] == ["poselib", "RANSAC:crossview"]

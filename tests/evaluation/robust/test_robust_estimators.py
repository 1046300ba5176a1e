"""Robust estimators by name."""

import numpy as np
import pytest
import torch
from scenes import shaken_estimator

import kornia_learnnorm as kln
from kornia_learnnorm.evaluation.robust import peers, robust_estimators
from kornia_learnnorm.evaluation.robust.robust_estimators import DEFAULT_ESTIMATORS, find_estimator, run_estimator
from kornia_learnnorm.evaluation.robust.robust_run import measure

KNOWN_CAMERAS = ["RANSAC-calibrated", "poselib-calibrated", "opencv-usac-magsac-calibrated"]


@pytest.mark.parametrize("name", [*DEFAULT_ESTIMATORS, *KNOWN_CAMERAS, "RANSAC:Hartley+optimal"])
def test_each_finds_the_truth(name, matches):
    try:
        estimator = find_estimator(name)
    except ImportError as error:
        pytest.skip(str(error))
    drawn = matches()
    found = run_estimator(estimator, drawn, 0, 1.0)
    assert found.F_mat.shape == (3, 3)
    assert found.F_mat.dtype == torch.float64
    assert found.seconds > 0
    figures = measure(drawn, found.F_mat, 1.0)
    assert figures["error"] < 1.5
    assert figures["f1"] > 0.5


@pytest.mark.parametrize("name", KNOWN_CAMERAS)
def test_known_cameras(name, matches):
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
def test_learned_weights_in_a_file(name, matches, tmp_path):
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


def test_learned_relative_pose_takes_cameras_and_scores(matches, tmp_path):
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
    with pytest.raises(ValueError, match="refined by themselves"):
        find_estimator(f"{name}+LM")


def test_the_seed_decides(matches):
    drawn, estimator = matches(noise=0.5, outliers=0.4), find_estimator("RANSAC:Hartley")
    first, again, other = (run_estimator(estimator, drawn, seed, 1.0).F_mat for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_what_fails_is_a_failure(monkeypatch, matches):
    for wrong in (None, np.zeros((9, 3))):
        package = peers.PeerPackage(lambda *_, wrong=wrong: wrong, "math")
        monkeypatch.setitem(peers.PEERS, "poselib", package)
        assert run_estimator(find_estimator("poselib"), matches(), 0, 1.0).F_mat.isnan().all()
    few = matches()._replace(points1=torch.rand(7, 2).double(), points2=torch.rand(7, 2).double())
    assert run_estimator(find_estimator("RANSAC"), few, 0, 1.0).F_mat.isnan().all()


def test_unknown():
    for name, error, message in [
        *((name, ValueError, "no estimator") for name in ("nothing", "learned:", "guided:", "RANSAC:")),
        ("RANSAC:Hartley+LM", ValueError, "refines by itself"),
        ("RANSAC:nothing", FileNotFoundError, "no weights 'nothing'"),
    ]:
        with pytest.raises(error, match=message):
            find_estimator(name)


def test_names(tmp_path):
    path = str(tmp_path / "mine" / "weights.safetensors")
    names = [
        f"learned:{path}",
        f"learned:{path}+scores",
        f"RANSAC:{path}",
        "poselib",
        "RANSAC:kornia_learnnorm:Whitening",
    ]
    short = ["learned:mine", "learned:mine+scores", "RANSAC:mine", "poselib", "RANSAC:kornia_learnnorm:Whitening"]
    assert [*robust_estimators.estimator_names(names).values()] == short
    with pytest.raises(ValueError, match="same name"):
        robust_estimators.estimator_names(["RANSAC", "RANSAC"])
    kinds = ("poselib", "RANSAC:crossview", "learned:robust", "opencv-lmeds")
    assert [*filter(robust_estimators.is_slow, kinds)] == ["poselib", "RANSAC:crossview"]

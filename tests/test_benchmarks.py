"""The scores of benchmarks/pairs.py on cases whose outcome is known, its tables, and what the other benchmarks time."""

import argparse
import json
import math
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from kornia.geometry.linalg import transform_points
from make_sequences import texture
from PIL import Image
from references import epipolar_distances
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.datasets.frames import Frame, FramePair, fundamental_from_motion
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.two_view.result import NoReliableMatrixError

pytest.importorskip("cv2")
import cv2
import pairs
import planes
import poses
import real_pairs
import refined
import speed
from rendered import KINDS, render_kind
from shared import read_csv

SIZE = (320, 240)


@pytest.fixture(scope="module")
def case():
    return pairs.rendered("room", 0, (160, 120), None)


def answer(case, F_mat: Tensor, **more) -> SimpleNamespace:
    inliers, choice = torch.ones(len(case.points1), dtype=torch.bool), SimpleNamespace(by_gric="homography")
    points = {"points1": case.points1, "points2": case.points2, "inliers": inliers, "warnings": [], "choice": choice}
    matrices = {"model": "fundamental", "matrix": F_mat, "F_mat": F_mat, "H_mat": None, "R": None, "t": None}
    return SimpleNamespace(**{**matrices, **points, "predicted_error": 1.0, **more})


def answer_homography(case, H_mat: Tensor, **more) -> SimpleNamespace:
    return answer(case, true_matrix(case), model="homography", matrix=H_mat, H_mat=H_mat, **more)


def true_matrix(case) -> Tensor:
    return fundamental_from_motion(case.K, case.K, case.R, case.t)


class TestPairs:
    def test_right_and_wrong_answers(self, case):
        record = pairs.score(case, lambda case: answer(case, true_matrix(case)))
        assert record["determined"]
        assert max(record["pose_error"], record["true_error"]) < 1e-6
        assert record["inliers"] == record["matches"] == len(case.points1)
        assert pairs.outcome(record) == "right"
        along_y = case._replace(R=torch.eye(3).double(), t=torch.tensor([0.0, 1.0, 0.0]).double())
        record = pairs.score(case, lambda case: answer(case, true_matrix(along_y)))
        assert min(record["pose_error"] / 45, record["true_error"]) > 1
        assert pairs.outcome(record) == "wrong"
        assert pairs.outcome(record | {"warnings": ["planar"]}) == "wrong, flagged"

    def test_right_and_wrong_homographies(self, case):
        H_mat = case.K @ case.R @ torch.linalg.inv(case.K)
        turned = case._replace(t=torch.zeros(3).double(), points2=transform_points(H_mat[None], case.points1[None])[0])
        for R, outcome in ((None, "right"), (case.R, "right"), (torch.diag(torch.tensor([-1.0, -1, 1])), "wrong")):
            found = answer_homography(turned, H_mat, R=None if R is None else R.double())
            record = pairs.score(turned, lambda case, found=found: found)
            assert (pairs.outcome(record), record["model"], record["gric"]) == (outcome, "homography", "homography")
            assert record["true_error"] < 1e-6
        assert pairs.outcome(pairs.score(case, lambda case: answer_homography(case, H_mat))) == "wrong"
        # A rotation where the camera moved, and a translation of the wrong sign.
        assert pairs.error_of_pose(case, answer_homography(case, H_mat, R=case.R)) == math.inf
        assert pairs.error_of_pose(case, answer_homography(case, H_mat, R=case.R, t=-case.t)) == pytest.approx(180)

    def test_a_fault_of_the_estimator_is_no_refusal(self, case, capsys):
        refused = pairs.score(case, Mock(side_effect=NoReliableMatrixError("blank", "image 1 is blank")))
        assert (refused["refused"], pairs.described(refused)) == ("blank", "refused (blank)")
        assert pairs.outcome(pairs.score(case, Mock(side_effect=ZeroDivisionError()))) == "crashed"
        assert "room 0: ZeroDivisionError()" in capsys.readouterr().err

    def test_runs(self, tmp_path):
        arguments = ["--pairs", "3", "--kinds", "plane", "rotation", "outliers", "--size", "160", "120"]
        pairs.main([*arguments, "--json", str(tmp_path / "pairs.json")])
        records = json.loads((tmp_path / "pairs.json").read_text())
        assert [record["kind"] for record in records] == ["plane", "rotation", "outliers"]
        assert [record["determined"] for record in records] == [False, False, True]
        assert {record["crashed"] for record in records} == {None}


def test_real_pairs_get_the_same_matches_and_cameras_where_known(case):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = case.R.mT, -case.R.mT @ case.t  # camera 2 to camera 1, which is the world
    first = Frame(Path("1.png"), "1.png", "room", (160, 120), case.K.numpy(), np.eye(4))
    second = Frame(Path("2.png"), "2.png", "room", (160, 120), case.K.numpy(), pose)
    order = torch.randperm(len(case.points1), generator=torch.Generator().manual_seed(0))[:60]
    matches = case.points1[order], case.points2[order]
    given = dict.fromkeys(("size1", "size2"), (160, 120))
    matched = SimpleNamespace(estimate=lambda **K: kln.estimate_matches(*matches, **given, **K))
    real_pair = real_pairs.Pair("tum", 3, FramePair(first, second), True, "sift+nearest", matched)
    seen = []

    def peer(x1, x2, sizes, seed, threshold, *cameras):
        seen.append((len(x1), len(cameras)))
        return true_matrix(case).numpy() if len(x1) > 20 else None

    records = real_pairs.measure(real_pair, {"poselib": peer}, (8, 20, 0))
    assert [record["size"] for record in records] == [0, 8, 20]
    assert records[0]["poselib"] < 1e-5
    assert [record["poselib"] for record in records[1:]] == [math.inf] * 2
    assert max(records[0]["estimate_pair"][key] for key in ("error", "true")) < 1e-3
    assert records[1]["estimate_pair"]["refused"] == "few_matches"
    real_pairs.measure(real_pair._replace(calibrated=False), {"poselib": peer}, ())
    assert seen == [(60, 1), (8, 1), (20, 1), (60, 0)]


@pytest.mark.parametrize("backward", [False, True])
def test_every_method_is_timed(backward, monkeypatch):
    monkeypatch.setattr(speed, "SECONDS", 1e-3)
    monkeypatch.setattr(speed, "MIN_TURNS", 1)
    args = argparse.Namespace(device="cpu", dtype="float64", quick=True)
    methods = speed.solvers("cpu") | ({} if backward else speed.single_pairs())
    times = speed.measure(methods, speed.Case(2, 12), args, backward)
    assert times.keys() == methods.keys()
    assert min(times.values()) > 0


def test_poses_of_a_store(tmp_path):
    store, file = tmp_path / "pairs.h5", tmp_path / "poses.csv"
    write_store(store, synthetic_store(2, points=80, scenes=["orbit"]))
    names = ["RANSAC-calibrated", "learned:robust-pose-synthetic+scores"]
    poses.main([str(store), "--rotated", "90", "--estimators", *names, "--csv", str(file)])
    header, *rows = read_csv(file)
    assert header == ["store", *poses.HEADER]
    assert [row[:2] for row in rows] == [["pairs", name] for name in names]
    assert all(float(row[2]) > 50 for row in rows)


def test_planes(tmp_path):
    file = tmp_path / "planes.csv"
    planes.main(["--sizes", "64", "--outliers", "0.2", "--sets", "3", "--rotated", "90", "--csv", str(file)])
    header, *rows = read_csv(file)
    assert header == ["outliers", "N", *planes.HEADER]
    errors = {row[2]: float(row[3]) for row in rows}
    assert max(errors[name] for name in ("RANSAC", "opencv-usac-magsac", "learned:robust-homography")) < 20
    assert errors["kornia-dlt"] > 20
    assert planes.corner_error(None, torch.eye(3).double(), torch.zeros(4, 2).double()) == planes.MAX_ERROR


def test_refined_matches_beside_found_and_tracked_ones(tmp_path):
    store = synthetic_store(1, points=60, seed=0)
    write_store(tmp_path / "store.h5", store)
    image, untrained = texture(0, 640, 480), tmp_path / "untrained.safetensors"
    for name, (width, height) in zip(np.ravel(store.names), store.image_size.reshape(-1, 2), strict=True):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.resize(image, (height, width))).save(tmp_path / name, format="png")
    kln.MatchRefiner().save_pretrained(untrained)
    file = tmp_path / "refined.csv"
    options = [str(tmp_path / "store.h5"), "--images", str(tmp_path), "--pairs", "1", "--estimators", "ground-truth"]
    options += ["--csv", str(file), "--weights", str(untrained)]
    for _ in range(2):  # rows of a store are replaced
        refined.main(options)
    header, *rows = read_csv(file)
    assert header == ["store", "matches", "px", "fit", "ground-truth", "ms"]
    assert [row[:2] for row in rows] == [["store", name] for name in ("found", "moved", "Lucas-Kanade")]
    assert rows[0][2:5] == rows[1][2:5]  # untrained, it moves nothing


def test_reconstruction(real_data, tmp_path):
    pytest.importorskip("pycolmap")
    source, names = real_data / "images/photographs", [f"fountain-P11/000{number}.jpg" for number in range(3, 7)]
    cameras = json.loads((source / "cameras.json").read_text())
    half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    (tmp_path / "fountain-P11").mkdir()
    for name in names:
        with Image.open(source / name) as image:
            image.reduce(2).crop((0, 0, 512, 341)).save(tmp_path / name, quality=95)
        cameras[name]["K"] = (half @ cameras[name]["K"]).tolist()
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    options = ["--methods", "COLMAP", "RANSAC", "--csv", str(tmp_path / "table.csv")]
    import_module("reconstruction").main([str(tmp_path), *options])
    _, *rows = read_csv(tmp_path / "table.csv")
    assert [row[2:4] for row in rows[:2]] == [["given", "COLMAP"], ["given", "RANSAC"]]
    for row in rows[:2]:
        assert row[6] == "4 of 4"  # images
        assert float(row[8]) < 50  # centres, mm


@pytest.mark.parametrize(("kind", "seed"), [*((kind, 0) for kind in KINDS), ("borders", 1)])
def test_images_show_the_correspondences(kind, seed):
    pair = render_kind(kind, seed, *SIZE)
    assert len(pair.points1) == len(pair.points2) >= 500
    for points in (pair.points1, pair.points2):
        assert ((points >= 0) & (points <= np.array(SIZE) - 1)).all()
    smooth = [cv2.GaussianBlur(image, None, 1.0) for image in (pair.image1, pair.image2)]
    places = [x.astype(np.float32)[:, None] for x in (pair.points1, pair.points2)]
    values = [cv2.remap(smooth[k], places[k], None, cv2.INTER_LINEAR) for k in range(2)]
    assert np.corrcoef(values[0].ravel(), values[1].ravel())[0, 1] > 0.85  # 0 for points that do not correspond
    if kind == "rotation":
        H = pair.K @ pair.R @ np.linalg.inv(pair.K)
        np.testing.assert_allclose(cv2.perspectiveTransform(pair.points1[None], H)[0], pair.points2, atol=1e-9)
        assert np.isnan(pair.F_mat).all()
        assert pair.t.tolist() == [0, 0, 0]
        return
    assert epipolar_distances(pair.points1, pair.points2, pair.F_mat).max() < 1e-6

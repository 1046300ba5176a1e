"""Robust estimators on stores, the hypotheses of minimal solvers, and the report of both."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil

import numpy as np
import pytest
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.cli.report import write_report
from kornia_learnnorm.cli.synthesize import synthetic_store
from kornia_learnnorm.data.store import read_store, write_store
from kornia_learnnorm.evaluation.report.hypotheses import hypothesis_tables
from kornia_learnnorm.evaluation.report.robust import PRINTED, robust_tables
from kornia_learnnorm.evaluation.robust import estimators as robust_estimators
from kornia_learnnorm.evaluation.robust import hypotheses
from kornia_learnnorm.evaluation.robust import peers as robust_peers
from kornia_learnnorm.evaluation.robust import record as robust_record
from kornia_learnnorm.evaluation.robust.budgets import minimal_samples, run_estimator
from kornia_learnnorm.evaluation.robust.estimators import (
    DEFAULT_ESTIMATORS,
    estimator_names,
    find_estimator,
    find_solver,
    is_slow,
)
from kornia_learnnorm.evaluation.robust.hypotheses import expected_best, hypothesis_quality, picked
from kornia_learnnorm.evaluation.robust.matches import draw_matches, measure
from kornia_learnnorm.evaluation.robust.run import read_robust
from kornia_learnnorm.evaluation.runs import example
from kornia_learnnorm.metrics.pairs import f1_score

ESTIMATORS = ["kornia-8pt", "count:Hartley", "count:whitening", "time:Hartley", "time:whitening", "RANSAC"]
SOLVERS = ["Hartley", "whitening", "seven-point"]


def matches(noise=0.2, outliers=0.2, points=300):
    store = synthetic_store(1, points, seed=3, noise=noise, outliers=outliers, scenes=["hand-held"])
    return draw_matches(store, 0, "unfiltered", 0)


class TestEstimators:
    @pytest.mark.parametrize("name", [*DEFAULT_ESTIMATORS, "count:none", "RANSAC:Hartley+optimal"])
    def test_each_finds_the_truth(self, name):
        try:
            estimator = find_estimator(name)
        except ImportError as error:
            pytest.skip(str(error))
        drawn = matches()
        (found,) = run_estimator(estimator, drawn, 0, [1.0])
        assert found.F_mat.shape == (3, 3)
        assert found.F_mat.dtype == torch.float64
        assert found.seconds > 0 or name == "ground-truth"
        figures = measure(drawn, found.F_mat, 1.0)
        assert figures["error"] < 1.5
        assert figures["f1"] > 0.5
        if name.startswith("count:"):
            assert found.samples == 1000
        if name.startswith("time:"):
            assert found.samples >= 1

    def test_equal_samples_by_hand(self):
        """The matrix of highest MSAC score among those of the samples, for each threshold."""
        drawn = matches(noise=0.5, outliers=0.4)
        found = run_estimator(find_estimator("count:whitening"), drawn, 4, [0.1, 1.0])
        rows = minimal_samples(300, 1000, 4)
        assert (rows.sort(-1).values.diff(dim=-1) > 0).all()
        F_mat = kln.find_fundamental(drawn.points1[rows], drawn.points2[rows], normalizer=kln.Whitening())
        distance = kln.sampson_distance(drawn.points1[None], drawn.points2[None], F_mat)
        for threshold, estimate in zip([0.1, 1.0], found, strict=True):
            scores = (1 - (distance / threshold).square()).clamp(min=0).sum(-1)
            own = kln.sampson_distance(drawn.points1, drawn.points2, estimate.F_mat)
            own_score = (1 - (own / threshold).square()).clamp(min=0).sum()
            assert own_score.item() == pytest.approx(scores.max().item(), rel=1e-3)

    def test_the_seed_decides(self):
        drawn, estimator = matches(), find_estimator("count:Hartley")
        first, again, other = (estimator(drawn, seed, [1.0])[0].F_mat for seed in (0, 0, 1))
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_too_few_correspondences_fail(self):
        drawn = matches()
        drawn = drawn._replace(points1=drawn.points1[:7], points2=drawn.points2[:7])
        found = run_estimator(find_estimator("RANSAC"), drawn, 0, [0.1, 1.0])
        assert [estimate.F_mat.isnan().all().item() for estimate in found] == [True, True]

    def test_what_fails_is_a_failure(self, monkeypatch):
        for wrong in (None, np.zeros((9, 3))):
            monkeypatch.setitem(robust_peers.PEERS, "poselib", (lambda wrong=wrong: lambda *_: wrong, "poselib"))
            assert find_estimator("poselib")(matches(), 0, [1.0])[0].F_mat.isnan().all()

    @pytest.mark.parametrize(
        ("name", "error", "message"),
        [
            *((name, ValueError, "no estimator") for name in ("nothing", "count", "time:", "count:", "RANSAC:")),
            ("RANSAC:Hartley+LM", ValueError, "refines by itself"),
            ("count:nothing", FileNotFoundError, "no weights 'nothing'"),
        ],
    )
    def test_unknown(self, name, error, message):
        with pytest.raises(error, match=message):
            find_estimator(name)

    def test_names(self, tmp_path):
        path = str(tmp_path / "mine" / "weights.safetensors")
        names = [path, f"count:{path}", f"RANSAC:{path}", "RANSAC", "poselib", "count:kornia_learnnorm:Whitening"]
        short = ["mine", "count:mine", "RANSAC:mine", "RANSAC", "poselib", "count:kornia_learnnorm:Whitening"]
        assert [*estimator_names(names).values()] == short
        with pytest.raises(ValueError, match="same name"):
            estimator_names(["RANSAC", "RANSAC"])

    def test_slow_ones(self):
        names = ("poselib", "RANSAC:crossview", "count:paper", "time:paper", "opencv-lmeds")
        assert [*map(is_slow, names)] == [True, True, False, False, False]


class TestMatches:
    def test_protocols(self):
        store = synthetic_store(2, 1500, seed=1, scenes=["orbit"])
        everything = draw_matches(store, 1, "unfiltered", 0)
        rows = slice(1500, 3000)
        assert {*map(tuple, everything.points1.float().tolist())} == {*map(tuple, store.points1[rows].tolist())}
        filtered = draw_matches(store, 1, "filtered", 0)
        assert len(filtered.points1) == 1000
        ratio = {tuple(p): r for p, r in zip(store.points1[rows].tolist(), store.ratio[rows], strict=True)}
        assert max(ratio[tuple(p)] for p in filtered.points1.float().tolist()) < 0.8

    def test_order(self):
        store = synthetic_store(1, 1500, seed=1, scenes=["orbit"])
        first, second = (draw_matches(store, 0, "filtered", 0, order).points1 for order in (0, 1))
        assert not torch.equal(first, second)
        assert torch.equal(*(torch.unique(points, dim=0) for points in (first, second)))
        assert torch.equal(first, draw_matches(store, 0, "filtered", 0, 0).points1)

    def test_measure(self):
        drawn = matches()
        true = measure(drawn, drawn.F_mat, 0.5)
        assert true["f1"] == 1
        assert max(true["rotation_error"], true["translation_error"]) < 1e-4
        F_mat = drawn.F_mat * (1 + 1e-3 * torch.randn(3, 3, dtype=torch.float64))
        expected = f1_score(drawn.points1, drawn.points2, F_mat, drawn.F_mat, 0.5)
        assert measure(drawn, F_mat, 0.5)["f1"] == pytest.approx(expected.item())

    def test_measure_of_a_failure_and_without_truth(self):
        drawn = matches()
        failed = measure(drawn, torch.full((3, 3), torch.nan, dtype=torch.float64), 1.0)
        assert failed["inliers"] == failed["f1"] == 0
        assert failed["error"] == failed["rotation_error"] == failed["translation_error"] == math.inf
        unknown = drawn._replace(F_mat=drawn.F_mat * torch.nan, R=drawn.R * torch.nan, t=drawn.t * torch.nan)
        found = measure(unknown, drawn.F_mat, 1.0)
        assert found["inliers"] > 0.5
        assert all(math.isnan(found[key]) for key in ("f1", "error", "rotation_error", "translation_error"))


class TestHypotheses:
    def test_expected_best_by_brute_force(self):
        errors = torch.tensor([4.0, 1.0, 1.0, 9.0, 2.5, 60.0], dtype=torch.float64)
        for number in range(1, 7):
            smallest = [min(group) for group in itertools.combinations(errors.tolist(), number)]
            assert expected_best(errors, number).item() == pytest.approx(np.mean(smallest), rel=1e-12)

    @pytest.mark.parametrize("number", [1, 10, 1000, 9999, 10_000])
    def test_expected_best_of_many(self, number):
        """The smallest of k of the numbers 1 ... n has mean (n + 1) / (k + 1)."""
        errors = 1 + torch.randperm(10_000).double()
        assert expected_best(errors, number).item() == pytest.approx(10_001 / (number + 1), rel=1e-9)

    def test_picked_by_brute_force(self):
        errors, scores = torch.rand(2, 2, 11, dtype=torch.float64)
        for number in (1, 2, 3, 5, 11):
            for row in range(2):
                groups = [range(i, i + number) for i in range(0, 11 - number + 1, number)]
                best = [errors[row, max(group, key=lambda i: scores[row, i])].item() for group in groups]
                assert picked(errors, scores, number)[row].item() == pytest.approx(np.mean(best))

    @pytest.mark.parametrize("number", [0, 4])
    def test_not_so_many(self, number):
        with pytest.raises(ValueError, match="was asked for, there are 3 errors"):
            expected_best(torch.rand(3), number)
        with pytest.raises(ValueError, match="was asked for, there are 3 errors"):
            picked(torch.rand(3), torch.rand(3), number)

    def test_figures_are_those_of_the_functions(self):
        drawn = matches(noise=0.5, outliers=0.3)
        errors, scores = hypothesis_quality(find_solver("Hartley"), drawn, 40, 2)
        rows = minimal_samples(300, hypotheses.NUMBERS[-1], 2)[:40]
        F_mat = kln.find_fundamental(drawn.points1[rows], drawn.points2[rows])
        near = kln.symmetric_epipolar_distance(drawn.points1, drawn.points2, drawn.F_mat) < 1
        points = drawn.points1[None].expand(40, -1, -1), drawn.points2[None].expand(40, -1, -1)
        expected = kln.symmetric_epipolar_distance(*points, F_mat)[:, near].mean(-1).clamp(max=60)
        torch.testing.assert_close(errors, expected)
        msac = (1 - kln.sampson_distance(*points, F_mat).square()).clamp(min=0).sum(-1)
        torch.testing.assert_close(scores, msac)
        torch.testing.assert_close(hypothesis_quality(find_solver("Hartley"), drawn, 10, 2)[0], errors[:10])

    def test_seven_points_take_the_candidate_of_highest_score(self):
        drawn = matches(noise=0.5, outliers=0.0)
        solver = find_solver("seven-point")
        errors, scores = hypothesis_quality(solver, drawn, 20, 0)
        rows = minimal_samples(300, hypotheses.NUMBERS[-1], 0)[:20, :7]
        candidates = solver.solve(drawn.points1[rows], drawn.points2[rows])
        points = drawn.points1[None, None].expand(20, 3, -1, -1), drawn.points2[None, None].expand(20, 3, -1, -1)
        distance = kln.sampson_distance(*points, candidates).nan_to_num(nan=torch.inf)
        torch.testing.assert_close(scores, (1 - distance.square()).clamp(min=0).sum(-1).max(-1).values)
        assert (errors > 0).all()

    def test_without_ground_truth(self):
        drawn = matches()
        errors, _ = hypothesis_quality(find_solver("Hartley"), drawn._replace(F_mat=drawn.F_mat * torch.nan), 5, 0)
        assert errors.isnan().all()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "kitti_06.h5"
    write_store(path, synthetic_store(pairs=1, points=330, seed=1))
    return path


@pytest.fixture(scope="module")
def short():
    """Few samples, little time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robust_estimators, "COUNT", 50)
        patch.setattr(robust_estimators, "SECONDS", 0.005)
        patch.setattr(hypotheses, "NUMBERS", (1, 3, 10, 30))
        yield


@pytest.fixture(scope="module")
def command(store, short):
    return ["robust", str(store), "--seeds", "2", "--estimators", *ESTIMATORS, "--solvers", *SOLVERS, "--out"]


@pytest.fixture(scope="module")
def run(command, tmp_path_factory):
    """A run, not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert main([*command, str(folder)]) == 0
    return folder


@pytest.fixture
def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}


class TestRun:
    def test_files(self, run):
        assert len([*(run / "robust").rglob("*.npz")]) == 2 * 2 * len(ESTIMATORS)
        assert len([*(run / "hypotheses").rglob("*.npz")]) == 2 * len(SOLVERS)
        cell = read_robust(run).cells[1]
        assert cell.title == "kitti_06, unfiltered"
        assert cell.estimates["count:Hartley"][0.1]["f1"].shape == (3, 2)
        assert cell.estimates["RANSAC"][1.0]["F_mat"].shape == (3, 1, 3, 3)
        assert cell.hypotheses["whitening"]["error"].shape == (3, 30)

    def test_figures_are_those_of_the_estimator(self, run, store):
        drawn = draw_matches(read_store(store), 2, "filtered", 0, 1)
        (found,) = find_estimator("count:whitening")(drawn, 1, [1.0])
        figures = read_robust(run).cells[0].estimates["count:whitening"][1.0]
        assert torch.equal(figures["F_mat"][2, 1], found.F_mat)
        for key, value in measure(drawn, found.F_mat, 1.0).items():
            assert figures[key][2, 1].item() == value

    def test_again_computes_nothing(self, copied, command, monkeypatch):
        before = times(copied)
        monkeypatch.setattr(robust_record, "run_estimator", pytest.fail)
        monkeypatch.setattr(robust_record, "hypothesis_quality", pytest.fail)
        assert main([*command, str(copied)]) == 0
        assert times(copied) == before

    def test_resumes_with_what_is_missing(self, copied, command, run):
        paths = [
            copied / "robust/kitti_06/filtered/1px/count_Hartley.npz",
            copied / "hypotheses/kitti_06/unfiltered/Hartley.npz",
        ]
        for path in paths:
            path.unlink()
        assert main([*command, str(copied)]) == 0
        for path in paths:
            new, old = np.load(path), np.load(run / path.relative_to(copied))
            for key in {*old.files} - {"seconds"}:
                np.testing.assert_array_equal(new[key], old[key])

    def test_redo(self, copied, command):
        before = times(copied)
        about = json.loads((copied / "run.json").read_text())
        about["robust"]["estimators"]["RANSAC"] = "RANSAC of old"
        (copied / "run.json").write_text(json.dumps(about))
        assert main([*command, str(copied)]) == 2
        assert main([*command, str(copied), "--redo", "RANSAC"]) == 0
        changed = {path.name for path, time in times(copied).items() if time != before[path]}
        assert changed == {"RANSAC.npz"}
        assert main([*command, str(copied), "--redo", "poselib"]) == 2

    def test_other_options_are_refused(self, copied, command, capsys):
        for option in ("--seeds", "--pairs", "--seed", "--slow-seeds", "--hypotheses"):
            assert main([*command, str(copied), option, "3"]) == 2
            assert "is a run of other options" in capsys.readouterr().err
        assert main([*command, str(copied), "--seeds", "0"]) == 2
        assert "seeds must be 1 or more, got 0" in capsys.readouterr().err

    def test_estimators_and_stores_join(self, copied, store, tmp_path):
        write_store(tmp_path / "other.h5", synthetic_store(pairs=1, points=40, seed=2, scenes=["orbit"]))
        both = [str(store), str(tmp_path / "other.h5")]
        options = ["--seeds", "2", "--solvers", *SOLVERS, "--estimators", *ESTIMATORS, "count:reweighted"]
        assert main(["robust", *both, *options, "--out", str(copied)]) == 0
        found = read_robust(copied)
        assert [*found.about["stores"]] == ["kitti_06", "other"]
        assert [*found.cells[3].estimates] == [*ESTIMATORS, "count:reweighted"]

    def test_a_package_that_is_not_installed(self, copied, store, monkeypatch, capsys):
        def missing():
            raise ImportError("no module named poselib")

        monkeypatch.setitem(robust_peers.PEERS, "poselib", (missing, "poselib"))
        options = ["--seeds", "2", "--estimators", "poselib", "--solvers"]
        assert main(["robust", str(store), *options, "--out", str(copied)]) == 0
        assert read_robust(copied).about["estimators"]["poselib"] is None
        write_report(copied)
        text = (copied / "report.md").read_text()
        assert "Left out, since not installed: poselib." in text
        assert "| poselib" not in text

    def test_incomplete(self, copied, capsys):
        (copied / "robust/kitti_06/filtered/1px/RANSAC.npz").unlink()
        (copied / "hypotheses/kitti_06/unfiltered/Hartley.npz").unlink()
        assert main(["report", str(copied)]) == 0
        lacking = "RANSAC (kitti_06, filtered); hypotheses of Hartley (kitti_06, unfiltered)"
        assert f"not there yet, so left out: {lacking}" in capsys.readouterr().err
        assert lacking in (copied / "report.md").read_text()
        cells = read_robust(copied).cells
        assert "RANSAC" not in cells[0].estimates
        assert "RANSAC" in cells[1].estimates

    def test_damaged_or_of_another_version(self, copied, command, capsys):
        path = copied / "robust/kitti_06/filtered/1px/RANSAC.npz"
        whole = path.read_bytes()
        for content in (b"", b"bad", whole[:100]):
            path.write_bytes(content)
            for again in (["report", str(copied)], [*command, str(copied)]):
                assert main(again) == 2
                assert f"{path} is damaged, remove it" in capsys.readouterr().err
        (copied / "run.json").write_text('{"format": 3, "robust": {"stores": {}}}')
        for again in (["report", str(copied)], [*command, str(copied)]):
            assert main(again) == 2
            assert "run.json is damaged: estimators, solvers, versions, pairs" in capsys.readouterr().err

    def test_what_fails_is_left_out_and_others_go_on(self, store, short, tmp_path, monkeypatch, capsys):
        (tmp_path / "own.py").write_text(
            "from kornia_learnnorm import Hartley\n\nclass Bad:\n"
            "    def __call__(self, points1, points2, weights):\n        raise RuntimeError('boom')\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        out = tmp_path / "run"
        command = ["robust", str(store), "--pairs", "1", "--seeds", "1", "--out", str(out), "--estimators"]
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


class TestReport:
    def test_tables_and_figure(self, copied, capsys):
        pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
        assert main(["report", str(copied)]) == 0
        capsys.readouterr()
        text, page = (copied / "report.md").read_text(), (copied / "report.html").read_text()
        for title in ("kitti_06, filtered (Table 2)", "unfiltered (Table 3)", "## Pose and time", "## Best of k"):
            assert title in text
        assert "as printed: Ranftl and Koltun" in text
        assert page.count("<svg") == text.count(".svg)") == 2
        assert {path.stem for path in copied.glob("*.svg")} == {"hypotheses-1", "hypotheses-1-relative"}

    def test_beside_an_evaluation(self, copied, store, monkeypatch, capsys):
        pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
        monkeypatch.setattr(example, "TRIALS", 5)
        assert main(["evaluate", str(store), "--out", str(copied), "--methods", "none", "Hartley"]) == 0
        assert main(["report", str(copied)]) == 0
        capsys.readouterr()
        text = (copied / "report.md").read_text()
        assert "Better than Hartley, filtered (Table 1)" in text
        assert "unfiltered (Table 3)" in text

    def test_numbers(self, run):
        found = read_robust(run)
        tables = {table.title: table for table in robust_tables(found)}
        figures = found.cells[0].estimates["count:whitening"][1.0]
        rows = {row[0]: row for row in tables["Robust estimation: kitti_06, filtered (Table 2)"].rows}
        means = 100 * figures["inliers"].mean(0)
        assert rows["count:whitening"][4] == f"{means.mean():.2f} ± {means.std():.2f}"
        assert "±" not in rows["RANSAC"][1]  # a single run
        printed = PRINTED[(("kitti_06", "kitti_07", "kitti_08", "kitti_09", "kitti_10"), "filtered")]
        assert rows["Fan et al., as printed: LMEDS"][1:3] == list(printed["LMEDS"][:2])
        pose = {row[0]: row for row in tables["Pose and time: kitti_06, filtered"].rows}
        assert pose["count:whitening"][6] == "50"
        assert float(pose["RANSAC"][11]) > 0
        tests = {row[0]: row for row in tables["Paired tests of robust estimation: kitti_06, filtered"].rows}
        assert {name: row[1] for name, row in tests.items()} == {
            "count:whitening": "count:Hartley",
            "time:whitening": "time:Hartley",
            "RANSAC": "count:Hartley",
        }
        other = found.cells[0].estimates["count:Hartley"][1.0]
        change = 100 * (figures["inliers"] - other["inliers"]).mean().item()
        assert tests["count:whitening"][5].startswith(f"{change:+.3f} [")

    def test_without_ground_truth(self, run):
        found = read_robust(run)
        for by_threshold in found.cells[0].estimates.values():
            for figures in by_threshold.values():
                for key in ("f1", "error", "rotation_error", "translation_error"):
                    figures[key][:] = torch.nan
        table, pose, tests = robust_tables(found)[:3]
        assert table.rows[0][1:] == [""] * 7
        assert pose.rows[0][1] == "nan"
        assert tests.rows[0][2:] == [""] * 6

    def test_numbers_of_hypotheses(self, run):
        found = read_robust(run)
        best, chosen, tests = hypothesis_tables(found)[:3]
        error = found.cells[0].hypotheses["whitening"]["error"]
        assert best.rows[1][1] == chosen.rows[1][1] == f"{error.mean():.3f}"
        assert best.rows[1][4] == f"{error.min(-1).values.mean():.3f}"
        assert [row[:2] for row in tests.rows[:2]] == [
            ["whitening", "Best of k hypotheses"],
            ["whitening", "Hypothesis that MSAC picks among k"],
        ]
        change = (error - found.cells[0].hypotheses["Hartley"]["error"]).mean().item()
        assert re.match(re.escape(f"{change:+.3f} ["), tests.rows[0][2])

"""Tables of runs: better rates, accuracy, motion, robust estimators, hypotheses."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import torch

from kornia_learnnorm.evaluation.report.formatting import known_parts, mean_text, median_text, number_text, paired_text
from kornia_learnnorm.evaluation.report.hypotheses import hypothesis_figures, hypothesis_tables
from kornia_learnnorm.evaluation.report.rates import papers_data, rate_tables
from kornia_learnnorm.evaluation.report.robust import PRINTED, robust_tables
from kornia_learnnorm.evaluation.report.style import method_colors
from kornia_learnnorm.evaluation.report.tables import by_motion, report_tables
from kornia_learnnorm.evaluation.robust.run import read_robust
from kornia_learnnorm.evaluation.runs.run import Cell, Run, read_run
from kornia_learnnorm.evaluation.tables import Table


def test_rates_are_those_of_the_samples(run):
    found = read_run(run)
    cell = found.cells[0]
    own = {name: prediction["own"].numpy() for name, prediction in cell.predictions.items()}
    table = report_tables(found)[0]
    for row in table.rows:
        if row[0] in own:
            assert row[1].startswith(f"{100 * np.mean(own[row[0]] < own['Hartley']):.1f} [")
    assert [row[0] for row in table.rows] == [name for name in own if name != "Hartley"]
    assert table.header[1] == f"scenes: {len(cell.pair)} of {cell.drawn}"
    assert {row[0]: row[-1] for row in table.rows}["crossview"] == "kitti_00, kitti_01, kitti_03"
    raw = np.load(run / "scenes" / "filtered" / "samples.npz")["plain_residual"]
    assert len(cell.pair) == (raw < 60).sum()


def test_accuracy_and_tests(run):
    tables = {table.title: table for table in report_tables(read_run(run))}
    rows = {row[0]: row for row in tables["Fit and accuracy: scenes, filtered"].rows}
    assert float(rows["Hartley+LM"][1]) < float(rows["Hartley"][1]) < float(rows["none"][1])
    tests = {row[0]: row for row in tables["Paired tests: scenes, filtered"].rows}
    assert tests["none"][1].startswith("+")
    assert tests["Hartley+LM"][1].startswith("-")
    assert len(tables["By motion: scenes, filtered"].rows) == 8
    assert 0 < len(tables["Worst failures: scenes, filtered"].rows) <= 10


def test_texts_of_cells():
    assert [number_text(0.5), number_text(float("nan"))] == ["0.500", ""]
    assert median_text(torch.tensor([1.0, 4.0, torch.nan])) == "2.500"
    values = torch.tensor([1.5, 2.5])
    assert paired_text(values, values - 0.5) == "+0.500"  # too few pairs for an interval
    assert paired_text(values, values * torch.nan) == ""
    values = torch.arange(8) + 1.5
    assert paired_text(values, values - 0.5) == "+0.500 [+0.500, +0.500], < 0.001"
    assert paired_text(values[1:], values[1:] - 0.5) == "+0.500"
    pair = torch.arange(8).repeat_interleave(2)
    assert mean_text(torch.zeros(16), pair) == "0.0 [0.0, 0.0]"
    assert mean_text(torch.zeros(16).masked_fill(pair == 3, torch.nan), pair) == "0.0"  # seven pairs
    assert mean_text(torch.full((16,), torch.nan), pair) == ""
    assert method_colors(["none", "Hartley"]) == {"none": "#8b8b8b", "Hartley": "#e69f00"}


def without_truth(run, robust):
    truth = ("truth", "heldout", "f1", "error", "rotation_error", "translation_error")
    robust_results = [r for cell in robust.cells for e in cell.estimates.values() for r in e.values()]
    hypotheses = [h for cell in robust.cells for h in cell.hypotheses.values()]
    for results in (*(p for cell in run.cells for p in cell.predictions.values()), *robust_results, *hypotheses):
        for key in results.keys() & truth:
            results[key][:] = torch.nan
    for values in run.pairs["scenes"].values():
        if values.dtype.kind == "f":
            values[:] = np.nan
    return run, robust


def of_one_pair(run, robust):
    cells = []
    for cell in run.cells:
        kept = cell.pair == cell.pair[0]
        predictions = {name: {key: v[kept] for key, v in p.items()} for name, p in cell.predictions.items()}
        cells.append(dataclasses.replace(cell, pair=cell.pair[kept], predictions=predictions))
    for cell in robust.cells:
        for results in (*(r for e in cell.estimates.values() for r in e.values()), *cell.hypotheses.values()):
            results.update({key: values[:1] for key, values in results.items()})
    return dataclasses.replace(run, cells=cells), robust


@pytest.mark.parametrize("change", [without_truth, of_one_pair])
def test_unknown_numbers_are_empty_cells(run, robust_run, change):
    found, robust = change(read_run(run), read_robust(robust_run))
    tables = [*report_tables(found), *robust_tables(robust), *hypothesis_tables(robust)]
    cells = [cell for table in tables for row in table.rows for cell in row]
    assert len(tables) >= 14
    assert "" in cells
    assert not [cell for cell in cells if re.search("nan|inf", cell)]


@pytest.mark.parametrize(
    ("description", "name"),
    [
        ("KITTI odometry 06", "KITTI"),
        ("KITTI odometry 06, 10", "KITTI"),
        ("KITTI odometry 00, 06", ""),
        ("KITTI odometry 06, 00", ""),
        ("TUM RGB-D freiburg3_long_office_household, frames about 1 s apart, resized to 1226x370", "TUM"),
        ("TUM RGB-D rgbd_dataset_freiburg3_long_office_household, resized to 1226x370", "TUM"),
        ("TUM RGB-D freiburg3_long_office_household, frames about 1 s apart", ""),
        ("TUM RGB-D freiburg1_desk, resized to 1226x370", ""),
        ("images of kitti_06", ""),
    ],
)
def test_the_papers_data(description, name):
    assert papers_data(f"{description}, 51 pairs, 1000 matches") == name


def test_without_ground_truth_there_are_inliers_and_heldout_errors(run, robust_run):
    found = read_run(run)
    shares = found.cells[0].predictions["whitening"]["inliers"].clone()
    heldout = {name: p["heldout"].clone() for name, p in found.cells[0].predictions.items()}
    found, _ = without_truth(found, read_robust(robust_run))
    for name, values in heldout.items():
        found.cells[0].predictions[name]["heldout"][:] = values
    tables = {t.title: t for table in report_tables(found) if (t := known_parts(table))}
    for title, table in tables.items():
        assert all(any(row[i] for row in table.rows) for i in range(len(table.header))), title
        assert not [name for name in table.header if "truth" in name or "F1" in name], title
    rows = {row[0]: row for row in tables["Inliers: scenes, filtered"].rows}
    assert rows["whitening"][2].startswith(f"{100 * shares[:, 1].mean():.1f} [")
    assert tables["Fit and accuracy: scenes, filtered"].header[:4] == [
        "method",
        "fit px",
        "held out px",
        "condition number",
    ]
    assert not any("By motion" in title or "Worst" in title for title in tables)


def motion_cell(forward, truth):
    """Six pairs of two samples each; the figures other than ``forward`` are not known."""
    error = torch.tensor(truth, dtype=torch.float64).repeat_interleave(2)
    errors = {"own": torch.arange(12) + 1.0, "heldout": torch.arange(12) + 1.0, "truth": error}
    cell = Cell("a", "filtered", torch.arange(6).repeat_interleave(2), 12, {"Hartley": errors, "mine": errors})
    unknown = np.full(6, np.nan)
    pairs = {"rotation": unknown, "forward": np.array(forward), "parallax": unknown, "inliers": unknown}
    return cell, Run({}, [cell], {"a": pairs}, {}, {})


class TestByMotion:
    def test_counts_and_digits(self):
        """A median of 0.999555 that three digits round to 1, among samples of which some have no truth."""
        nan = float("nan")
        table = by_motion(*motion_cell([0.2, 0.4, 0.9995, 0.99961, 0.99962, 0.9997], [1, nan, 1, 1, nan, nan]), "mine")
        assert [row[1:5] for row in table.rows] == [["up to 0.9996", "3", "6", "4"], ["above 0.9996", "3", "6", "2"]]
        assert "Not shown: rotation, degrees, known of 0 of 6 pairs, at least 4 are needed; parallax" in table.text

    @pytest.mark.parametrize(
        ("forward", "text"),
        [
            ([0.9995, 0.9996, 0.9997, *3 * [0.9998]], "from 0.9995 to 0.9998 in all pairs"),
            (6 * [0.5], "0.5 in all pairs"),
        ],
    )
    def test_what_hardly_differs_has_no_halves(self, forward, text):
        table = by_motion(*motion_cell(forward, 6 * [1]), "mine")
        assert table.rows == []
        assert f"forward share of the translation, {text}" in table.text


def test_the_rate_of_known_distributions():
    """Of exponential variables with means 1 and 1 / 2 the second is smaller with probability 2 / 3."""
    rng = np.random.default_rng(0)
    own = {"Hartley": rng.exponential(1.0, 20_000), "crossview": rng.exponential(0.5, 20_000)}
    predictions = {name: {"own": torch.from_numpy(values)} for name, values in own.items()}
    cell = Cell("kitti_06", "filtered", torch.arange(20_000) // 100, 20_000, predictions)
    trained_on = {"Hartley": [], "crossview": ["kitti_06@0:3"]}
    about = {"size": 8, "max_residual": 60.0, "methods": dict.fromkeys(own, ""), "trained_on": trained_on}
    about["stores"] = {"kitti_06": "KITTI odometry 06, 200 pairs, 20000 matches"}
    (table,) = rate_tables(Run(about, [cell], {}, {}, {}))
    rate, interval = table.rows[0][1].split(" ", 1)
    low, high = (float(end) for end in interval.strip("[] *").split(", "))
    assert table.rows[0][::2] == ["crossview", "kitti_06@0:3"]
    assert interval.endswith(" *")
    assert low < 200 / 3 < high
    # The half width of independent samples: 1.96 standard deviations of a proportion.
    assert (high - low) / 2 == pytest.approx(196 * np.sqrt(2 / 9 / 20_000), rel=0.2)
    assert float(rate) == pytest.approx(200 / 3, abs=1)
    printed = {"KITTI 00-05": "86.68", "TUM": "84.22", "KITTI 00-05 and TUM": "87.05"}
    assert {row[2]: row[1] for row in table.rows[1:]} == printed


def test_rows_and_columns_without_a_number_are_left_out():
    rows = [["a", "-", "1.5", ""], ["b", "-", "", ""], ["c", "-", "-", "-"]]
    known = known_parts(Table("", "", ["method", "own", "truth", "angle"], rows))
    assert (known.header, known.rows) == (["method", "truth"], [["a", "1.5"]])
    assert known_parts(Table("", "", ["method", "own"], [["a", "-"], ["b", ""]])) is None


def test_rates_have_no_row_of_the_baseline_or_of_a_method_without_predictions(run):
    found = read_run(run)
    for cell in found.cells:
        cell.predictions.pop("crossview")
    found.about["trained_on"]["crossview"] = ["scenes"]
    others = {"none", "Hartley", "whitening", "Hartley+optimal", "Hartley+LM"}
    names = [{row[0] for row in table.rows} for table in rate_tables(found)]
    assert names == 2 * [others - {"Hartley"}] + 2 * [others - {"whitening"}]


def test_numbers_of_robust_estimators(robust_run):
    found = read_robust(robust_run)
    tables = {table.title: table for table in robust_tables(found)}
    figures = found.cells[0].estimates["count:whitening"][1.0]
    rows = {row[0]: row for row in tables["Robust estimation: kitti_06, filtered (Table 2)"].rows}
    means = 100 * figures["inliers"].mean(0)
    assert rows["count:whitening"][4] == f"{means.mean():.2f} ± {means.std():.2f}"
    assert "±" not in rows["RANSAC"][1]  # a single run
    printed = PRINTED["KITTI", "filtered"]
    assert rows["Fan et al., as printed: LMEDS"][1:3] == list(printed["LMEDS"][:2])
    pose = {row[0]: row for row in tables["Pose and time: kitti_06, filtered"].rows}
    assert pose["count:whitening"][6] == "50"
    assert float(pose["RANSAC"][11]) > 0
    tests = {row[0]: row for row in tables["Paired tests of robust estimation: kitti_06, filtered"].rows}
    baselines = {"count:whitening": "count:Hartley", "time:whitening": "time:Hartley", "RANSAC": "count:Hartley"}
    assert {name: row[1] for name, row in tests.items()} == baselines
    other = found.cells[0].estimates["count:Hartley"][1.0]
    change = 100 * (figures["inliers"] - other["inliers"]).mean().item()
    assert tests["count:whitening"][5] == f"{change:+.3f}"  # too few pairs for an interval


def test_robust_estimators_without_ground_truth(robust_run):
    found = read_robust(robust_run)
    for by_threshold in found.cells[0].estimates.values():
        for figures in by_threshold.values():
            for key in ("f1", "error", "rotation_error", "translation_error"):
                figures[key][:] = torch.nan
    found.about["stores"]["kitti_06"] = "images of a folder, 3 pairs, 990 matches"
    table, time, tests = map(known_parts, robust_tables(found)[:3])
    assert table.header == ["estimator", "inliers % @0.1 px", "inliers % @1 px"]
    assert time.header == ["estimator", "ms @0.1 px", "samples @0.1 px", "ms @1 px", "samples @1 px"]
    assert tests.header[2:] == ["inliers @0.1 px: change, p", "inliers @1 px: change, p"]
    assert time.title == "Time: kitti_06, filtered"
    assert "ground-truth" not in [row[0] for row in (*table.rows, *time.rows)]
    shares = found.cells[0].estimates["count:whitening"][1.0]["inliers"]
    assert next(row for row in table.rows if row[0] == "count:whitening")[2].startswith(f"{100 * shares.mean():.2f} ±")


def test_numbers_of_hypotheses(robust_run):
    found = read_robust(robust_run)
    best, chosen, tests = hypothesis_tables(found)[:3]
    error = found.cells[0].hypotheses["whitening"]["error"]
    assert best.rows[1][1] == chosen.rows[1][1] == f"{error.mean():.3f}"
    assert best.rows[1][4] == f"{error.min(-1).values.mean():.3f}"
    names = ["Best of k hypotheses", "Hypothesis that MSAC picks among k"]
    assert [row[:2] for row in tests.rows[:2]] == [["whitening", name] for name in names]
    change = (error - found.cells[0].hypotheses["Hartley"]["error"]).mean().item()
    assert tests.rows[0][2] == f"{change:+.3f}"  # too few pairs for an interval


def test_no_figures_and_tables_of_hypotheses_without_ground_truth(robust_run):
    found = read_robust(robust_run)
    for hypotheses in [h for cell in found.cells for h in cell.hypotheses.values()]:
        hypotheses["error"][:] = torch.nan
    assert hypothesis_figures(found) == []
    assert [table for table in hypothesis_tables(found) if "kitti_06" in table.title] == []

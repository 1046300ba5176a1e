"""Tables of runs: better rates, accuracy, motion, robust estimators."""

import json
import re

import numpy as np
import torch

from kornia_learnnorm.evaluation.report.method_tables import papers_data, rate_tables, report_tables
from kornia_learnnorm.evaluation.report.robust_tables import robust_tables
from kornia_learnnorm.evaluation.robust.robust_run import read_robust
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell, read_run
from kornia_learnnorm.evaluation.tables import Number, Table, tables_as_json


def as_text(rows):
    """The cells of a table as it is printed."""
    return [[*map(str, row)] for row in rows]


def test_paired_tests(run):
    tables = {table.title: table for table in report_tables(read_run(run))}
    tests = {row[0]: row for row in as_text(tables["Paired tests: scenes, filtered"].rows)}
    assert tests["none"][1].startswith("+")
    assert tests["Hartley+LM"][1].startswith("-")


def without_truth(run, robust):
    truth = ("truth", "heldout", "f1", "error", "rotation_error", "translation_error")
    robust_results = [r for cell in robust.cells for e in cell.estimates.values() for r in e.values()]
    for results in (*(p for cell in run.cells for p in cell.predictions.values()), *robust_results):
        for key in results.keys() & truth:
            results[key][:] = torch.nan
    return run, robust


def test_the_papers_data():
    for description, name in [
        ("KITTI odometry 06, 10", "KITTI"),
        ("KITTI odometry 00, 06", ""),
        ("TUM RGB-D freiburg3_long_office_household, frames about 1 s apart, resized to 1226x370", "TUM"),
        ("TUM RGB-D freiburg3_long_office_household, frames about 1 s apart", ""),
        ("TUM RGB-D freiburg1_desk, resized to 1226x370", ""),
        ("images of kitti_06", ""),
    ]:
        assert papers_data(f"{description}, 51 pairs, 1000 matches") == name


def test_without_ground_truth_there_are_inliers_and_heldout_errors(run, robust_run):
    found, robust = read_run(run), read_robust(robust_run)
    shares = found.cells[0].predictions["whitening"]["inliers"].clone()
    heldout = {name: p["heldout"].clone() for name, p in found.cells[0].predictions.items()}
    found, robust = without_truth(found, robust)
    cells = [
        cell for table in (*report_tables(found), *robust_tables(robust)) for row in as_text(table.rows) for cell in row
    ]
    assert "" in cells
    assert not [cell for cell in cells if re.search("nan|inf", cell)]
    for name, values in heldout.items():
        found.cells[0].predictions[name]["heldout"][:] = values
    tables = {t.title: t for table in report_tables(found) if (t := table.known_parts())}
    for title, table in tables.items():
        assert all(any(row[i] for row in table.rows) for i in range(len(table.header))), title
        assert not [name for name in table.header if "truth" in name or "F1" in name], title
    rows = {row[0]: row for row in as_text(tables["Inliers: scenes, filtered"].rows)}
    assert rows["whitening"][2].startswith(f"{100 * shares[:, 1].mean():.1f} [")
    header = tables["Fit and accuracy: scenes, filtered"].header[:4]
    assert header == ["method", "fit px", "held out px", "condition number"]
    robust.about["stores"]["kitti_06"] = "images of a folder, 3 pairs, 990 matches"
    table, time, tests = (table.known_parts() for table in robust_tables(robust)[:3])
    assert table.header == ["estimator", "inliers % @0.1 px", "inliers % @1 px"]
    assert time.header == ["estimator", "ms @0.1 px", "samples @0.1 px", "ms @1 px", "samples @1 px"]
    assert tests.header[2:] == ["inliers @0.1 px: change, p", "inliers @1 px: change, p"]
    assert "ground-truth" not in [row[0] for row in (*table.rows, *time.rows)]


def test_rates_on_the_papers_data_and_on_pairs_of_the_training():
    predictions = {"Hartley": {"own": torch.ones(80)}, "crossview": {"own": torch.tensor([0.5, 0.9, 1.5, 2.0] * 20)}}
    cell = RunCell("kitti_06", "filtered", torch.arange(80) // 4, 80, predictions)
    trained_on = {"Hartley": [], "crossview": ["kitti_06@0:3"]}
    about = {"size": 8, "max_residual": 60.0, "methods": dict.fromkeys(predictions, ""), "trained_on": trained_on}
    about["stores"] = {"kitti_06": "KITTI odometry 06, 20 pairs, 20000 matches"}
    (table,) = rate_tables(Run(about, [cell]))
    own, *printed = as_text(table.rows)
    assert own == ["crossview", "50.0 [50.0, 50.0] *", "kitti_06@0:3"]
    expected = {"KITTI 00-05": "86.68", "TUM": "84.22", "KITTI 00-05 and TUM": "87.05"}
    assert {row[2]: row[1] for row in printed} == expected


def test_numbers_of_robust_estimators(robust_run):
    found = read_robust(robust_run)
    tables = {table.title: table for table in robust_tables(found)}
    figures = found.cells[0].estimates["opencv-usac"][1.0]
    rows = {row[0]: row for row in as_text(tables["Robust estimation: kitti_06, filtered (Table 2)"].rows)}
    means = 100 * figures["inliers"].mean(0)
    assert rows["opencv-usac"][4] == f"{means.mean():.2f} ± {means.std():.2f}"
    assert "±" not in rows["RANSAC"][1]  # a single run
    assert rows["Fan et al., as printed: LMEDS"][1:3] == ["20.01", "13.34"]
    pose = {row[0]: row for row in as_text(tables["Pose and time: kitti_06, filtered"].rows)}
    assert pose["opencv-usac"][6] == ""
    assert float(pose["RANSAC"][11]) > 0
    ((name, against, *changes),) = as_text(tables["Paired tests of robust estimation: kitti_06, filtered"].rows)
    assert (name, against) == ("RANSAC:whitening", "RANSAC")
    mine, other = (found.cells[0].estimates[one][1.0]["inliers"] for one in (name, against))
    assert changes[3] == f"{100 * (mine - other).mean().item():+.3f}"  # too few pairs for an interval


def test_cells_as_json():
    numbers = [Number(1.499, "+.2f"), Number(2.5e6, ".3g"), Number(-3, ".1f", (-4, -2), 0.0004)]
    numbers += [Number(7, ".2f", std=0.1), Number(99.9, ".1f", (99.0, 100.0), trained_on=True)]
    cells = ["12", "", "-", 12, *numbers, "kitti_00, kitti_01", Number(np.inf)]
    header = ["name", *map(str, range(len(cells) - 1))]
    (row,) = json.loads(tables_as_json("", [Table("", "", header, [cells])]))["tables"][0]["rows"]
    expected = [None, None, 12, 1.5, 2.5e6, {"value": -3.0, "low": -4.0, "high": -2.0, "p": 0.001}]
    expected += [{"value": 7.0, "std": 0.1}, {"value": 99.9, "low": 99.0, "high": 100.0, "trained_on": True}]
    assert [*row.values()] == ["12", *expected, "kitti_00, kitti_01", "inf"]
    shown = ["+1.50", "2.5e+06", "-3.0 [-4.0, -2.0], < 0.001", "7.00 ± 0.10", "99.9 [99.0, 100.0] *"]
    assert [*map(str, numbers)] == shown

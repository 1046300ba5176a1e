"""Tables and summaries of runs: better rates, accuracy, motion, robust estimators."""

import json
import math
import re

import numpy as np
import pytest
import torch
from pairwise import pairwise

from kornia_learnnorm.evaluation.report.method_tables import papers_data, rate_tables, report_tables
from kornia_learnnorm.evaluation.report.robust_tables import robust_tables
from kornia_learnnorm.evaluation.report.run_summary import robust_summary, run_summary
from kornia_learnnorm.evaluation.robust.robust_run import RobustCell, RobustRun, read_robust
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell, read_run
from kornia_learnnorm.evaluation.tables import Number, Table, tables_as_json


def as_text(rows):
    return [[*map(str, row)] for row in rows]


def test_paired_tests(run):
    tables = {table.title: table for table in report_tables(read_run(run))}
    tests = {row[0]: row for row in as_text(tables["Paired tests: scenes, filtered"].rows)}
    assert tests["none"][1].startswith("+")
    assert tests["Hartley+LM"][1].startswith("-")


def test_the_papers_data():
    for description, name in [
        ("KITTI odometry 06, 10", "KITTI"),
        ("KITTI odometry 00, 06", ""),
        ("TUM RGB-D freiburg3_long_office_household, frames about 1 s apart, resized to 1226x370", "TUM"),
        ("TUM RGB-D freiburg3_long_office_household, frames about 1 s apart", ""),
        ("TUM RGB-D freiburg1_desk, resized to 1226x370", ""),
    ]:
        assert papers_data(f"{description}, 51 pairs, 1000 matches") == name


def test_without_ground_truth_there_are_inliers_and_heldout_errors(run, robust_run):
    found, robust = read_run(run), read_robust(robust_run)
    shares = found.cells[0].predictions["whitening"]["inliers"].clone()
    heldout = {name: p["heldout"].clone() for name, p in found.cells[0].predictions.items()}
    truth = ("truth", "heldout", "f1", "error", "rotation_error", "translation_error")
    robust_results = [r for cell in robust.cells for e in cell.estimates.values() for r in e.values()]
    for results in (*(p for cell in found.cells for p in cell.predictions.values()), *robust_results):
        for key in results.keys() & truth:
            results[key][:] = torch.nan
    every = (*report_tables(found), *robust_tables(robust))
    cells = [cell for table in every for row in as_text(table.rows) for cell in row]
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
    robust.about["stores"]["kitti_06"] = "images of a folder, 3 pairs, 990 matches"
    table, time = (table.known_parts() for table in robust_tables(robust)[:2])
    assert table.header == ["estimator", "inliers % @0.1 px", "inliers % @1 px"]
    assert "ground-truth" not in [row[0] for row in (*table.rows, *time.rows)]


def test_rates_on_the_papers_data_and_on_pairs_of_the_training():
    predictions = {"Hartley": {"own": torch.ones(80)}, "crossview": {"own": torch.tensor([0.5, 0.9, 1.5, 2.0] * 20)}}
    cell = RunCell("kitti_06", "filtered", torch.arange(80) // 4, 80, predictions)
    trained_on = {"Hartley": [], "crossview": ["kitti_06@0:3"]}
    about = {"size": 8, "max_residual": 60.0, "methods": dict.fromkeys(predictions, ""), "trained_on": trained_on}
    about["stores"] = {"kitti_06": "KITTI odometry 06, 20 pairs, 20000 matches"}
    (table,) = rate_tables(Run(about, [cell], []))
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


PAIRS, SAMPLES = 12, 60
PAIR = torch.arange(SAMPLES) // (SAMPLES // PAIRS)
NOISE = torch.where(torch.arange(SAMPLES) % 2 == 0, 1.1, 1 / 1.1)
FEW = torch.where(torch.arange(SAMPLES) % 5 < 2, 1e-4, 3.0)  # nearly exact, so that the geometric mean is small


def errors(scale):
    """Errors that grow with the pair, times a scale of each sample: 1 to 12 px under Hartley, five samples each."""
    known, inliers = (1.0 + PAIR.double()) * scale, torch.tensor([0.1, 0.25]).expand(SAMPLES, 2)
    return {"own": known, "heldout": known * math.nan, "truth": known, "inliers": inliers}


def summary_of(scales, pair=PAIR):
    """The summary of a run of Hartley, with errors of scale 1, and other methods."""
    predictions = {name: errors(scale) for name, scale in ({"Hartley": 1.0} | scales).items()}
    (text,) = run_summary(Run({}, [RunCell("a", "filtered", pair, SAMPLES, predictions)], []))
    return text


def test_the_smallest_error_wins_and_what_is_level_is_named():
    for scales, facts in [
        (
            {"best": 0.5, "close": 0.503 * NOISE, "bad": 3.0},
            ["`best` has", "median 3.250 px; Hartley has 6.500 px", "-50.0 % [-50.0, -50.0]", "Level with it: `close`"],
        ),
        ({"bad": 3.0, "mine": 1.5}, ["`Hartley` has", "`mine` with 9.750 px", "+50.0 % [+50.0, +50.0]"]),
        # The median decides, and a smaller geometric mean is named.
        ({"Hartley": 4.0, "exact": FEW, "steady": 1.0}, ["`steady` has", "median 6.500 px", "smaller for `exact`"]),
    ]:
        text = summary_of(scales)
        assert "**a, filtered** (60 samples of 12 image pairs)" in text
        assert [fact for fact in facts if fact not in text] == []


@pairwise(pairs=[1, 7, 8], scale=[0.5, 2.0])
def test_few_pairs_are_not_tested(pairs, scale):
    text = summary_of({"mine": scale}, torch.arange(SAMPLES) % pairs)
    assert ("change of the geometric mean" in text) == (pairs == 8)


@pytest.mark.parametrize(
    ("truth", "facts"),
    [
        (True, ["`exact` has the smallest error", "mean 0.200 px in 10.0 ms", "next is `greedy` with 0.400 px"]),
        (False, ["`greedy` has the largest share of inliers", "90.0 % in 20.0 ms", "next is `exact` with 50.0 %"]),
    ],
)
def test_robust_estimators(truth, facts):
    found, some = {}, torch.ones(8, 2)
    cases = ("exact", 0.2, 0.5, 0.01), ("greedy", 0.4, 0.9, 0.02), ("ground-truth", 0, 1, 0)
    for name, error, inliers, seconds in cases:
        known = some if truth else some * math.nan
        found[name] = {1.0: {"f1": known, "error": known * error, "inliers": some * inliers, "seconds": some * seconds}}
    (line,) = robust_summary(RobustRun({}, [RobustCell("a", "filtered", found), RobustCell("b", "filtered", {})], []))
    assert [fact for fact in facts if fact not in line] == []
    assert "ground-truth" not in line.replace("ground-truth inliers", "")

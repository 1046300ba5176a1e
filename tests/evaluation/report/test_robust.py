"""Tables of robust estimators."""

from __future__ import annotations

import torch

from kornia_learnnorm.evaluation.report.robust import PRINTED, robust_tables
from kornia_learnnorm.evaluation.robust.run import read_robust


def test_numbers(robust_run):
    found = read_robust(robust_run)
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


def test_without_ground_truth(robust_run):
    found = read_robust(robust_run)
    for by_threshold in found.cells[0].estimates.values():
        for figures in by_threshold.values():
            for key in ("f1", "error", "rotation_error", "translation_error"):
                figures[key][:] = torch.nan
    table, pose, tests = robust_tables(found)[:3]
    assert table.rows[0][1:] == [""] * 7
    assert pose.rows[0][1:5] == [""] * 4
    assert tests.rows[0][2:] == [""] * 6

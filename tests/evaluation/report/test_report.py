"""Runs of predictions and the reports made of them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.cli.report import write_report
from kornia_learnnorm.evaluation.report.pair import draw_example
from kornia_learnnorm.evaluation.report.tables import report_tables
from kornia_learnnorm.evaluation.runs.run import read_run

pytest.importorskip("matplotlib", reason="Matplotlib is not installed")


class TestReport:
    def test_files(self, copied, capsys):
        assert main(["report", str(copied)]) == 0
        assert "Better than Hartley" in capsys.readouterr().out
        text, page = (copied / "report.md").read_text(), (copied / "report.html").read_text()
        for name in re.findall(r"\]\(([\w-]+\.svg)\)", text):
            ElementTree.parse(copied / name)
        assert page.count("<svg") == text.count(".svg)") == 7
        assert not re.findall(r'(?:src|href)="(?!#)', page)  # nothing from elsewhere
        identifiers = re.findall(r'\bid="([^"]+)"', page)
        assert len(identifiers) == len(set(identifiers))
        for reference in re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page):
            assert "".join(reference) in identifiers

    def test_rates_are_those_of_the_samples(self, run):
        found = read_run(run)
        cell = found.cells[0]
        own = {name: prediction["own"].numpy() for name, prediction in cell.predictions.items()}
        table = report_tables(found)[0]
        for row in table.rows:
            if row[0] in own and row[0] != "Hartley":
                assert row[2].startswith(f"{100 * np.mean(own[row[0]] < own['Hartley']):.1f} [")
        assert table.header[2] == f"scenes: {len(cell.pair)} of {cell.drawn}"
        assert {row[0]: row[1] for row in table.rows}["crossview"] == "kitti_00, kitti_01, kitti_03"
        raw = np.load(run / "scenes" / "filtered" / "samples.npz")["plain_residual"]
        assert len(cell.pair) == (raw < 60).sum()

    def test_accuracy_and_tests(self, run):
        tables = {table.title: table for table in report_tables(read_run(run))}
        rows = {row[0]: row for row in tables["Fit and accuracy: scenes, filtered"].rows}
        assert float(rows["Hartley+LM"][1]) < float(rows["Hartley"][1]) < float(rows["none"][1])
        tests = {row[0]: row for row in tables["Paired tests: scenes, filtered"].rows}
        assert tests["none"][1].startswith("+")
        assert tests["Hartley+LM"][1].startswith("-")
        assert len(tables["By motion: scenes, filtered"].rows) == 8
        assert 0 < len(tables["Worst failures: scenes, filtered"].rows) <= 10

    def test_without_the_baseline(self, copied, capsys):
        for protocol in ("filtered", "unfiltered"):
            (copied / "scenes" / protocol / "Hartley.npz").unlink()
        assert main(["report", str(copied)]) == 2
        assert "compares with Hartley, the run has predictions of Hartley+LM, " in capsys.readouterr().err

    def test_not_a_run(self, tmp_path, capsys):
        assert main(["report", str(tmp_path)]) == 2
        assert "no run at" in capsys.readouterr().err

    def test_what_is_there_of_a_run(self, copied, capsys):
        """Of a run that was stopped, with what was left out."""
        for path in ("scenes/filtered/crossview", "scenes/unfiltered/samples", "sizes/none"):
            (copied / f"{path}.npz").unlink()
        assert main(["report", str(copied)]) == 0
        left = "crossview on scenes, filtered; all methods on scenes, unfiltered; none by the number of correspondences"
        assert f"not there yet, so left out: {left}" in capsys.readouterr().err
        assert f"Not there yet, so left out: {left}." in (copied / "report.md").read_text()
        (copied / "example.npz").unlink()
        assert write_report(copied).missing[-1] == "the example of a pair"
        assert "Figure 11" not in (copied / "report.md").read_text()


def test_without_a_sample_of_the_pair_there_is_no_figure_of_it(copied, methods):
    found = read_run(copied)
    assert [picture.name for picture in draw_example(found, dict.fromkeys(methods, "red"))] == ["figure-10"]
    found.example["pair"] = np.array(99)
    assert draw_example(found, {}) == []

"""Reports as Markdown and HTML."""

import contextlib
import io
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.evaluation.report.pages import print_tables, write_report
from kornia_learnnorm.evaluation.robust.robust_run import read_robust
from kornia_learnnorm.evaluation.tables import Table

matplotlib = pytest.importorskip("matplotlib", reason="Matplotlib is not installed")


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """The folder of a report, not to be changed, with what a wide terminal shows in printed.txt."""
    folder = shutil.copytree(run, tmp_path_factory.mktemp("reports") / "run")
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setenv("COLUMNS", "300")
        assert main(["report", str(folder), "--json", str(folder / "tables.json")]) == 0
    (folder / "printed.txt").write_text(printed.getvalue())
    return folder


def test_files(written):
    text, page, printed = ((written / name).read_text() for name in ("report.md", "report.html", "printed.txt"))
    assert printed.startswith("scenes, filtered (")
    assert "Better than Hartley" in printed
    for name in re.findall(r"\]\(([\w-]+\.svg)\)", text):
        ElementTree.parse(written / name)
    assert page.count("<svg") == text.count(".svg)") == 5
    assert not re.findall(r'(?:src|href)="(?!#)', page)  # nothing from elsewhere
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))
    for reference in re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page):
        assert "".join(reference) in identifiers


def test_not_a_run_or_without_the_baseline(tmp_path, copied, refused):
    refused(["report", tmp_path], "no run at")
    refused(["report", tmp_path, "--json", tmp_path / "report.md"], "report.md: expected a new file or -")
    for protocol in ("filtered", "unfiltered"):
        (copied / "scenes" / protocol / "Hartley.npz").unlink()
    refused(["report", copied], "compares with Hartley, the run has predictions of Hartley+LM, ")


def test_what_is_there_of_a_run(copied, capsys):
    for path in ("scenes/filtered/crossview", "scenes/unfiltered/samples"):
        (copied / f"{path}.npz").unlink()
    assert main(["report", str(copied)]) == 0
    left = "crossview on scenes, filtered; all methods on scenes, unfiltered"
    assert f"not there yet, so left out: {left}" in capsys.readouterr().err
    assert f"Not there yet, so left out: {left}." in (copied / "report.md").read_text()


def test_robust_estimators_alone_and_beside_predictions(robust_copied, robust_store):
    settings = dict(matplotlib.rcParams)
    write_report(robust_copied)
    assert dict(matplotlib.rcParams) == settings
    text, page = (robust_copied / "report.md").read_text(), (robust_copied / "report.html").read_text()
    for title in ("kitti_06, filtered (Table 2)", "unfiltered (Table 3)", "## Pose and time"):
        assert title in text
    assert "as printed: Ranftl and Koltun" in text
    assert page.count("<svg") == text.count(".svg)") == 0
    options = ["--methods", "Hartley", "--max-samples", "50"]
    assert main(["evaluate", str(robust_store), "--out", str(robust_copied), *options]) == 0
    write_report(robust_copied)
    text = (robust_copied / "report.md").read_text()
    assert "Better than Hartley, filtered (Table 1)" in text
    assert "unfiltered (Table 3)" in text
    assert "unfiltered (Table 1)" not in text
    assert "Numbers of tables and figures are those of Fan et al." in text
    assert re.findall(r"^## .+ \(Figure (.+)\)$", text, flags=re.MULTILINE) == ["4a", "4b", "5", "8"]


def test_numbers_of_the_paper_are_only_beside_its_data(written):
    for name in ("printed.txt", "tables.json", "report.md", "report.html"):
        assert not re.findall(r"Fan et al|Figure \d|Table \d", (written / name).read_text())


def test_incomplete_robust_run(robust_copied):
    (robust_copied / "robust/kitti_06/filtered/1px/RANSAC.npz").unlink()
    about = json.loads((robust_copied / "run.json").read_text())
    about["robust"]["estimators"]["poselib"] = None
    (robust_copied / "run.json").write_text(json.dumps(about))
    assert write_report(robust_copied)[-1] == ["RANSAC (kitti_06, filtered)"]
    text = (robust_copied / "report.md").read_text()
    assert "Not there yet, so left out: RANSAC (kitti_06, filtered)." in text
    assert "Left out, since not installed: poselib." in text
    cells = read_robust(robust_copied).cells
    assert "RANSAC" not in cells[0].estimates
    assert "RANSAC" in cells[1].estimates


@pytest.mark.parametrize(("columns", "header"), [(40, "rate of a long name"), (32, "rate of a long")])
def test_only_tables_that_fit_are_printed(monkeypatch, capsys, columns, header):
    monkeypatch.setenv("COLUMNS", str(columns))
    rows = [["mine", *(3 * ["12.3 [10.0, 14.0]"])]]
    short = Table("Short", "What it shows.", ["method", "rate of a long name"], [row[:2] for row in rows])
    print_tables([short, Table("Wide", "", ["method", "a", "b", "c"], rows)], Path("report.html"))
    text = capsys.readouterr().out
    assert "12.3 [10.0, 14.0]" in text
    assert f" {header} │" in text
    assert text.endswith(f"wider than the {columns} columns of this terminal, see report.html:\n  Wide\n")

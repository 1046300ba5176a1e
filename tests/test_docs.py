"""The tutorials' sources, and the check of the built site that make docs runs."""

from __future__ import annotations

import csv
import importlib
import json
import re
import tomllib
from pathlib import Path

import pytest

import kornia_learnnorm as kln
from kornia_learnnorm.evaluation.report.rates import PRINTED

nbformat = pytest.importorskip("nbformat")
DOCS = Path(__file__).parents[1] / "docs"
PAGES = {path: path.read_text(encoding="utf-8") for path in sorted(DOCS.glob("*.md"))}
RESULTS = sorted(path for path in (DOCS / "results").iterdir() if path.suffix != ".toml")
COMMANDS = tomllib.loads((DOCS / "results/commands.toml").read_text(encoding="utf-8"))
CARDS = sorted((DOCS.parent / "kornia_learnnorm/weights").glob("*.md"))
EIGHTS = [f"benchmarks-{store}-{protocol}" for store in ("kitti", "tum") for protocol in ("filtered", "unfiltered")]
NOT_PROSE = re.compile(r"^```.*?^```|^(?:\||    ).*?$|`[^`]*`|\$[^$]*\$", flags=re.DOTALL | re.MULTILINE)
# Three decimals are errors in pixels; two digits and a decimal are percentages on the pages that discuss rates, and two
# decimals F1 on the page of the evaluation, which has times too.
MEASURED = dict.fromkeys(("ablations.md", "paper.md"), r"\d+\.\d{3}|\d\d\.\d\d?")
MEASURED |= {"evaluation.md": r"\d+\.\d{2,3}|\d\d\.\d|(?:\d+ min )?\d+ s|[\d.,]+ ms", "": r"\d+\.\d{3}"}
# Printed by a command that the page names, and in no table; settings.
IN_NO_TABLE = {"evaluation.md": {"1.952", "0.999"}, "upstream.md": {"1.952"}, "paper.md": {"87.6"}}
PLAIN_TABLE = re.compile(r"<!-- docs/results/(\S+)\.csv -->\n((?:\|.*\n)+)")
HEADLINE = re.compile(r"<!-- rows of docs/results/(\S+?)\.(?:csv|json)(?:, (.*?))? -->\n((?:\|.*\n)+)")
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
MAX_COLUMNS = 82  # of code, at the width of the page
SOURCE = "# Title\n\n```{code-cell}\n:tags: [hide-input]\n\nprint(1)\n```\n\n```{code-cell}\n%%bash\nls\n```\n"


@pytest.fixture
def check(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("check_site")


@pytest.fixture
def results(monkeypatch):
    pytest.importorskip("matplotlib")
    pytest.importorskip("IPython")
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("results_tables")


@pytest.fixture
def site(tmp_path):
    for name, body in {
        "index": '<a href="sub/page.html#here">x</a><a href="#top">x</a><a href="https://example.org/none">x</a>',
        "sub/page": '<h1 id="here">x</h1><a href="../index.html">x</a><img src="../picture%201.png">',
    }.items():
        path = tmp_path / f"{name}.html"
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"<html><body>{body}</body></html>")
    (tmp_path / "picture 1.png").touch()
    return tmp_path


def write_notebook(site, cells, text="# Title"):
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [nbformat.v4.new_markdown_cell(text), *map(nbformat.v4.new_code_cell, cells)]
    path = site / "_downloads" / "0" / "one.ipynb"
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, path)
    return path


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "sources" / "one.md"
    path.parent.mkdir()
    path.write_text(SOURCE)
    return path


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_tutorials_have_their_parts(path):
    text = path.read_text(encoding="utf-8")
    assert f"<{path.stem}.ipynb>`" in text
    assert "\n## The result\n" in text
    assert "\n## When not to use this\n" in text
    assert f"\ntutorials/{path.stem}\n" in (DOCS / "index.md").read_text(encoding="utf-8")
    code = re.findall(r"^```\{code-cell\}\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    assert [line for cell in code for line in cell.splitlines() if len(line) > MAX_COLUMNS] == []


def test_there_are_six_tutorials():
    assert len(TUTORIALS) == 6


def test_the_reference_has_every_exported_name():
    assert sorted(re.findall(r"^   (\w+)$", PAGES[DOCS / "api.md"], flags=re.MULTILINE)) == sorted(kln.__all__)


def test_the_reference_has_every_module_once():
    listed = re.findall(r"automodule:: (\S+)", "".join(page.read_text() for page in (DOCS / "api").glob("*.md")))
    root = DOCS.parent
    files = [path for name in ("kornia_learnnorm", "lightning_modules") for path in (root / name).rglob("[!_]*.py")]
    modules = {".".join(path.relative_to(root).with_suffix("").parts) for path in files}
    assert sorted(set(listed) - {"kornia_learnnorm.data.synthetic"}) == sorted(modules)
    assert len(listed) == len(set(listed))


def test_a_site_without_faults(check, site, source, capsys):
    write_notebook(site, ["print(1)", "%%bash\nls"])
    assert check.main(site, source.parent) == 0
    assert "0 faults" in capsys.readouterr().out


@pytest.mark.parametrize("link", ["missing.html", "sub/page.html#there", "#there", "sub", "picture.png"])
def test_broken_links_are_found(check, site, link):
    page = site / "index.html"
    page.write_text(page.read_text().replace("<body>", f'<body><a href="{link}">x</a>'))
    assert check.broken_links(site) == [f"index.html: {link}"]


@pytest.mark.parametrize(
    ("cells", "text", "fault"),
    [
        (["print(1)"], "# Title", "code cells"),
        (["print(1)", "%%bash\nls"], "see {doc}`there`", "{doc}"),
    ],
)
def test_faults_of_notebooks_are_found(check, site, source, cells, text, fault, capsys):
    write_notebook(site, cells, text)
    assert check.main(site, source.parent) == 1
    assert fault in capsys.readouterr().out


def test_missing_and_damaged_notebooks_are_found(check, site, source):
    assert "expected 1" in check.notebook_faults(source, site)[0]
    write_notebook(site, []).write_text("{}")
    assert "not a notebook" in check.notebook_faults(source, site)[0]
    write_notebook(site, []).write_text("no JSON")
    assert "not a notebook" in check.notebook_faults(source, site)[0]


def test_a_folder_without_a_site_is_an_error(check, tmp_path, capsys):
    assert check.main(tmp_path, tmp_path) == 2
    assert str(tmp_path) in capsys.readouterr().err


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_results_are_shown_by_pages_that_name_their_command(path):
    uses = f'"{path.stem}"', f"results/{path.name}", f"results.{path.stem}_"
    pages = {page.name: text for page, text in PAGES.items() if any(use in text for use in uses)}
    assert pages
    for name, text in pages.items():
        assert COMMANDS[path.name] in " ".join(text.replace("\\\n", " ").split()), name


def test_commands_are_those_of_files():
    assert sorted(COMMANDS) == [path.name for path in RESULTS]


def read_table(table):
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return rows[0], rows[2:]


def read_results(name):
    with (DOCS / f"results/{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def test_plain_tables_have_the_numbers_of_their_files():
    tables = [match for text in PAGES.values() for match in PLAIN_TABLE.findall(text)]
    assert [name for name, _ in tables] == EIGHTS
    for name, table in tables:
        header, rows = read_table(table)
        assert [header, *rows] == read_results(name), name


def rows_of(name, group, columns):
    """Rows of a file as a page shows them: median errors by size, or times and their ratios to Kornia's."""
    if group is None:
        return read_results(name)[1:]
    found = json.loads((DOCS / f"results/{name}.json").read_text(encoding="utf-8"))[group]
    if name == "sizes":
        sizes = [column.removeprefix("N = ") for column in columns]
        return [[row, *(f"{by[size][0]:.3f}" if size in by else "-" for size in sizes)] for row, by in found.items()]
    times = [found[case] for case in columns]
    methods = [row for row in times[0] if all(row in case for case in times)]
    return [[row, *(f"{case[row]:.3g} ({case[row] / case['kornia']:.2f})" for case in times)] for row in methods]


def test_headline_tables_have_rows_of_their_files():
    tables = HEADLINE.findall(PAGES[DOCS / "benchmarks.md"])
    assert len(tables) == 8
    for name, group, table in tables:
        header, rows = read_table(table)
        if not group:
            assert header == read_results(name)[0], name
        expected = rows_of(name, group or None, header[1:])
        assert [row for row in rows if row not in expected] == [], (name, group)


@pytest.fixture(scope="module")
def measured():
    """All numbers of the results as tables show them, and those that Fan et al. print."""
    cells = str([read_results(path.stem) for path in RESULTS if path.suffix == ".csv"] + [PRINTED])
    sizes = json.loads((DOCS / "results/sizes.json").read_text(encoding="utf-8"))
    errors = {f"{found[0]:.3f}" for store in sizes.values() for row in store.values() for found in row.values()}
    return errors | set(re.findall(r"\d+\.\d+", cells))


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_numbers_in_sentences_are_those_of_the_results(path, measured):
    pattern = MEASURED.get(path.name, MEASURED[""])
    found = re.findall(rf"(?<![\w./])(?:{pattern})(?![\w.]*\w)", NOT_PROSE.sub("", PAGES[path]))
    assert [number for number in found if number not in measured | IN_NO_TABLE.get(path.name, set())] == []


def test_the_proposal_to_kornia_has_the_numbers_of_the_benchmarks():
    table = re.search(r"^\| normalisation(?:.*\n\|)+.*\n", PAGES[DOCS / "upstream.md"], flags=re.MULTILINE)[0]
    measured = {row[0]: [row[4], row[5]] for row in read_results("benchmarks-kitti-filtered")}
    names = "none", "Hartley", "whitening", "reweighted", "crossview"
    assert [row[1:] for row in read_table(table)[1]] == [measured[name] for name in names]


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_model_cards_have_the_numbers_of_the_results(path):
    text = path.read_text(encoding="utf-8")
    by_size = re.findall(r"^`(\w+)`, (\w+) matches\n\n(\| median(?:.*\n\|)+.*\n)", text, flags=re.MULTILINE)
    eights = re.findall(r"^\| method(?:.*\n\|)+.*\n", text, flags=re.MULTILINE)
    assert len(by_size) + len(eights) == 4
    measured = json.loads((DOCS / "results/sizes.json").read_text(encoding="utf-8"))
    for store, protocol, table in by_size:
        header, rows = read_table(table)
        for name, *cells in rows:
            errors = {f"N = {size}": f"{pair[0]:.3f}" for size, pair in measured[f"{store}, {protocol}"][name].items()}
            assert cells == [errors.get(size, "-") for size in header[1:]], f"{store}, {protocol}, {name}"
    for name, table in zip(EIGHTS, eights, strict=False):
        for row in read_table(table)[1]:
            assert row in read_results(name), name


def test_plots_take_the_colour_of_the_page(results):
    plot = results.dot_plot({"rate, %": ("ablations-hartley", {"KITTI": 1, "TUM": 2})}, "rates of all rows")
    assert "currentColor" in plot.data
    assert results.INK not in plot.data
    assert 'aria-label="rates of all rows"' in plot.data


def test_a_missing_method_is_an_error(results):
    with pytest.raises(ValueError, match=r"no learned:none for kitti_06, filtered"):
        results.sizes_rows("kitti_06, filtered", ["Hartley", "learned:none"])

"""The README and the pages: commands parse, tables are those of the results, public names are in the reference."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import TRAINING, make_parser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CARDS = sorted((ROOT / "kornia_learnnorm/weights").glob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *CARDS, *sorted(DOCS.rglob("*.md"))]
TEXTS = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in PAGES if "_build" not in path.parts
}
RESULTS = sorted(path for path in (DOCS / "results").iterdir() if path.suffix != ".toml")
COMMANDS = tomllib.loads((DOCS / "results/commands.toml").read_text(encoding="utf-8"))
FENCE = re.compile(r"^ *```([^\n]*)\n(.*?)^ *```$", flags=re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^ *(?:[A-Z_]+=\S+ )*((?:learnnorm|make|python) [^#>|;&\n]+)", flags=re.MULTILINE)
TABLE = re.compile(r"^<!-- (?:rows of )?docs/results/(\S+)\.(?:csv|json)(?:, (.*?))? -->\n((?:\|.*\n)+)", re.MULTILINE)
DETECTORS = ("xfeat", "aliked")
NUMBER = r"\d+\.\d+|\d+"


def read_commands(text):
    """Return the words of the command lines of a page, in fences and indented, up to a comment or a redirection."""
    fences = [code for kind, code in FENCE.findall(text) if kind != "text"]
    indented = re.findall(r"^ {4}.*$", FENCE.sub("", text), flags=re.MULTILINE)
    code = re.sub(r"\\\n *", "", "\n".join([*fences, *indented]))
    return [line.split() for line in COMMAND.findall(code)]


def check_command(words):
    """Raise an error where the command line of this package refuses the words, or what they call does not exist."""
    if words[0] == "learnnorm":
        _, unknown = make_parser().parse_known_args(words[1:])
        assert unknown == [] or (words[1] in TRAINING and unknown[0].startswith("--")), words
    elif words[0] == "make" and len(words) > 1:
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE), words
    elif words[0] == "python" and words[1].endswith(".py"):
        assert (ROOT / words[1]).is_file(), words


@pytest.mark.parametrize("page", TEXTS)
def test_commands_parse(page):
    for words in read_commands(TEXTS[page]):
        check_command(words)


def test_commands_of_results_parse():
    assert sorted(COMMANDS) == [path.name for path in RESULTS]
    for command in COMMANDS.values():
        check_command(command.split())


def test_the_reference_has_every_public_name():
    assert sorted(re.findall(r"^   (\w+)$", TEXTS["docs/api.md"], flags=re.MULTILINE)) == sorted(kln.__all__)
    modules = re.findall(r"automodule:: (\S+)", "".join(text for page, text in TEXTS.items() if "docs/api/" in page))
    assert len(modules) == len(set(modules))
    assert [module for module in modules if not importlib.util.find_spec(module)] == []
    assert [name for name in kln.__all__ if getattr(kln, name).__module__ not in modules] == []


def read_table(table):
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in table.splitlines()
        if not line.startswith("|:-")
    ]


def read_rows(name):
    with (DOCS / f"results/{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def results(name):
    return json.loads((DOCS / f"results/{name}.json").read_text(encoding="utf-8"))


def sizes_rows(title, sizes):
    """Return the rows of a table of median errors by number of matches."""
    cells = {
        row: {f"N = {size}": f"{found[0]:.3f}" for size, found in by.items()}
        for row, by in results("sizes")[title].items()
    }
    return [[row, *(by_size.get(size, "-") for size in sizes)] for row, by_size in cells.items()]


@pytest.mark.parametrize("page", [page for page, text in TEXTS.items() if TABLE.search(text)])
def test_tables_are_those_of_the_results(page):
    for name, group, table in TABLE.findall(TEXTS[page]):
        header, *rows = read_table(table)
        if group:
            expected = sizes_rows(group, header[1:])
        else:
            expected = read_rows(name)
            assert header == expected[0], name
        assert [row for row in rows if row not in expected] == [], (name, group)


def test_the_readme_has_errors_of_the_results():
    """Its rows have other names, and the numbers of both stores."""
    table = re.findall(r"^\| .+? \| (\d+\.\d{3} .*) \|$", TEXTS["README.md"], flags=re.MULTILINE)
    stores = [results("sizes")[f"{store}, unfiltered"] for store in ("kitti_06", "tum_fr3_office")]
    expected = [
        [f"{store[row].get(n, [0])[0]:.3f}" for store in stores for n in ("16", "64", "512")] for row in stores[0]
    ]
    assert len(table) == 6
    assert [row for row in table if row.split(" | ") not in expected] == []


def test_the_readme_has_poses_of_the_results():
    found = {(row[0], row[1]): row[2] for row in read_rows("poses")}
    stores = [
        f"{name}_{detector}_lightglue" for name in ("photographs", "kitti_06") for detector in ("xfeat", "aliked")
    ]
    expected = [[found[store, name] for store in stores] for name in {name for _, name in found} - {"estimator"}]
    table = re.findall(r"^\| [^|]+ \| (\d+\.\d \| .*) \|$", TEXTS["README.md"], flags=re.MULTILINE)
    assert len(table) == 7
    assert [row for row in table if row.split(" | ") not in expected] == []


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_a_page_shows_each_file_of_results(path):
    uses = f'"{path.stem}"', f"results/{path.name}", f"{{results}} {path.stem}_"
    assert [page for page, text in TEXTS.items() if any(use in text for use in uses)]


def test_the_code_of_the_readme_prints_what_it_shows():
    pytest.importorskip("cv2")
    blocks = re.findall(r"```(python|text)\n(.*?)```", TEXTS["README.md"], flags=re.DOTALL)
    namespace, printed = {}, StringIO()
    for kind, block in blocks:
        if kind == "python":
            with redirect_stdout(printed):
                exec(compile(block, "README.md", "exec"), namespace)
    shown = "".join(block for kind, block in blocks if kind == "text")
    assert re.sub(NUMBER, "#", printed.getvalue()) == re.sub(NUMBER, "#", shown)
    numbers = [[float(number) for number in re.findall(NUMBER, text)] for text in (printed.getvalue(), shown)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.02, abs=0.03)  # processors round differently


def test_the_model_zoo_lists_every_shipped_file_with_its_size():
    for path in CARDS:
        module = kln.LearnedEightPoint if path.stem.startswith("robust") else kln.LearnedNormalizer
        module = kln.LearnedRelativePose if path.stem.startswith("robust-pose") else module
        module = kln.LearnedHomography if path.stem == "robust-homography" else module
        module = kln.MatchRefiner if path.stem == "refiner" else module
        size = sum(p.numel() for p in module.from_pretrained(path.stem).parameters())
        row = rf"\[`{path.stem}`\].*\| `{module.__name__}` \| {size:,} \| (.*) \| (.*) \|"
        data, licence = re.search(row, TEXTS["README.md"]).groups()
        row = f"| `{path.stem}` | {{py:class}}`~kornia_learnnorm.{module.__name__}` | {data} | {licence} |"
        assert row in TEXTS["docs/zoo.md"]


@pytest.fixture
def check_site(monkeypatch):
    pytest.importorskip("nbformat")
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("check_site")


@pytest.mark.parametrize("link", ["missing.html", "sub/page.html#there"])
def test_broken_links_of_the_built_site_are_found(check_site, link, tmp_path):
    good = '<a href="sub/page.html#here">x</a><a href="#top">x</a><a href="https://example.org/none">x</a>'
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/page.html").write_text('<h1 id="here">x</h1><a href="../index.html">x</a><img src="../a%20b.png">')
    (tmp_path / "a b.png").touch()
    (tmp_path / "index.html").write_text(good)
    assert check_site.broken_links(tmp_path) == []
    (tmp_path / "index.html").write_text(f'{good}<a href="{link}">x</a>')
    assert check_site.broken_links(tmp_path) == [f"index.html: {link}"]


def test_links_of_the_readme_lead_to_files_that_read_well_without_the_site():
    links = re.findall(r"\]\(([^)#\s]+)\)|(?:src|srcset)=\"([^\"]+)\"", TEXTS["README.md"])
    paths = [ROOT / (link or source) for link, source in links if "://" not in link]
    assert [path for path in paths if not path.is_file()] == []
    texts = {path: path.read_text(encoding="utf-8") for path in paths if path.suffix == ".md"}
    assert [
        path for path, text in texts.items() if re.search(r"\{(doc|ref|eval-rst|code-cell|toctree|py:\w+)\}", text)
    ] == []
    pages = re.findall(r"`([\w/-]+)\.html`", TEXTS["README.md"])
    assert [page for page in pages if not (DOCS / f"{page}.md").is_file()] == []

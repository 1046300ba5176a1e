"""The README and the pages: commands parse, tables are those of the results, public names are in the reference."""

import hashlib
import importlib.util
import re
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
import torch
from kornia.metrics import angle_error_mat

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import TRAINING, make_parser
from kornia_learnnorm.data.synthetic import handheld

results_tables = pytest.importorskip("results_tables")
ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CARDS = sorted((ROOT / "kornia_learnnorm/weights").glob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *CARDS, *sorted(DOCS.rglob("*.md"))]
TEXTS = {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in PAGES if "_build" not in p.parts}
RESULTS = sorted(path for path in (DOCS / "results").iterdir() if path.suffix != ".toml")
COMMANDS = tomllib.loads((DOCS / "results/commands.toml").read_text(encoding="utf-8"))
FENCE = re.compile(r"^ *```([^\n]*)\n(.*?)^ *```$", flags=re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^ *(?:[A-Z_]+=\S+ )*((?:learnnorm|make|python) [^#>|;&\n]+)", flags=re.MULTILINE)
TABLE = re.compile(r"^<!-- (?:rows of )?docs/results/(\S+)\.(?:csv|json)(?:, (.*?))? -->\n((?:\|.*\n)+)", re.MULTILINE)


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
    lines = [line for line in table.splitlines() if not line.startswith("|:-")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("page", [page for page, text in TEXTS.items() if TABLE.search(text)])
def test_tables_are_those_of_the_results(page):
    for name, group, table in TABLE.findall(TEXTS[page]):
        header, *rows = read_table(table)
        if group:
            sizes = [int(label.removeprefix("N = ")) for label in header[1:]]
            expected = results_tables.sizes_rows(group, results_tables.read_json(name)[group], sizes)
        else:
            expected = results_tables.read_rows(name)
            assert header == expected[0], name
        assert [row for row in rows if row not in expected] == [], (name, group)


def test_the_readme_has_poses_and_the_picture_of_the_results():
    """If not, run python docs/results_tables.py docs/images/sizes.svg."""
    tables = re.findall(r"^(?:\|.*\n)+", TEXTS["README.md"], flags=re.MULTILINE)
    assert read_table(results_tables.poses_summary().data) in [*map(read_table, tables)]
    source = hashlib.sha256((DOCS / "results/sizes.json").read_bytes()).hexdigest()
    assert source in (DOCS / "images/sizes.svg").read_text(encoding="utf-8")


def lightglue_output():
    """Return what the README's code reads: a pair's features, LightGlue's output, its cameras and rotation."""
    scene = handheld(1, 100, torch.Generator().manual_seed(0), noise=0.3, outliers=0.2)
    scores = torch.ones(100, dtype=torch.float64, requires_grad=True)
    found = {"matches": [torch.arange(100)[:, None].expand(-1, 2)], "scores": [scores]}
    views = scene.points1, scene.points2
    sides = {f"side{n}": {"keypoints": x, "image_size": 2 * x.amax(1).ceil()} for n, x in enumerate(views, 1)}
    return {**sides, "lightglue": lambda _: found, "K1": scene.K1[0], "K2": scene.K2[0], "R_true": scene.R}


def test_the_code_of_the_readme_runs():
    blocks = re.findall(r"```python\n(.*?)```", TEXTS["README.md"], flags=re.DOTALL)
    assert blocks == re.findall(r"```python\n(.*?)```", TEXTS["docs/index.md"], flags=re.DOTALL)
    namespace = lightglue_output()
    with redirect_stdout(StringIO()):
        for block in blocks:
            exec(compile(block, "README.md", "exec"), namespace)
    assert angle_error_mat(namespace["pair"].R[None], namespace["R_true"]).item() < 1
    assert namespace["scores"].grad.abs().sum() > 0


def test_the_model_zoo_lists_every_shipped_file_with_its_size():
    rows = re.findall(r"\[`([\w-]+)`\]\(models/\1\.md\) \| `(\w+)` \| ([\d,]+) \| .+ \| .+ \|", TEXTS["docs/zoo.md"])
    assert sorted(name for name, *_ in rows) == sorted(path.stem for path in CARDS)
    for name, module, size in rows:
        assert f"{sum(p.numel() for p in getattr(kln, module).from_pretrained(name).parameters()):,}" == size
        assert f"weights/{name}.md" in TEXTS[f"docs/models/{name}.md"]


def test_links_lead_to_files_that_read_well_without_the_site():
    """Those of the README to pages, those of pages to pages; a role that links to a page is lost without the site."""
    for page, text in TEXTS.items():
        links = re.findall(r"\]\(([^)#\s]+)[^)\s]*\)|(?:src|srcset)=\"([^\"]+)\"", text)
        paths = [(ROOT / page).parent / (link or source) for link, source in links if "://" not in link]
        assert [path for path in paths if not path.is_file()] == [], page
        assert re.findall(r"\{(?:doc|ref)\}`.+?`", text) == [], page

"""The README: its code prints what it shows, its links lead to plain Markdown, its numbers are those of the docs."""

from __future__ import annotations

import json
import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
import yaml

import kornia_learnnorm as kln

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
NUMBER = r"\d+\.\d+|\d+"
SITE_ONLY = r"\{(doc|ref|eval-rst|code-cell|toctree|py:\w+)\}"  # what Markdown viewers show as it stands
RESULTS = {
    "Hartley's eight-point": "Hartley",
    "OpenCV USAC-MAGSAC": "opencv-usac-magsac",
    "PoseLib": "poselib",
    "Kornia RANSAC": "kornia",
    "`RANSAC`": "RANSAC",
    "`LearnedEightPoint`": "learned:robust-synthetic",
}
LINKS = [link for link in re.findall(r"\]\(([^)#\s]+)\)|(?:src|srcset)=\"([^\"]+)\"", README) for link in link if link]
LINKS = [link for link in LINKS if "://" not in link]


def test_the_code_prints_what_the_readme_shows():
    pytest.importorskip("cv2")
    blocks = re.findall(r"```(python|text)\n(.*?)```", README, flags=re.DOTALL)
    assert [kind for kind, _ in blocks].count("text") == 1
    namespace, printed = {}, StringIO()
    for kind, block in blocks:
        if kind == "python":
            with redirect_stdout(printed):
                exec(compile(block, "README.md", "exec"), namespace)
    shown = "".join(block for kind, block in blocks if kind == "text")
    assert re.sub(NUMBER, "#", printed.getvalue()) == re.sub(NUMBER, "#", shown)
    numbers = [[float(number) for number in re.findall(NUMBER, text)] for text in (printed.getvalue(), shown)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.02, abs=0.03)  # processors round differently
    assert namespace["F"].shape == (1, 3, 3)
    assert namespace["inliers"].shape == namespace["ratio"].shape


def test_the_readme_is_short():
    assert len(README.splitlines()) < 120


def test_links_lead_to_files_that_read_well_without_the_site():
    assert LINKS
    for link in LINKS:
        path = ROOT / link
        assert path.is_file(), link
        if path.suffix == ".md":
            assert not re.search(SITE_ONLY, path.read_text(encoding="utf-8")), link


def test_named_pages_of_the_documentation_exist():
    pages = re.findall(r"`([\w/-]+)\.html`", README)
    assert len(pages) > 6
    assert [page for page in pages if not (ROOT / f"docs/{page}.md").is_file()] == []


def test_results_are_those_of_the_documentation():
    table = re.search(r"## Results\n(.*?)\n## ", README, flags=re.DOTALL)[1]
    rows = dict(re.findall(r"^\| (.+?) \| (\d.*) \|$", table, flags=re.MULTILINE))
    assert rows.keys() == RESULTS.keys()
    measured = json.loads((ROOT / "docs/results/sizes.json").read_text(encoding="utf-8"))
    for name, numbers in rows.items():
        stores = (measured[f"{store}, unfiltered"][RESULTS[name]] for store in ("kitti_06", "tum_fr3_office"))
        expected = [f"{store[size][0]:.3f}" for store in stores for size in ("16", "64", "512")]
        assert numbers.split(" | ") == expected, name


def test_the_zoo_lists_every_shipped_file_with_its_size():
    for path in sorted((ROOT / "kornia_learnnorm/weights").glob("*.safetensors")):
        module = kln.LearnedEightPoint if path.stem.startswith("robust") else kln.LearnedNormalizer
        size = sum(p.numel() for p in module.from_pretrained(path.stem).parameters())
        row = re.search(rf"\[`{path.stem}`\].*\| `{module.__name__}` \| {size:,} \| (.*) \| (.*) \|", README)
        assert row, path.stem
        zoo = (ROOT / "docs/zoo.md").read_text(encoding="utf-8")
        assert f"| `{path.stem}` | {{py:class}}`~kornia_learnnorm.{module.__name__}` | {row[1]} | {row[2]} |" in zoo


def test_the_citation_file_is_that_of_the_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == kln.__version__
    article = citation["preferred-citation"]
    assert f"doi     = {{{article['doi']}}}" in README
    assert f"url = {{{article['url']}}}" in README

"""The form of the pages: code fits its box, code that makes a table is folded, and a page begins with its result."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("tutorials/*.md")])
NAMES = [str(path.relative_to(DOCS)) for path in PAGES]
MAX_COLUMNS = 82  # of code, at the width of the page
OUTPUT = "text"  # the language of blocks that show what a command printed, which is not wrapped
NO_RESULT = ("api", "benchmarks", "changelog", "cli", "contributing", "demo", "faq", "index", "zoo")
WITH_RESULT = [path for path in PAGES if path.parent == DOCS and path.stem not in NO_RESULT]
FENCE = re.compile(r"^ *```([^\n]*)\n(.*?)^ *```$", flags=re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"^ {4}.*$", flags=re.MULTILINE)
FOLDED = re.compile(r"^:?tags: .*(?:hide|remove)-(?:input|cell)", flags=re.MULTILINE)
TITLE = re.compile(r"^# .*\n+", flags=re.MULTILINE)
PARAGRAPHS = 2  # after the title, one of which has the result of the page in bold


def read(path):
    return path.read_text(encoding="utf-8")


def code_lines(text):
    """Return the lines of the code of a page, in fences and indented, without those that a command printed."""
    fences = [code for kind, code in FENCE.findall(text) if kind.strip() != OUTPUT]
    return [*"\n".join(fences).splitlines(), *INDENTED.findall(FENCE.sub("", text))]


def unfolded(text):
    """Return the code cells that make a table and show their code."""
    cells = [code for kind, code in FENCE.findall(text) if kind.startswith("{code-cell}")]
    return [cell for cell in cells if "format_table(" in cell and not FOLDED.search(cell)]


def first_paragraphs(text):
    """Return the paragraphs after the title of a page."""
    return TITLE.split(FENCE.sub("", text), maxsplit=1)[1].split("\n\n")[:PARAGRAPHS]


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_code_fits_the_page(path):
    assert [line for line in code_lines(read(path)) if len(line) > MAX_COLUMNS] == []


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_code_of_tables_is_folded(path):
    assert unfolded(read(path)) == []


@pytest.mark.parametrize("path", WITH_RESULT, ids=lambda path: path.stem)
def test_pages_begin_with_their_result(path):
    assert any(re.search(r"\*\*[^*]+\*\*", paragraph) for paragraph in first_paragraphs(read(path)))


def test_faults_are_found():
    wide = "x" * (MAX_COLUMNS + 1)
    assert code_lines(f"```text\n{wide}\n```\n\n```{{code-cell}}\n{wide}\n```\n\n    {wide}\n") == [wide, f"    {wide}"]
    assert unfolded("```{code-cell}\n:tags: [hide-input]\n\nformat_table()\n```\n") == []
    assert unfolded("```{code-cell}\nformat_table()\n```\n") == ["format_table()\n"]
    assert first_paragraphs("```{code-cell}\n# a\n```\n\n# Title\n\none\n\ntwo\n\n**three**\n") == ["one", "two"]

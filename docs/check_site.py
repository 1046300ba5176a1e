"""Check the built site: internal links lead to pages and anchors, tutorials offer notebooks with their code.

    python docs/check_site.py docs/_build/html

Sphinx checks its own references; this also covers links in raw HTML, in outputs of cells and between downloads.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import nbformat

CELL = re.compile(r"^```\{code-cell\}[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
TAGS = re.compile(r"^:tags:[^\n]*\n")
ROLE = re.compile(r"\{[\w:-]+\}`")


class Page(HTMLParser):
    """The links and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors: set[str] = {""}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect what the tag links to and the names it can be linked by."""
        values = {name: value for name, value in attrs if value}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.links |= {values[name] for name in ("href", "src") if name in values}


def broken_links(site: Path) -> list[str]:
    """Return the internal links of a built site that lead nowhere, as texts ``page: link``."""
    pages = {path.resolve(): Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    broken = []
    for path, page in pages.items():
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            missing = not target.is_file() or (
                target in pages and unquote(parts.fragment) not in pages[target].anchors | {"top"}
            )
            if missing:
                broken.append(f"{path.relative_to(site.resolve())}: {link}")
    return broken


def notebook_faults(source: Path, site: Path) -> list[str]:
    """Return what is wrong with the notebook that the site offers of a tutorial."""
    found = list(site.glob(f"_downloads/*/{source.stem}.ipynb"))
    if len(found) != 1:
        return [f"{source.stem}: {len(found)} notebooks to download, expected 1"]
    try:
        notebook = nbformat.read(found[0], as_version=4)
        nbformat.validate(notebook)
    except (nbformat.ValidationError, nbformat.reader.NotJSONError) as error:
        return [f"{source.stem}: not a notebook: {str(error).splitlines()[0]}"]
    code = [cell.source.strip() for cell in notebook.cells if cell.cell_type == "code"]
    code = code[1:] if code and code[0].startswith("%pip install") else code  # for Colab
    shown = [TAGS.sub("", cell).strip() for cell in CELL.findall(source.read_text(encoding="utf-8"))]
    faults = []
    if code != shown:
        faults.append(f"{source.stem}: the notebook does not have the {len(shown)} code cells of the page")
    if any("../" in cell for cell in code):
        faults.append(f"{source.stem}: the notebook reads a folder of the checkout")
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    if roles := ROLE.findall(text):
        faults.append(f"{source.stem}: the notebook has Sphinx's roles: {', '.join(sorted(set(roles)))}")
    return faults


def main(site: Path, tutorials: Path) -> int:
    """Print what is wrong with a site and return the exit code."""
    if not (site / "index.html").is_file():
        print(f"no site in {site}: run sphinx first", file=sys.stderr)
        return 2
    sources = sorted(tutorials.glob("*.md"))
    faults = broken_links(site) + [fault for source in sources for fault in notebook_faults(source, site)]
    print("\n".join([*faults, f"{len(faults)} faults in links and in {len(sources)} notebooks"]))
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(__file__).parent / "tutorials"))

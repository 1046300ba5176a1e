"""Each file of the package has a name of its own, so that a responsibility has one place to look for."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "kornia_learnnorm"


def test_no_file_name_occurs_twice():
    names = Counter(path.stem for path in PACKAGE.rglob("*.py") if path.stem != "__init__")
    assert [name for name, number in names.items() if number > 1] == []

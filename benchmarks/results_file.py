"""The files that the benchmarks write their tables to."""

import csv
from collections.abc import Sequence
from typing import Any

from kornia_learnnorm.files import atomic_write


def write_csv(path: str, rows: Sequence[Sequence[Any]]) -> None:
    """Write rows, the header first, beside the file and then rename it."""
    with atomic_write(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)

"""What the benchmarks share: options, files, areas under curves, and pairs of photographs with known cameras."""

import csv
import json
import math
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kornia_learnnorm.data.datasets.frames import Frame, FramePair
from kornia_learnnorm.data.images import image_size
from kornia_learnnorm.files import atomic_write, write_text
from kornia_learnnorm.metrics.poses import pose_auc


def make_parser(description: str | None, **files: str) -> ArgumentParser:
    """Return a parser that prints a description as it stands, with options for files to write, by their help."""
    parser = ArgumentParser(description=description, formatter_class=RawDescriptionHelpFormatter)
    for name, text in files.items():
        parser.add_argument(f"--{name}", help=text)
    return parser


def read_csv(path: str | Path) -> list[list[str]]:
    """Return the rows of a file, the header first."""
    with Path(path).open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def write_csv(path: str | Path | None, rows: Sequence[Sequence[Any]]) -> None:
    """Write rows, the header first, beside the file and then rename it; nothing without a path."""
    if path:
        with atomic_write(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


def write_json(path: str | Path | None, value: Any) -> None:
    """Write a value with null in the place of numbers that are not finite; nothing without a path."""
    if path:
        write_text(path, json.dumps(_finite(value), indent=1, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def auc_cells(errors: Any, thresholds: Sequence[float] = (5, 10, 20)) -> list[str]:
    """Return the areas under the recall curve of errors up to each threshold, %."""
    return [f"{100 * share:.1f}" for share in pose_auc(torch.as_tensor(errors).double(), thresholds)]


def photograph_pairs(folder: Path, gaps: Sequence[int]) -> list[FramePair]:
    """Return the pairs, so many images apart, of the places of a folder with cameras.json."""
    frames = []
    for name, known in sorted(json.loads((folder / "cameras.json").read_text(encoding="utf-8")).items()):
        camera, pose = (np.array(known[key]) for key in ("K", "camera_to_world"))
        frames.append(Frame(folder / name, name, name.split("/")[0], image_size(folder / name), camera, pose))
    pairs = [FramePair(*pair) for gap in gaps for pair in zip(frames, frames[gap:], strict=False)]
    return [pair for pair in pairs if pair.frame1.sequence == pair.frame2.sequence]

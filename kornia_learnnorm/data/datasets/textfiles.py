"""Parsing the text files of datasets: lines of names and numbers, with errors that name file and line."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from numpy.typing import NDArray

from kornia_learnnorm.files import explained

Array = NDArray[np.float64]


class TextLine(NamedTuple):
    """A line of a text file."""

    path: Path
    number: int  # from 1
    text: str  # without white space around it

    def error(self, expected: str) -> ValueError:
        """Return the error that says what was expected and quotes the line."""
        return ValueError(f"{self.path}, line {self.number}: {expected} expected, got {self.text!r}")

    def numbers(self, words: list[str], count: int, expected: str) -> Array:
        """Return ``count`` finite numbers, (count,)."""
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not np.isfinite(values).all():
            raise self.error(expected)
        return values

    def image(self, name: str) -> str:
        """Return the name of an image that the line has, if it exists beside the file."""
        if not (self.path.parent / name).is_file():
            raise FileNotFoundError(f"{self.path}, line {self.number}: no image at {self.path.parent / name}")
        return name

    def quaternion(self, wxyz: Array) -> Array:
        """Return a quaternion (w, x, y, z) of any norm but zero with unit norm."""
        norm = np.linalg.norm(wxyz)
        if norm == 0:
            raise self.error("a quaternion other than zero")
        return np.asarray(wxyz / norm)


def text_lines(path: Path, what: str) -> Iterator[TextLine]:
    """Yield the lines that are neither empty nor a comment."""
    if not path.is_file():
        raise FileNotFoundError(f"no {what} at {path}")
    with path.open(encoding="utf-8-sig") as file, explained(f"{path} is not a text file in UTF-8", UnicodeDecodeError):
        for number, line in enumerate(file, 1):
            if line.strip() and not line.startswith("#"):
                yield TextLine(path, number, line.strip())


def rigid_motion(rotation: Array, t: Array) -> Array:
    """Return the matrix (4, 4) of a rotation, (3, 3) or a unit quaternion (w, x, y, z), and a translation."""
    R = rotation if rotation.ndim == 2 else quaternion_to_rotation_matrix(torch.from_numpy(rotation)).numpy()
    return np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return the camera matrix (3, 3), pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

"""Parsing the text files of datasets: lines of names and numbers, with errors that name file and line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from numpy.typing import NDArray

__all__ = ["camera_matrix", "listed_image", "parse_numbers", "quaternion_pose", "rigid_motion", "text_lines"]

Array = NDArray[np.float64]


def text_lines(path: Path, what: str) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of each line that is neither empty nor a comment."""
    if not path.is_file():
        raise FileNotFoundError(f"no {what} at {path}")
    with path.open(encoding="utf-8") as file:
        try:
            for number, line in enumerate(file, 1):
                if line.strip() and not line.startswith("#"):
                    yield number, line.strip()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path} is not a text file in UTF-8: {error}") from error


def parse_numbers(path: Path, number: int, words: list[str], count: int, expected: str, line: str = "") -> Array:
    """Return ``count`` finite numbers, (count,); the error says what was ``expected`` and quotes the line."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{path}, line {number}: {expected} expected, got {line or ' '.join(words)!r}")
    return values


def listed_image(path: Path, number: int, name: str) -> str:
    """Return the name of an image that a file lists, if it exists beside that file."""
    if not (path.parent / name).is_file():
        raise FileNotFoundError(f"{path}, line {number}: no image at {path.parent / name}")
    return name


def quaternion_pose(path: Path, number: int, wxyz: Array, centre: Array) -> Array:
    """Return the pose (4, 4) of a rotation, a quaternion (w, x, y, z) of any norm but zero, and a translation."""
    norm = np.linalg.norm(wxyz)
    if norm == 0:
        raise ValueError(f"{path}, line {number}: a quaternion other than zero expected, got {wxyz}")
    return rigid_motion(np.asarray(quaternion_to_rotation_matrix(torch.from_numpy(wxyz / norm))), centre)


def rigid_motion(R: Array, t: Array) -> Array:
    """Return the matrix (4, 4) of a rotation and a translation."""
    return np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return the camera matrix (3, 3), pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

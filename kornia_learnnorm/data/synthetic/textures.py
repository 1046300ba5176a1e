"""Textures of rendered scenes: masonry, windows and framed pictures, in brightness 0-1; images need OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "PAINTERS",
    "Painter",
    "Random",
    "Texture",
    "circles",
    "framed",
    "letters",
    "masonry",
    "noise",
    "polygons",
    "windows",
]

Texture = NDArray[np.float32]
Pair = tuple[float, float]  # width and height, metres
Random = np.random.Generator
Painter = Callable[[Random, Any, Texture], None]


def noise(rng: Random, cv2: Any, shape: tuple[int, int], finest: int) -> Texture:
    """Return noise of all scales from the whole texture to ``finest`` texels, with standard deviation one."""
    total = np.zeros(shape, np.float32)
    cell = max(shape) // 2
    while cell >= finest:
        grid = rng.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2)).astype(np.float32)
        total += cv2.resize(grid, shape[::-1], interpolation=cv2.INTER_CUBIC) * np.float32(cell**0.3)
        cell //= 2
    return np.asarray(total / total.std(), np.float32)


def masonry(rng: Random, cv2: Any, size: Pair, density: float, brick: Pair, shift: float) -> Texture:
    """Return bricks or tiles of random tones; every other row is shifted by a share of a brick."""
    rows, columns = (np.arange(int(metres * density)) / density for metres in size[::-1])
    row = rows / brick[1]
    column = columns / brick[0] + shift * (row.astype(int)[:, None] % 2)
    tones = rng.uniform(0.3, 0.75, (int(row[-1]) + 1, int(column.max()) + 1))
    tone = tones[row.astype(int)[:, None], column.astype(int)]
    joint = (row % 1 < 0.02 / brick[1])[:, None] | (column % 1 < 0.02 / brick[0])
    texture = np.where(joint, 0.85, tone).astype(np.float32)
    texture += 0.09 * noise(rng, cv2, texture.shape, finest=4)
    return np.asarray(cv2.GaussianBlur(texture, None, 0.8), np.float32)


def framed(rng: Random, cv2: Any, paint: Painter, size: Pair, density: float) -> Texture:
    """Return a painting in a dark frame with a pale mount."""
    width, height = (int(metres * density) for metres in size)
    texture = 0.55 + 0.12 * noise(rng, cv2, (height, width), finest=4)
    paint(rng, cv2, texture)
    edge = int(0.05 * density)
    for inset, tone in ((2 * edge, 0.92), (edge, 0.12)):
        border = np.ones(texture.shape, bool)
        border[inset:-inset, inset:-inset] = False
        texture[border] = tone
    texture += 0.03 * noise(rng, cv2, texture.shape, finest=4)
    return np.asarray(cv2.GaussianBlur(texture, None, 0.8), np.float32)


def circles(rng: Random, cv2: Any, texture: Texture) -> None:
    """Paint rings and discs, large ones first."""
    height, width = texture.shape
    for radius in np.sort(rng.uniform(0.015, 0.16, 70))[::-1] * min(height, width):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        for share in (1.0, rng.uniform(0.5, 0.85), rng.uniform(0.15, 0.4)):
            cv2.circle(texture, centre, max(1, int(share * radius)), rng.uniform(0.05, 1.0), -1, cv2.LINE_AA)


def polygons(rng: Random, cv2: Any, texture: Texture) -> None:
    """Paint triangles and quadrilaterals, large ones first."""
    height, width = texture.shape
    for radius in np.sort(rng.uniform(0.02, 0.25, 110))[::-1] * min(height, width):
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 5)))
        corners = rng.uniform((0, 0), (width, height)) + radius * np.stack([np.cos(angles), np.sin(angles)], -1)
        cv2.fillPoly(texture, [corners.round().astype(np.int32)], rng.uniform(0.05, 1.0), cv2.LINE_AA)


def letters(rng: Random, cv2: Any, texture: Texture) -> None:
    """Set lines of random letters in several sizes on pale paper."""
    height, width = texture.shape
    ink = np.zeros(texture.shape, np.uint8)  # OpenCV writes on eight bits only
    left, baseline = int(0.1 * width), int(0.06 * height)
    while baseline < height:
        scale = rng.uniform(0.0018, 0.005) * width
        baseline += int(32 * scale)
        text = "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ23456789&"), 24))
        thickness = max(1, int(2.5 * scale))
        cv2.putText(ink, text, (left, baseline), cv2.FONT_HERSHEY_DUPLEX, scale, 255, thickness, cv2.LINE_AA)
    texture[...] = (0.3 * texture + 0.6) * (1 - ink.astype(np.float32) / 280)


PAINTERS: tuple[Painter, ...] = (circles, polygons, letters)


def windows(rng: Random, cv2: Any, size: Pair, density: float, cell: Pair) -> Texture:
    """Return rows of one window with its frame, curtain and patch of wall; only stains of 2 % tell the cells apart."""
    width, height = (int(metres * density) for metres in cell)
    one = (0.55 + 0.08 * noise(rng, cv2, (height, width), finest=4)).astype(np.float32)
    x, y = (np.round(np.array([0.2, 0.8]) * side).astype(int) for side in (width, height))
    bar = max(1, int(0.025 * width))
    curtain = (0.45 + 0.1 * noise(rng, cv2, (y[1] - y[0], x[1] - x[0]), finest=4)).astype(np.float32)
    circles(rng, cv2, curtain)
    one[y[0] - 2 * bar : y[1] + 2 * bar, x[0] - 2 * bar : x[1] + 2 * bar] = 0.95
    one[y[0] : y[1], x[0] : x[1]] = curtain
    for share in rng.uniform(0.25, 0.75, 2):
        middle = int(x[0] + share * (x[1] - x[0])), int(y[0] + share * (y[1] - y[0]))
        one[y[0] : y[1], middle[0] - bar : middle[0] + bar] = 0.15
        one[middle[1] - bar : middle[1] + bar, x[0] : x[1]] = 0.85
    columns, rows = (int(np.ceil(side / part)) for side, part in zip(size, cell, strict=True))
    texture = np.tile(one, (rows, columns))
    texture += 0.02 * noise(rng, cv2, texture.shape, finest=4)
    return np.asarray(cv2.GaussianBlur(texture, None, 0.8), np.float32)

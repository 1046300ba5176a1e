"""Stores of correspondences to and from sparse flow maps of the KITTI benchmark.

M. Menze and A. Geiger, Object scene flow for autonomous vehicles, CVPR 2015, and the development kit of KITTI 2015:
``000000_10.png``, one for each pair, of 16 bits in three channels with the size of image 1. R and G hold 64 times the
displacement in x and y plus 2^15, B is not 0 where there is one. What a store loses on the way is in the table of
:mod:`kornia_learnnorm.data.formats.interchange`.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.formats.interchange import Pair, assemble, best_of_each, files_in, new_folder, split_pairs
from kornia_learnnorm.data.images import import_cv2
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.files import atomic_write

__all__ = ["export_kitti_flow", "import_kitti_flow"]

_FIRST, _SECOND, _NAMES = "_10.png", "_11.png", "pairs.txt"


def export_kitti_flow(store: CorrespondenceStore, folder: str | Path) -> dict[str, int]:
    """Write sparse flow maps, ``000000_10.png`` and so on, and ``pairs.txt``, two names of images a line.

    A match is put at the pixel nearest to ``points1`` and keeps its displacement.

    Args:
        store: the correspondences.
        folder: where to write; made if missing.

    Returns:
        what was left out or changed, and how often; nothing else was.

    Raises:
        ValueError: if ``folder`` is a file or already holds flow maps, or an image size is not positive.
        ImportError: if OpenCV is not installed.

    """
    cv2 = import_cv2()
    for pair in split_pairs(store):
        if pair.image_size[0].min() < 1:
            width, height = pair.image_size[0]
            raise ValueError(f"{pair.names[0]}: the size of an image must be positive, got {width} x {height}")
    folder = new_folder(folder, f"*{_FIRST}")
    notes: Counter[str] = Counter()
    lines = []
    for i, pair in enumerate(split_pairs(store)):
        encoded = cv2.imencode(".png", _flow_map(pair, notes)[:, :, ::-1])[1]
        with atomic_write(folder / f"{i:06d}{_FIRST}") as beside:
            beside.write_bytes(encoded.tobytes())
        names = [re.sub(r"\s", "_", name) or "_" for name in pair.names]
        notes["names with white space or empty, written with _"] += sum(map(str.__ne__, names, pair.names))
        lines.append(" ".join(names) + "\n")
    with atomic_write(folder / _NAMES) as beside:
        beside.write_text("".join(lines), encoding="utf-8")
    return {what: count for what, count in notes.items() if count}


def _flow_map(pair: Pair, notes: Counter[str]) -> NDArray[np.uint16]:
    """Return u, v and valid (H, W, 3), and note which matches are not in it."""
    width, height = map(int, pair.image_size[0])
    points1 = pair.points1.astype(np.float64)
    pixel = np.rint(points1)
    flow = np.rint(64 * (pair.points2 - points1)) + 2**15
    inside = ((pixel >= 0) & (pixel < (width, height))).all(1)
    near = ((flow >= 0) & (flow < 2**16)).all(1)
    rows = np.flatnonzero(inside & near)
    kept = rows[best_of_each(pixel[rows] @ (1, width), pair.ratio[rows])]
    notes["matches outside image 1"] += int((~inside).sum())
    notes["matches displaced by 512 px or more"] += int((inside & ~near).sum())
    notes["matches at a pixel that a better one has"] += len(rows) - len(kept)
    x, y = pixel[kept].astype(np.intp).T
    image = np.zeros((height, width, 3), np.uint16)
    image[y, x, :2] = flow[kept]
    image[y, x, 2] = 1
    return image


def import_kitti_flow(folder: str | Path) -> CorrespondenceStore:
    """Read flow maps of the KITTI benchmark, one pair a file ``*_10.png``, as :func:`export_kitti_flow` writes them.

    Names come from ``pairs.txt`` where there is one, otherwise they are ``*_10.png`` and ``*_11.png``.

    Args:
        folder: where the files are, such as ``training/flow_occ``.

    Returns:
        the store: ``points1`` are whole pixels, ``ratio`` is 0, image 2 has the size of image 1, the rest is NaN.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it has no flow map, one is truncated or not of 16 bits in three channels, or ``pairs.txt``
            does not hold two names for each.
        ImportError: if OpenCV is not installed.

    """
    files = files_in(folder, f"*{_FIRST}")
    listed = Path(folder) / _NAMES
    names = [(path.name, path.name.removesuffix(_FIRST) + _SECOND) for path in files]
    if listed.exists():
        names = _read_names(listed, len(files))
    pairs = [_read_flow_map(path, pair) for path, pair in zip(files, names, strict=True)]
    return assemble(pairs, f"KITTI flow maps {Path(folder).resolve().name}")


def _read_names(path: Path, number: int) -> list[tuple[str, str]]:
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text of names: {error}") from error
    names = []
    for line, words in enumerate(map(str.split, text.splitlines()), 1):
        if len(words) not in (0, 2):
            raise ValueError(f"{path}, line {line}: two names expected, got {len(words)}: {' '.join(words)!r}")
        names += [(words[0], words[1])] if words else []
    if len(names) != number:
        raise ValueError(f"{path} names {len(names)} pairs, the folder has {number} flow maps")
    return names


def _read_flow_map(path: Path, names: tuple[str, str]) -> Pair:
    data = path.read_bytes()
    # Some versions of OpenCV fill the missing part of a truncated PNG with zeros and say nothing.
    image = _decode(data) if data[:4] == b"\x89PNG" and b"IEND\xaeB`\x82" in data[-64:] else None
    if image is None:
        raise ValueError(f"{path} cannot be decoded: {len(data)} bytes, not a PNG or truncated or corrupt")
    if image.dtype != np.uint16 or image.shape[2:] != (3,):
        got = f"{8 * image.itemsize} bits with shape {image.shape}"
        raise ValueError(f"{path} is not a flow map: expected 16 bits with shape (H, W, 3), got {got}")
    y, x = np.nonzero(image[:, :, 0])
    points1 = np.stack([x, y], 1).astype(np.float64)
    points2 = points1 + (image[y, x, :0:-1].astype(np.float64) - 2**15) / 64
    size = np.array([image.shape[1::-1]] * 2)
    return Pair(points1, points2, np.zeros(len(x)), size, names)


def _decode(data: bytes) -> NDArray[Any] | None:
    """Decode a PNG as it is, channels B, G, R; None where OpenCV cannot; its log stays quiet meanwhile."""
    cv2 = import_cv2()
    log = getattr(cv2.utils, "logging", cv2)  # OpenCV 5 and 4
    level = log.setLogLevel(0)
    try:
        image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        log.setLogLevel(level)
    return image

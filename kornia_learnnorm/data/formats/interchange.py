r"""Stores of correspondences to and from the formats of others: what the formats share, and what they cannot hold.

What a store loses when it is exported and imported again:

=============================  ========================  =======================  ========================
what                           KITTI flow                NG-RANSAC                hloc
=============================  ========================  =======================  ========================
``points1``                    nearest pixel             kept                     kept
``points2``                    moves with ``points1``;   kept                     kept
                               displacement to 1/64 px
``ratio``                      lost: 0                   kept                     kept, as a score 1 - ratio
matches of one point           one a pixel, the          kept                     one a keypoint of image 1,
                               smallest ratio                                     the smallest ratio
matches outside image 1        lost                      kept                     kept
matches displaced by 512 px    lost                      kept                     kept
order of the matches           by pixel                  kept                     by keypoint
order of the pairs             kept                      by number of the images  by name
``image_size``                 that of image 1, twice    kept                     kept
``names``                      kept, in ``pairs.txt``;   number of the image      kept
                               white space becomes _
``K``, ``R``, ``t``            lost: NaN                 float32                  lost: NaN
``F``                          lost: NaN                 computed from K, R, t    lost: NaN
``dataset``, ``pairs``         lost                      lost                     lost
``detector``, ``provenance``   lost                      lost                     lost
=============================  ========================  =======================  ========================

The formats are in :mod:`~kornia_learnnorm.data.formats.kitti_flow`, :mod:`~kornia_learnnorm.data.formats.ngransac` and
:mod:`~kornia_learnnorm.data.formats.hloc`. A ratio of 0 passes every ratio test. An export returns what it left out or
changed, and how often; what begins with "matches" is left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.store import CorrespondenceStore

__all__ = [
    "Pair",
    "assemble",
    "best_of_each",
    "files_in",
    "natural",
    "new_folder",
    "split_pairs",
]


class Pair(NamedTuple):
    """What a store holds of one image pair; what is not known is NaN.

    Attributes:
        points1: pixels (x, y) in image 1, (N, 2).
        points2: pixels (x, y) in image 2, (N, 2).
        ratio: Lowe's ratio, (N,).
        image_size: (width, height) of both images, (2, 2).
        names: file names of both images.
        K: cameras, (2, 3, 3).
        R: rotation of x2 = R x1 + t, (3, 3).
        t: translation of x2 = R x1 + t, metres, (3,).
        F: fundamental matrix, (3, 3).
    """

    points1: NDArray[Any]
    points2: NDArray[Any]
    ratio: NDArray[Any]
    image_size: NDArray[Any]
    names: tuple[str, str]
    K: NDArray[np.float64] = np.full((2, 3, 3), np.nan)
    R: NDArray[np.float64] = np.full((3, 3), np.nan)
    t: NDArray[np.float64] = np.full(3, np.nan)
    F: NDArray[np.float64] = np.full((3, 3), np.nan)


def split_pairs(store: CorrespondenceStore) -> Iterator[Pair]:
    """Yield the pairs of a store in their order."""
    for i, names in enumerate(store.names):
        rows = slice(int(store.offsets[i]), int(store.offsets[i + 1]))
        points = store.points1[rows], store.points2[rows], store.ratio[rows]
        yield Pair(*points, store.image_size[i], names, store.K[i], store.R[i], store.t[i], store.F[i])


def assemble(pairs: Sequence[Pair], dataset: str) -> CorrespondenceStore:
    """Make a store of at least one pair.

    Args:
        pairs: the pairs in their order.
        dataset: what the store says that the images are.

    Returns:
        the store; its ``pairs`` and ``detector`` say "not known".

    """
    return CorrespondenceStore(
        points1=np.concatenate([pair.points1 for pair in pairs]).astype(np.float32),
        points2=np.concatenate([pair.points2 for pair in pairs]).astype(np.float32),
        ratio=np.concatenate([pair.ratio for pair in pairs]).astype(np.float32),
        offsets=np.cumsum([0, *(len(pair.ratio) for pair in pairs)], dtype=np.int64),
        image_size=np.stack([pair.image_size for pair in pairs]).astype(np.int32),
        names=[pair.names for pair in pairs],
        F=np.stack([pair.F for pair in pairs]),
        K=np.stack([pair.K for pair in pairs]),
        R=np.stack([pair.R for pair in pairs]),
        t=np.stack([pair.t for pair in pairs]),
        dataset=dataset,
        pairs="not known",
        detector="not known",
    )


def best_of_each(key: NDArray[Any], ratio: NDArray[Any]) -> NDArray[np.intp]:
    """Choose one match of each key, that of the smallest ratio, the first of equal ones.

    Args:
        key: which matches exclude each other: those of equal keys, (N,).
        ratio: Lowe's ratio, (N,).

    Returns:
        indices of the matches chosen, in the order of their keys, (at most N,).

    """
    order = np.argsort(ratio, kind="stable")
    return np.asarray(order[np.unique(key[order], return_index=True)[1]], np.intp)


def files_in(folder: str | Path, pattern: str) -> list[Path]:
    """List the files of a folder, numbers in their names in the order of their values.

    Args:
        folder: where they are.
        pattern: what their names match, such as ``"*.npy"``.

    Returns:
        at least one file.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it has no such file.

    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder at {folder}")
    files = [path for path in folder.glob(pattern) if path.is_file()]
    if not files:
        raise ValueError(f"{folder} holds no file {pattern}")
    return sorted(files, key=lambda path: natural(path.name))


def natural(name: str) -> list[str | int]:
    """Split a name so that its numbers sort by value, not by digit: ``a_9`` before ``a_10``."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]


def new_folder(folder: str | Path, pattern: str) -> Path:
    """Make a folder to export to, unless it is there.

    Args:
        folder: where it is to be.
        pattern: what the names of the files to come match; those of an older export would be taken for newer ones.

    Returns:
        the folder.

    Raises:
        ValueError: if it is a file, or already holds such files.
        OSError: if it cannot be made.

    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot export to {folder}: it is a file, expected a folder")
    old = next(folder.glob(pattern), None)
    if old is not None:
        raise ValueError(f"cannot export to {folder}: it already holds {old.name}; expected a folder without {pattern}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"cannot export to {folder}: {error.strerror}") from error
    return folder

"""Stores of correspondences to and from the match files of NG-RANSAC.

E. Brachmann and C. Rother, Neural-guided RANSAC, ICCV 2019: one ``pair_I_J.npy`` for each image pair, I and J the
numbers of its images, holding an array of nine objects: points of image 1 (1, N, 2) and of image 2, ratios (1, N, 1),
``image.shape`` of both images, K of both, R (3, 3) and t (3, 1) of x2 = R x1 + t. What a store loses on the way is in
the table of :mod:`kornia_learnnorm.data.formats.interchange`.

The objects are a pickle, and a pickle of unknown origin can run anything. Here its arrays are read as the bytes that
they are; not even NumPy's own code unpickles them, since it trusts what the file says of their layout.
"""

from __future__ import annotations

import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from kornia_learnnorm.data.formats.interchange import Pair, assemble, files_in, new_folder, split_pairs
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.files import atomic_write

__all__ = ["export_ngransac", "import_ngransac"]

_PARTS = ("points 1", "points 2", "ratios", "size 1", "size 2", "K1", "K2", "R", "t")


def export_ngransac(store: CorrespondenceStore, folder: str | Path) -> dict[str, int]:
    """Write ``pair_I_J.npy`` for each pair; I and J number the images in the order in which the store names them.

    NG-RANSAC takes each file of a folder for a pair, so nothing else is written. It cannot use pairs whose K, R or t
    is NaN.

    Args:
        store: the correspondences.
        folder: where to write; made if missing.

    Returns:
        what was left out, and how often: nothing.

    Raises:
        ValueError: if ``folder`` is a file or already holds ``.npy`` files, or two pairs are of the same images.

    """
    numbers: dict[str, int] = {}
    files: dict[str, Pair] = {}
    for pair in split_pairs(store):
        first, second = (numbers.setdefault(name, len(numbers)) for name in pair.names)
        file = f"pair_{first}_{second}.npy"
        if file in files:
            raise ValueError(
                f"two pairs are of the images {pair.names}, NG-RANSAC has one file for each pair of images"
            )
        files[file] = pair
    folder = new_folder(folder, "*.npy")
    for file, pair in files.items():
        # np.save appends .npy to a name, not to an open file
        with atomic_write(folder / file) as beside, beside.open("wb") as stream:
            np.save(stream, _objects(pair), allow_pickle=True)
    return {}


def _objects(pair: Pair) -> NDArray[np.object_]:
    # NG-RANSAC multiplies K, R and t with float32, and batches the shapes of OpenCV's images: three channels.
    matches = [array.astype(np.float32)[None] for array in (pair.points1, pair.points2, pair.ratio[:, None])]
    shapes = [(int(height), int(width), 3) for width, height in pair.image_size]
    geometry = [array.astype(np.float32) for array in (*pair.K, pair.R, pair.t[:, None])]
    objects = np.empty(len(_PARTS), object)
    objects[:] = [*matches, *shapes, *geometry]
    return objects


def import_ngransac(folder: str | Path) -> CorrespondenceStore:
    """Read the match files ``*.npy`` of a folder, numbers in their names in the order of their values.

    Args:
        folder: where the files are.

    Returns:
        the store; the images of ``pair_I_J.npy`` are named I and J, those of another ``FILE.npy`` FILE-1 and FILE-2;
        F is computed from K, R and t, NaN where they are or where t is zero.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it has no ``.npy`` file, or one is truncated, asks for code to be run when it is read, or does
            not hold what a match file holds.

    """
    pairs = [_pair(path, _load(path)) for path in files_in(folder, "*.npy")]
    return assemble(pairs, f"NG-RANSAC match files {Path(folder).resolve().name}")


def _load(path: Path) -> list[NDArray[np.float64]]:
    """Return the nine arrays of a file, whatever their shapes."""
    stream = io.BytesIO(path.read_bytes())
    try:
        version = npy.read_magic(stream)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read_header(stream)
    except Exception as error:  # NumPy parses the header as Python, which fails in many ways
        raise ValueError(f"{path} is not a .npy file: {error}") from error
    if dtype != np.dtype(object) or shape != (len(_PARTS),):
        raise ValueError(f"{path} is not a match file: expected {len(_PARTS)} objects, got {dtype} of shape {shape}")
    try:
        array = _Unpickler(stream).load()
        if not isinstance(array, _Array) or not isinstance(array.data, list) or len(array.data) != len(_PARTS):
            raise ValueError(f"expected an array of {len(_PARTS)} objects")
        left = [path.stat().st_size]
        return [_numbers(item, left) for item in array.data]
    except Exception as error:  # a broken pickle can raise anything
        raise ValueError(f"{path} is not a match file, or is truncated: {error}") from error


class _Dtype:
    """What a pickle says of a dtype: ``dtype("f4", False, True)``, then its state."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = code, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1].replace("|", "=")


class _Array:
    """What a pickle says of an array, in its state, or of a scalar: ``scalar(dtype, data)``."""

    def __init__(self, *about: Any) -> None:
        self.shape, self.dtype, self.fortran, self.data = (), about[0], False, about[1]

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, self.shape, self.dtype, self.fortran, self.data = state


class _Unpickler(pickle.Unpickler):
    """Takes the parts of NumPy's arrays for stand-ins, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        asked = module.replace("numpy._core", "numpy.core"), name
        if asked == ("numpy", "dtype"):
            return _Dtype
        arrays = [("numpy", "ndarray"), *(("numpy.core.multiarray", part) for part in ("_reconstruct", "scalar"))]
        if asked in arrays:
            return _Array
        raise ValueError(f"its pickle asks for {module}.{name}, only arrays of numbers are read")


def _numbers(item: Any, left: list[int]) -> NDArray[np.float64]:
    """Turn nested lists of arrays and numbers into an array, of no more bytes than are left: lists can share parts."""
    left[0] -= len(item.data) if isinstance(item, _Array) else 1
    if left[0] < 0:
        raise ValueError("its lists hold more than the file has bytes")
    if isinstance(item, (tuple, list)):
        return np.array([_numbers(part, left) for part in item], np.float64)
    if not isinstance(item, _Array):
        return np.array(float(item))
    if not re.fullmatch("[fiu][1248]", item.dtype.code) or item.dtype.order not in tuple("<>="):
        raise ValueError(f"expected arrays of numbers, got dtype {item.dtype.code!r}")
    flat = np.frombuffer(item.data, item.dtype.order + item.dtype.code)
    return flat.reshape(item.shape, order="F" if item.fortran else "C").astype(np.float64)


def _pair(path: Path, parts: list[NDArray[np.float64]]) -> Pair:
    number = parts[0].shape[1] if parts[0].ndim == 3 else 0
    shapes = [(1, number, 2), (1, number, 2), (1, number, 1), None, None, (3, 3), (3, 3), (3, 3), (3, 1)]
    for name, part, shape in zip(_PARTS, parts, shapes, strict=True):
        if shape is not None and part.shape != shape:
            raise ValueError(f"{path}: {name} must have shape {shape}, got {part.shape}")
        if shape is None and (part.shape not in ((2,), (3,)) or not ((part >= 0) & (part < 2**31)).all()):
            raise ValueError(f"{path}: {name} must be (height, width) or (height, width, channels), got {part}")
    points1, points2, ratio, size1, size2, K1, K2, R, t = parts
    if not (np.isfinite(points1).all() and np.isfinite(points2).all()):
        raise ValueError(f"{path}: its points hold NaN or infinite pixels")
    named = re.fullmatch(r"pair_(\d+)_(\d+)", path.stem)
    names = (named[1], named[2]) if named else (f"{path.stem}-1", f"{path.stem}-2")
    sizes = np.stack([size1[1::-1], size2[1::-1]])
    try:
        F = _fundamental(K1, K2, R, t[:, 0])
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{path}: K1 or K2 is singular") from error
    return Pair(points1[0], points2[0], ratio[0, :, 0], sizes, names, np.stack([K1, K2]), R, t[:, 0], F)


def _fundamental(
    K1: NDArray[np.float64], K2: NDArray[np.float64], R: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return F = K2^-T [t]x R K1^-1 with unit norm, NaN where it is not known or not defined."""
    if not all(np.isfinite(array).all() for array in (K1, K2, R, t)) or not t.any():
        return np.full((3, 3), np.nan)
    x, y, z = t
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    F = np.linalg.solve(K2.T, cross @ R) @ np.linalg.inv(K1)
    return np.asarray(F / np.linalg.norm(F), np.float64)

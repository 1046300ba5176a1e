"""Stores of correspondences to and from the feature and match files of hloc.

P.-E. Sarlin, C. Cadena, R. Siegwart and M. Dymczyk, From coarse to fine: robust hierarchical localization at large
scale, CVPR 2019. The file of features has a group for each image, nested where its name has slashes, with
``keypoints`` (N, 2), pixels with the centre of the top left one at (0, 0), and ``image_size``, (width, height). The
file of matches has a group for each pair, ``NAME0/NAME1`` with the slashes of the names turned to ``-``, or, as older
versions wrote, ``NAME0_NAME1``, with ``matches0`` (N,), the keypoint of image 1 for each keypoint of image 0 or -1,
and ``matching_scores0`` (N,). What a store loses on the way is in the table of
:mod:`kornia_learnnorm.data.formats.interchange`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.formats.interchange import Pair, assemble, best_of_each, natural, split_pairs
from kornia_learnnorm.data.store import CorrespondenceStore, _h5py, check_declared
from kornia_learnnorm.files import atomic_write

__all__ = ["export_hloc", "import_hloc"]

# keypoints and (width, height) of an image
_Image = tuple[NDArray[Any], NDArray[Any]]


def export_hloc(store: CorrespondenceStore, features: str | Path, matches: str | Path) -> dict[str, int]:
    """Write a file of features and one of matches; an image's keypoints are its points in all its pairs, each once.

    Args:
        store: the correspondences.
        features: the HDF5 file of features to write; an existing one is replaced.
        matches: the HDF5 file of matches to write; an existing one is replaced.

    Returns:
        what was left out, and how often; nothing else was.

    Raises:
        FileNotFoundError: if a folder does not exist.
        ValueError: if the files are the same, a name is not that of a file, two images or two pairs have the same
            name, or an image has two sizes.

    """
    h5py = _h5py()
    features, matches = Path(features), Path(matches)
    if features.resolve() == matches.resolve():
        raise ValueError(f"features and matches must be two files, got {features} for both")
    pairs = list(split_pairs(store))
    _check_names(pairs)
    images, indices = _keypoints(pairs)
    dropped = 0
    with atomic_write(features) as beside, atomic_write(matches) as beside_too:
        with h5py.File(beside, "w") as file:
            for name, (keypoints, size) in images.items():
                file[f"{name}/keypoints"] = keypoints.astype(np.float32)
                file[f"{name}/image_size"] = size.astype(np.int64)
        with h5py.File(beside_too, "w") as file:
            for pair, (index1, index2) in zip(pairs, indices, strict=True):
                best = best_of_each(index1, pair.ratio)
                target = np.full(len(images[pair.names[0]][0]), -1, np.int32)
                # float64: 1 - (1 - ratio) is then the ratio again
                scores = np.zeros(len(target))
                target[index1[best]] = index2[best]
                scores[index1[best]] = 1 - pair.ratio[best].astype(np.float64)
                group = file.create_group(_key(pair.names))
                group["matches0"], group["matching_scores0"] = target, scores
                dropped += len(index1) - len(best)
    return {"matches of a keypoint that has a better one": dropped} if dropped else {}


def _dashed(name: str) -> str:
    return name.replace("/", "-")


def _key(names: tuple[str, str]) -> str:
    return "/".join(map(_dashed, names))


def _check_names(pairs: list[Pair]) -> None:
    dashed: dict[str, str] = {}
    keys: set[str] = set()
    for pair in pairs:
        for name in pair.names:
            if {"", "."} & set(name.split("/")):
                raise ValueError(f"{name!r} cannot name an image of hloc: expected a path below the images' folder")
            if dashed.setdefault(_dashed(name), name) != name:
                raise ValueError(f"hloc cannot tell the images {name!r} and {dashed[_dashed(name)]!r} apart")
        if _key(pair.names) in keys:
            raise ValueError(f"two pairs are of the images {pair.names}, hloc has one for each pair of images")
        keys.add(_key(pair.names))


def _keypoints(pairs: list[Pair]) -> tuple[dict[str, _Image], list[list[NDArray[np.intp]]]]:
    """Return the images, and for each pair and side the keypoint that each match has."""
    places: dict[str, list[tuple[int, int]]] = {}
    for i, pair in enumerate(pairs):
        for side, name in enumerate(pair.names):
            places.setdefault(name, []).append((i, side))
    images: dict[str, _Image] = {}
    indices = [[np.empty(0, np.intp)] * 2 for _ in pairs]
    for name, found in places.items():
        sizes = np.array([pairs[i].image_size[side] for i, side in found])
        if (sizes != sizes[0]).any():
            raise ValueError(f"the image {name!r} has several sizes: {np.unique(sizes, axis=0).tolist()}")
        points = [(pairs[i].points1, pairs[i].points2)[side] for i, side in found]
        unique, index = np.unique(np.concatenate(points), axis=0, return_inverse=True)
        images[name] = unique, sizes[0]
        ends = np.cumsum([len(part) for part in points])
        for (i, side), part in zip(found, np.split(index.reshape(-1), ends[:-1]), strict=True):
            indices[i][side] = part
    return images, indices


def import_hloc(features: str | Path, matches: str | Path) -> CorrespondenceStore:
    """Read the pairs of a file of matches, with the keypoints of a file of features.

    Args:
        features: HDF5 file of features; other datasets than keypoints and sizes, as descriptors, are passed over.
        matches: HDF5 file of matches.

    Returns:
        the store, pairs in the order of their names; ``ratio`` is 1 - score, 0 where there are no scores; K, R, t and
        F are NaN. hloc rounds keypoints to float16 unless told otherwise: at 1000 px that is half a pixel.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not HDF5 or truncated, lacks datasets or images, or its arrays do not fit together.

    """
    features, matches = Path(features), Path(matches)
    images = _read_features(features)
    dashed: dict[str, list[str]] = {}
    for name in images:
        dashed.setdefault(_dashed(name), []).append(name)
    pairs = []
    with _opened(matches) as file:
        for key in _groups_with_data(file):
            try:
                pairs.append(_read_pair(file[key or "/"], _names(key, dashed), images))
            except ValueError as error:
                raise ValueError(f"{matches}, {key}: {error}") from error
    if not pairs:
        raise ValueError(f"{matches} holds no pair of images")
    pairs.sort(key=lambda pair: tuple(map(natural, pair.names)))
    return assemble(pairs, f"hloc's {features.name} and {matches.name}")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no file of hloc at {path}")
    try:
        with _h5py().File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{path} is not a readable HDF5 file (truncated or of another kind): {error}") from error


def _groups_with_data(file: Any) -> list[str]:
    """Return the names of the groups that hold datasets, without outer slashes."""
    names: dict[str, None] = {}

    def visit(name: str, item: Any) -> None:
        if hasattr(item, "dtype"):
            names[name.rpartition("/")[0]] = None

    file.visititems(visit)
    return list(names)


def _read_features(path: Path) -> dict[str, _Image]:
    images = {}
    with _opened(path) as file:
        for name in _groups_with_data(file):
            keypoints, size = (_dataset(file[name or "/"], key) for key in ("keypoints", "image_size"))
            if keypoints is None or size is None:
                held = ", ".join(sorted(file[name or "/"]))
                raise ValueError(f"{path}: the image {name!r} must have keypoints and image_size, got {held}")
            if (
                keypoints.shape[1:] != (2,)
                or size.shape != (2,)
                or {keypoints.dtype.kind, size.dtype.kind} - set("fiu")
            ):
                got = f"{keypoints.dtype} {keypoints.shape} and {size.dtype} {size.shape}"
                raise ValueError(f"{path}, {name}: keypoints and image_size must be numbers (N, 2) and (2,), got {got}")
            if not np.isfinite(keypoints).all() or not ((size >= 0) & (size < 2**31)).all():
                raise ValueError(f"{path}, {name}: keypoints are NaN or infinite, or image_size is not a size: {size}")
            images[name] = keypoints, size
    return images


def _dataset(group: Any, key: str) -> NDArray[Any] | None:
    data = group.get(key)
    if not hasattr(data, "dtype"):
        return None
    check_declared(Path(group.file.filename), [data])
    return np.asarray(data[()])


def _names(key: str, dashed: Mapping[str, list[str]]) -> tuple[str, str]:
    """Find the images that the group of a pair names."""
    if "/" in key:
        splits = [key.partition("/")[::2]]
    else:
        splits = [(key[:i], key[i + 1 :]) for i, letter in enumerate(key) if letter == "_"]
    found = [(one, two) for first, second in splits for one in dashed.get(first, ()) for two in dashed.get(second, ())]
    if len(found) != 1:
        some = next(iter(dashed), "none")
        what = f"could be any of the pairs {found}" if found else f"names no two of the features' images, as {some!r}"
        raise ValueError(f"the name of the group {what}")
    return found[0]


def _read_pair(group: Any, names: tuple[str, str], images: Mapping[str, _Image]) -> Pair:
    (keypoints1, size1), (keypoints2, size2) = (images[name] for name in names)
    target, scores = _dataset(group, "matches0"), _dataset(group, "matching_scores0")
    if target is None:
        raise ValueError(f"there is no matches0, only {', '.join(sorted(group))}")
    if target.shape != (len(keypoints1),) or target.dtype.kind not in "iu":
        expected = f"integers with shape ({len(keypoints1)},), one for each keypoint of {names[0]}"
        raise ValueError(f"matches0 must be {expected}, got {target.dtype} with shape {target.shape}")
    scores = np.ones(len(target)) if scores is None else scores
    if scores.shape != target.shape:
        raise ValueError(f"matching_scores0 must have shape {target.shape}, as matches0, got {scores.shape}")
    if ((target < -1) | (target >= len(keypoints2))).any():
        held = f"{target.min()} to {target.max()}"
        raise ValueError(f"matches0 must be -1 to {len(keypoints2) - 1}, the keypoints of {names[1]}, got {held}")
    index1 = np.flatnonzero(target >= 0)
    index2 = target[index1]
    ratio = 1 - scores[index1].astype(np.float64)
    return Pair(keypoints1[index1], keypoints2[index2], ratio, np.stack([size1, size2]), names)

"""Stores of correspondences to and from the feature and match files of hloc.

P.-E. Sarlin, C. Cadena, R. Siegwart and M. Dymczyk, From coarse to fine: robust hierarchical localization at large
scale, CVPR 2019. The file of features has a group for each image, nested where the image's name has slashes, with
``keypoints`` (N, 2), pixels with the centre of the top left one at (0, 0), and ``image_size``, (width, height). The
file of matches has a group for each pair, ``NAME0/NAME1`` with the slashes of the names replaced by ``-``, or
``NAME0_NAME1`` in older versions of hloc, with ``matches0`` (N,), the keypoint of image 1 for each keypoint of image 0
or -1, and ``matching_scores0`` (N,).

The files keep points, names, image sizes and, as the score 1 - ratio, ratios. They hold one match for each keypoint of
image 0, so of several matches of one point the one with the smallest ratio is kept. They have no place for the order of
matches and pairs, for ground truth, and for the texts of a store.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.store import LAYOUT, CorrespondenceStore, open_hdf5, own_dataset
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.optional import import_extra

__all__ = ["export_hloc", "import_hloc"]


class _Image(NamedTuple):
    """An image's keypoints (N, 2), pixels, and its (width, height) (2,)."""

    keypoints: NDArray[Any]
    size: NDArray[Any]


class _Pair(NamedTuple):
    """A pair of images: names, points in both (N, 2), Lowe's ratio (N,) and both sizes (2, 2)."""

    names: tuple[str, str]
    points1: NDArray[Any]
    points2: NDArray[Any]
    ratio: NDArray[np.float64]
    image_size: NDArray[Any]


def export_hloc(store: CorrespondenceStore, features: str | Path, matches: str | Path) -> int:
    """Write a file of features and a file of matches; the keypoints of an image are its distinct points in all pairs.

    Args:
        store: the correspondences.
        features: the HDF5 file of features to write; an existing one is replaced.
        matches: the HDF5 file of matches to write; an existing one is replaced.

    Returns:
        how many matches were left out, because another match of the same keypoint of image 0 has a smaller ratio.

    Raises:
        FileNotFoundError: if a folder does not exist.
        ValueError: if both files are the same, a name cannot name a file, two images or two pairs have the same
            name, or an image has two sizes.

    """
    h5py = import_extra("h5py", "images", "writing hloc's files")
    features, matches = Path(features), Path(matches)
    if features.resolve() == matches.resolve():
        raise ValueError(f"features and matches must be two files, got {features} for both")
    _check_names(store.names)
    images, indices = _keypoints(store)
    dropped = 0
    with atomic_write(features) as features_file, atomic_write(matches) as matches_file:
        with h5py.File(features_file, "w") as file:
            for name, image in images.items():
                file[f"{name}/keypoints"] = image.keypoints.astype(np.float32)
                file[f"{name}/image_size"] = image.size.astype(np.int64)
        with h5py.File(matches_file, "w") as file:
            for i, (index1, index2) in enumerate(indices):
                ratio = store.matches(i)[2]
                order = np.argsort(ratio, kind="stable")
                best = order[np.unique(index1[order], return_index=True)[1]]
                target = np.full(len(images[store.names[i][0]].keypoints), -1, np.int32)
                scores = np.zeros(len(target))  # float64, so that 1 - (1 - ratio) is the ratio
                target[index1[best]] = index2[best]
                scores[index1[best]] = 1 - ratio[best].astype(np.float64)
                group = file.create_group(_key(store.names[i]))
                group["matches0"], group["matching_scores0"] = target, scores
                dropped += len(index1) - len(best)
    return dropped


def _dashed(name: str) -> str:
    return name.replace("/", "-")


def _key(names: tuple[str, str]) -> str:
    return "/".join(map(_dashed, names))


def _check_names(pairs: list[tuple[str, str]]) -> None:
    dashed: dict[str, str] = {}
    keys: set[str] = set()
    for names in pairs:
        for name in names:
            if {"", "."} & set(name.split("/")):
                raise ValueError(f"{name!r} cannot name an image of hloc: expected a path below the images' folder")
            if dashed.setdefault(_dashed(name), name) != name:
                raise ValueError(f"hloc cannot tell the images {name!r} and {dashed[_dashed(name)]!r} apart")
        if _key(names) in keys:
            raise ValueError(f"two pairs are of the images {names}, hloc has one for each pair of images")
        keys.add(_key(names))


def _keypoints(store: CorrespondenceStore) -> tuple[dict[str, _Image], list[list[NDArray[np.intp]]]]:
    """Return the images, and for each pair and side the keypoint of each match."""
    places: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
    for i, names in enumerate(store.names):
        for side, name in enumerate(names):
            places[name].append((i, side))
    images: dict[str, _Image] = {}
    indices = [[np.empty(0, np.intp)] * 2 for _ in store.names]
    for name, found in places.items():
        sizes = np.array([store.image_size[place] for place in found])
        if (sizes != sizes[0]).any():
            raise ValueError(f"the image {name!r} has several sizes: {np.unique(sizes, axis=0).tolist()}")
        points = [store.matches(i)[side] for i, side in found]
        unique, index = np.unique(np.concatenate(points), axis=0, return_inverse=True)
        images[name] = _Image(unique, sizes[0])
        ends = np.cumsum([len(part) for part in points])
        for (i, side), part in zip(found, np.split(index.reshape(-1), ends[:-1]), strict=True):
            indices[i][side] = part
    return images, indices


def import_hloc(features: str | Path, matches: str | Path) -> CorrespondenceStore:
    """Return a store of the pairs in a file of matches, with the keypoints of a file of features.

    Args:
        features: HDF5 file of features; datasets other than keypoints and sizes are ignored.
        matches: HDF5 file of matches.

    Returns:
        the store, pairs sorted by name with numbers in names by value; ``ratio`` is 1 - score, 0 where there are no
        scores; K, R, t and F are NaN. hloc rounds keypoints to float16 by default: at 1000 px that is half a pixel.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not HDF5 or truncated, lacks datasets or images, or its arrays do not fit together.

    """
    features, matches = Path(features), Path(matches)
    for path in (features, matches):
        if not path.is_file():
            raise FileNotFoundError(f"no file of hloc at {path}")
    images = _read_features(features)
    dashed: defaultdict[str, list[str]] = defaultdict(list)
    for name in images:
        dashed[_dashed(name)].append(name)
    pairs = []
    with open_hdf5(matches) as file:
        for key in _groups_with_data(file):
            try:
                pairs.append(_read_pair(file[key or "/"], _names(key, dashed), images))
            except ValueError as error:
                raise ValueError(f"{matches}, {key}: {error}") from error
    if not pairs:
        raise ValueError(f"{matches} holds no pair of images, expected one group for each pair")
    pairs.sort(key=lambda pair: [_sort_key(name) for name in pair.names])
    return _store(pairs, f"hloc's {features.name} and {matches.name}")


def _sort_key(name: str) -> list[str | int]:
    """Split a name so that its numbers sort by value: ``a_9`` before ``a_10``."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]


def _store(pairs: list[_Pair], dataset: str) -> CorrespondenceStore:
    unknown: dict[str, Any] = {name: np.full((len(pairs), *LAYOUT[name][0]), np.nan) for name in "FKRt"}
    return CorrespondenceStore(
        points1=np.concatenate([pair.points1 for pair in pairs]).astype(np.float32),
        points2=np.concatenate([pair.points2 for pair in pairs]).astype(np.float32),
        ratio=np.concatenate([pair.ratio for pair in pairs]).astype(np.float32),
        offsets=np.cumsum([0, *(len(pair.ratio) for pair in pairs)], dtype=np.int64),
        image_size=np.stack([pair.image_size for pair in pairs]).astype(np.int32),
        names=[pair.names for pair in pairs],
        **unknown,
        dataset=dataset,
        pairs="not known",
        detector="not known",
    )


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
    with open_hdf5(path) as file:
        for name in _groups_with_data(file):
            keypoints, size = (_dataset(file[name or "/"], key) for key in ("keypoints", "image_size"))
            if keypoints is None or size is None:
                held = ", ".join(sorted(file[name or "/"]))
                raise ValueError(f"{path}: the image {name!r} must have keypoints and image_size, got {held}")
            kinds = {keypoints.dtype.kind, size.dtype.kind}
            if keypoints.shape[1:] != (2,) or size.shape != (2,) or kinds - set("fiu"):
                got = f"{keypoints.dtype} {keypoints.shape} and {size.dtype} {size.shape}"
                raise ValueError(f"{path}, {name}: keypoints and image_size must be numbers (N, 2) and (2,), got {got}")
            if not np.isfinite(keypoints).all() or not ((size >= 0) & (size < 2**31)).all():
                raise ValueError(f"{path}, {name}: keypoints are NaN or infinite, or image_size is not a size: {size}")
            images[name] = _Image(keypoints, size)
    return images


def _dataset(group: Any, key: str) -> NDArray[Any] | None:
    """Return the values of a dataset of a group; None where there is none."""
    data = own_dataset(group, key)
    return None if data is None else np.asarray(data[()])


def _names(key: str, dashed: Mapping[str, list[str]]) -> tuple[str, str]:
    """Return the names of the two images that the group of a pair names."""
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


def _read_pair(group: Any, names: tuple[str, str], images: Mapping[str, _Image]) -> _Pair:
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
    return _Pair(names, keypoints1[index1], keypoints2[index2], ratio, np.stack([size1, size2]))

"""Reading the features and matches of hloc (P.-E. Sarlin et al., From coarse to fine, CVPR 2019) into a store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.store import LAYOUT, CorrespondenceStore, open_hdf5, own_dataset

__all__ = ["read_hloc"]


def read_hloc(features: str | Path, matches: str | Path) -> CorrespondenceStore:
    """Return a store of the pairs in hloc's file of matches, with the keypoints of its file of features.

    A group of the features is an image with ``keypoints`` (N, 2), pixels, and ``image_size``. A group of the matches is
    a pair, ``NAME0/NAME1`` with ``-`` for the slashes in names, with ``matches0`` (N,), an index or -1 for each
    keypoint of image 0, and ``matching_scores0`` (N,). hloc rounds keypoints to float16 by default: at 1000 px that is
    half a pixel.

    Returns:
        the store, in the order of the file; ``ratio`` is 1 - score; K, R, t and F are NaN.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not HDF5, holds no pair, or lacks the image or a dataset of a pair.

    """
    pairs: list[dict[str, Any]] = []
    for path in map(Path, (features, matches)):
        if not path.is_file():
            raise FileNotFoundError(f"no file of hloc at {path}")
    with open_hdf5(Path(features)) as images, open_hdf5(Path(matches)) as file:
        found: list[str] = []
        images.visit(found.append)
        names = {name.replace("/", "-"): name for name in (item.rpartition("/")[0] for item in found) if name}
        for dashed1, group in file.items():
            for dashed2, pair in group.items():
                missing = {dashed1, dashed2} - names.keys()
                if missing:
                    raise ValueError(f"{matches} has the pair {dashed1}/{dashed2}, {features} no image {missing.pop()}")
                (keys1, size1), (keys2, size2) = (
                    [_values(images[names[dashed]], name) for name in ("keypoints", "image_size")]
                    for dashed in (dashed1, dashed2)
                )
                target, scores = (_values(pair, name) for name in ("matches0", "matching_scores0"))
                if len(target) != len(keys1) or not ((target >= -1) & (target < len(keys2))).all():
                    expected = f"{len(keys1)} integers from -1 to {len(keys2) - 1}"
                    raise ValueError(f"{matches}, {dashed1}/{dashed2}: matches0 must be {expected}, got {target}")
                index = np.flatnonzero(target >= 0)
                points = {"points1": keys1[index], "points2": keys2[target[index]]}
                ratio, pair_names = 1 - scores[index].astype(np.float64), (names[dashed1], names[dashed2])
                pairs.append({**points, "ratio": ratio, "image_size": [[size1, size2]], "names": pair_names})
    if not pairs:
        raise ValueError(f"{matches} holds no pair of images, expected a group for each pair")
    known: dict[str, Any] = {
        name: np.concatenate([pair[name] for pair in pairs]).astype(LAYOUT[name][1])
        for name in ("points1", "points2", "ratio", "image_size")
    }
    unknown: dict[str, Any] = {name: np.full((len(pairs), *LAYOUT[name][0]), np.nan) for name in "FKRt"}
    return CorrespondenceStore(
        **known,
        **unknown,
        offsets=np.cumsum([0, *(len(pair["ratio"]) for pair in pairs)], dtype=np.int64),
        names=[pair["names"] for pair in pairs],
        dataset=f"hloc's {Path(features).name} and {Path(matches).name}",
        pairs="not known",
        detector="not known",
    )


def _values(group: Any, name: str) -> NDArray[Any]:
    """Return the values of a dataset that the file itself holds; ValueError for none."""
    data = own_dataset(group, name)
    if data is None:
        raise ValueError(f"{group.file.filename}, {group.name} has no dataset {name}")
    return np.asarray(data[()])

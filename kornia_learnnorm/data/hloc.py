"""Reading the features and matches of hloc (P.-E. Sarlin et al., From coarse to fine, CVPR 2019) into a store."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from kornia_learnnorm.data.store import LAYOUT, CorrespondenceStore, open_hdf5, own_dataset


def read_hloc(features: str | Path, matches: str | Path) -> CorrespondenceStore:
    """Return a store of the pairs in hloc's file of matches, with the keypoints of its file of features.

    The former has ``matches0``, an index or -1 for each keypoint of image 0, and ``matching_scores0``, the latter
    ``keypoints`` (N, 2), pixels, and ``image_size``. The ratio, K, R, t and F are NaN. FileNotFoundError if a file is
    missing; ValueError if it is not HDF5, holds no pair, or lacks data of a pair.
    """

    def values(group: Any, name: str) -> Any:
        data = own_dataset(group, name)
        if data is None:
            raise ValueError(f"{group.file.filename}, {group.name} has no dataset {name}")
        return data[()]

    for path in map(Path, (features, matches)):
        if not path.is_file():
            raise FileNotFoundError(f"no file of hloc at {path}")
    arrays: defaultdict[str, list[Any]] = defaultdict(list)
    names: list[tuple[str, str]] = []
    with open_hdf5(Path(features)) as images, open_hdf5(Path(matches)) as file:
        found: list[str] = []
        images.visit(found.append)
        dashed = {name.replace("/", "-"): name for name in (item.rpartition("/")[0] for item in found)}
        for key1, key2 in [(one, two) for one in file for two in file[one]]:
            if missing := {key1, key2} - dashed.keys():
                raise ValueError(f"{matches} has the pair {key1}/{key2}, {features} no image {missing.pop()}")
            names.append((dashed[key1], dashed[key2]))
            keypoints1, keypoints2 = (values(images[name], "keypoints") for name in names[-1])
            target, scores = (values(file[key1][key2], name) for name in ("matches0", "matching_scores0"))
            if len(target) != len(keypoints1) or not ((target >= -1) & (target < len(keypoints2))).all():
                expected = f"{len(keypoints1)} integers from -1 to {len(keypoints2) - 1}"
                raise ValueError(f"{matches}, {key1}/{key2}: matches0 must be {expected}, got {target}")
            arrays["points1"].append(keypoints1[target >= 0])
            arrays["points2"].append(keypoints2[target[target >= 0]])
            arrays["score"].append(scores[target >= 0].astype(np.float64))
            arrays["ratio"].append(np.full(len(arrays["score"][-1]), np.nan))
            arrays["image_size"].append([[values(images[name], "image_size") for name in names[-1]]])
    if not names:
        raise ValueError(f"{matches} holds no pair of images, expected a group for each pair")
    known: dict[str, Any] = {name: np.concatenate(parts).astype(LAYOUT[name][1]) for name, parts in arrays.items()}
    unknown: dict[str, Any] = {name: np.full((len(names), *LAYOUT[name][0]), np.nan) for name in "FKRt"}
    offsets = np.cumsum([0, *map(len, arrays["ratio"])], dtype=np.int64)
    about: dict[str, Any] = {"dataset": f"hloc's {Path(features).name} and {Path(matches).name}", "pairs": "not known"}
    return CorrespondenceStore(**known, **unknown, **about, offsets=offsets, names=names, detector="not known")

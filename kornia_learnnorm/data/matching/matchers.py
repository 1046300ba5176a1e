"""Matching the features of two images: nearest neighbours with Lowe's ratio, or LightGlue."""

from typing import NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.feature import LightGlue, get_laf_orientation, get_laf_scale
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.images import Pixels, import_cv2
from kornia_learnnorm.data.matching.features import DETECTORS, Features, detect_sift, pretrained
from kornia_learnnorm.geometry.distinct_points import distinct_points

__all__ = ["Matches", "match_both_ways", "match_images", "match_lightglue", "match_nearest", "one_to_one"]

MATCHERS = ("nearest", "lightglue")  # names on the command line
# What Kornia calls the features of a detector for which it has weights of LightGlue.
LIGHTGLUE = {
    "rootsift": "sift",
    "aliked": "aliked",
    "disk": "disk",
    "xfeat": "xfeat",  # LighterGlue, a smaller network
    "keynet": "keynet_affnet_hardnet",
}


class Matches(NamedTuple):
    """Correspondences of two images, one row per match."""

    points1: Tensor  # pixels (x, y) in image 1, (N, 2), float32
    points2: Tensor  # pixels of their matches in image 2, (N, 2), float32
    # Distance of the nearest over that of the second-nearest descriptor, in [0, 1], (N,), float32. A small ratio is a
    # distinctive match (D. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004, section 7.1).
    ratio: Tensor


def match_nearest(features1: Features, features2: Features) -> Matches:
    """Match each feature of image 1 to its nearest neighbour in image 2, by brute force.

    All matches are returned: keep ``ratio < 0.8`` for Lowe's ratio test. Several may share a feature of image 2. An
    image of fewer than two features, as a blank one, is a ValueError.
    """
    return _nearest(features1, features2)[0]


def match_both_ways(features1: Features, features2: Features) -> tuple[Matches, Tensor]:
    """Return the matches of :func:`match_nearest` and their ratios in the other direction, (N,).

    The latter is 1 where the feature of image 1 is not the nearest neighbour of its match among those of image 1.
    """
    (matches, index2), (back, index1) = _nearest(features1, features2), _nearest(features2, features1)
    mutual = torch.from_numpy(index1[index2] == np.arange(len(index2)))
    return matches, torch.where(mutual, back.ratio[index2], 1.0)


def _nearest(features1: Features, features2: Features) -> tuple[Matches, NDArray[np.int64]]:
    """Return the nearest neighbours of features of image 1, and their indices among those of image 2, (N,)."""
    _check(features1, features2)
    descriptors1, descriptors2 = (features.descriptors.astype(np.float32) for features in (features1, features2))
    pairs = import_cv2().BFMatcher().knnMatch(descriptors1, descriptors2, k=2)
    index2 = np.array([nearest.trainIdx for nearest, _ in pairs])
    distances = torch.tensor([[nearest.distance, second.distance] for nearest, second in pairs])
    # two neighbours at distance zero are a tie, ratio 1
    ratio = torch.where(distances[:, 1] > 0, distances[:, 0] / distances[:, 1], 1.0)
    return Matches(torch.from_numpy(features1.points), torch.from_numpy(features2.points[index2]), ratio), index2


def match_lightglue(features1: Features, features2: Features, detector: str = "disk") -> tuple[Tensor, Tensor, Tensor]:
    """Return the matches of a detector's features by Kornia's LightGlue for it (P. Lindenberger et al., ICCV 2023).

    They are points in both images, (N, 2), and LightGlue's probability of the match, above 0.1, (N,). An image of fewer
    than two features, a detector without weights, or descriptors of another one are a ValueError; weights that cannot
    be loaded an OSError.
    """
    _check(features1, features2)
    check_methods(detector, "lightglue")
    columns = LightGlue.features[LIGHTGLUE[detector]]["input_dim"]
    for features in (features1, features2):
        if features.descriptors.dtype != np.float32 or features.descriptors.shape[1] != columns:
            got = f"{features.descriptors.dtype} with {features.descriptors.shape[1]} columns"
            raise ValueError(f"LightGlue of {detector} needs descriptors of float32 with {columns} columns, got {got}")
    with torch.inference_mode():
        network = pretrained(f"LightGlue for {detector}", LightGlue, LIGHTGLUE[detector])
        found = network({"image0": _lightglue_input(features1), "image1": _lightglue_input(features2)})
    index1, index2 = found["matches"][0].numpy().T
    points1, points2 = torch.from_numpy(features1.points[index1]), torch.from_numpy(features2.points[index2])
    return points1, points2, found["scores"][0].clamp(0.0, 1.0).float().clone()


def check_methods(detector: str, matcher: str) -> None:
    """Raise ValueError for an unknown detector or matcher, or two that do not go together."""
    for name, given, known in (("detector", detector, DETECTORS), ("matcher", matcher, MATCHERS)):
        if given not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {given!r}")
    if matcher == "lightglue" and detector not in LIGHTGLUE:
        raise ValueError(f"matcher lightglue needs detector {', '.join(LIGHTGLUE)}, got {detector}")


def match_images(image1: Pixels, image2: Pixels, num_features: int = 4000) -> Matches:
    """Match the SIFT features of image 1 to their nearest neighbours in image 2, as many as image 1 has features.

    Errors are those of :func:`~kornia_learnnorm.data.matching.features.detect_sift` and :func:`match_nearest`.
    """
    return match_nearest(detect_sift(image1, num_features), detect_sift(image2, num_features))


def one_to_one(points1: Tensor, points2: Tensor, ratio: Tensor) -> Tensor:
    """Return the indices, int64, of matches (N, 2), (N, 2), (N,) that share no point, sorted by ratio.

    A match is dropped if it shares a pixel, in image 1 or in image 2, with a kept match of a smaller ratio (or another
    cost). Coordinates decide between equal ratios, so the order of the matches has no effect on which are kept.
    """
    KORNIA_CHECK_SHAPE(points1, ["N", "2"])
    KORNIA_CHECK_SHAPE(points2, [str(len(points1)), "2"])
    KORNIA_CHECK_SHAPE(ratio, [str(len(points1))])
    rows = torch.cat([points1, points2, ratio[:, None]], -1).detach().double().cpu().numpy()
    order = torch.from_numpy(np.lexsort(rows.T))  # by ratio
    return order[distinct_points(points1[order], points2[order])]


def _check(features1: Features, features2: Features) -> None:
    for number, features in enumerate((features1, features2), 1):
        if (found := len(features.points)) < 2:
            raise ValueError(f"image {number} is blank or nearly so: {found} features, expected 2 or more")
    columns1, columns2 = (features.descriptors.shape[1] for features in (features1, features2))
    if columns1 != columns2:
        raise ValueError(f"descriptors of the same length expected, got {columns1} and {columns2} columns")


def _lightglue_input(features: Features) -> dict[str, Tensor]:
    side = {
        "keypoints": torch.from_numpy(features.points)[None],
        "descriptors": torch.from_numpy(features.descriptors)[None],
        "image_size": torch.tensor([features.size], dtype=torch.float32),
    }
    if features.lafs is not None:
        lafs = torch.from_numpy(features.lafs)[None]
        # SIFT's weights expect COLMAP's orientations, clockwise from x to y.
        side |= {"lafs": lafs, "scales": get_laf_scale(lafs).flatten(1)}
        side["oris"] = -torch.deg2rad(get_laf_orientation(lafs).flatten(1))
    return side

"""Local features of an image: OpenCV's SIFT (extra ``images``) and Kornia's learned detectors, by :mod:`torch.hub`."""

import sys
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import lru_cache
from io import StringIO
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.feature import ALIKED, DISK, KeyNetAffNetHardNet, XFeat, laf_from_center_scale_ori
from numpy.typing import NDArray

from kornia_learnnorm.data.images import Pixels, check_grey, import_cv2

SIFT_OFFSET = 0.25  # pixels; OpenCV's keypoints are this far to the right and down of what they are found on
MASK_MARGIN = 8  # pixels along each axis; a feature nearer to a masked pixel is of the mask's edge


class MissingWeightsError(OSError):
    """Weights of a network of Kornia are not in the cache and could not be downloaded."""


class Features(NamedTuple):
    """Features of one image."""

    points: NDArray[np.float32]  # pixels (x, y), (N, 2)
    descriptors: NDArray[Any]  # one row a feature, (N, D), compared by their Euclidean distance
    size: tuple[int, int]  # (width, height) of the image, pixels
    # Kornia's local affine frames, pixels, (N, 2, 3); None of a detector that finds points without scale and shape
    lafs: NDArray[np.float32] | None = None


def detect_sift(image: Pixels, num_features: int = 4000) -> Features:
    """Return the strongest SIFT features, with those that tie with the weakest; descriptors uint8, 128 columns.

    ``image`` has grey values :math:`(H, W)`, uint8; TypeError or ValueError for others, or if ``num_features`` is below
    2. A pixel has several features where its keypoint has several orientations (D. Lowe, IJCV 2004). The scale of a
    frame is the standard deviation of the blur in which the keypoint was found.
    """
    _check(image, num_features)
    keypoints, descriptors = import_cv2().SIFT_create(num_features).detectAndCompute(image, None)
    found = torch.tensor([(*keypoint.pt, keypoint.size / 2, -keypoint.angle) for keypoint in keypoints]).view(1, -1, 4)
    found[..., :2] -= SIFT_OFFSET
    lafs = laf_from_center_scale_ori(found[..., :2], found[..., 2, None, None], found[..., 3:])[0].numpy()
    # OpenCV's descriptors are whole numbers up to 255 in float32.
    rows = np.zeros((0, 128), np.uint8) if descriptors is None else descriptors.astype(np.uint8)
    return Features(found[0, :, :2].numpy(), rows, (image.shape[1], image.shape[0]), lafs)


def detect_rootsift(image: Pixels, num_features: int = 4000) -> Features:
    """Return :func:`detect_sift` with RootSIFT descriptors, float32 (R. Arandjelovic and A. Zisserman, CVPR 2012)."""
    features = detect_sift(image, num_features)
    rows = features.descriptors.astype(np.float32)
    return features._replace(descriptors=np.sqrt(rows / np.maximum(rows.sum(1, keepdims=True), 1.0)))


def detect_aliked(image: Pixels, num_features: int = 4000) -> Features:
    """Return the features of Kornia's ALIKED, n16 (X. Zhao et al., IEEE TIM 2023), 128 columns of float32.

    ``image`` has grey values :math:`(H, W)` or colours :math:`(H, W, 3)`, uint8. Errors are those of
    :func:`detect_sift`, and OSError if the weights cannot be loaded.
    """
    _check(image, num_features, colour=True)
    with torch.inference_mode():
        found = pretrained("ALIKED", ALIKED.from_pretrained, "aliked-n16", num_features)(_tensor(image))[0]
    return _features(image, found.keypoints, found.descriptors)


def detect_disk(image: Pixels, num_features: int = 4000) -> Features:
    """Return the features of Kornia's DISK (M. Tyszkiewicz et al., NeurIPS 2020); as :func:`detect_aliked`."""
    _check(image, num_features, colour=True)
    with torch.inference_mode():
        disk = pretrained("DISK", DISK.from_pretrained)
        found = disk(_tensor(image).expand(-1, 3, -1, -1), num_features, pad_if_not_divisible=True)[0]
    return _features(image, found.keypoints, found.descriptors)


def detect_xfeat(image: Pixels, num_features: int = 4000) -> Features:
    """Return the features of Kornia's XFeat (G. Potje et al., CVPR 2024), 64 columns; as :func:`detect_aliked`."""
    _check(image, num_features, colour=True)
    found = pretrained("XFeat", XFeat.from_pretrained).detectAndCompute(_tensor(image), num_features)[0]
    return _features(image, found["keypoints"], found["descriptors"])


def detect_keynet(image: Pixels, num_features: int = 4000) -> Features:
    """Return the features of Kornia's KeyNet, AffNet and HardNet of a grey image; otherwise as :func:`detect_aliked`.

    A. Barroso-Laguna et al., ICCV 2019; D. Mishkin et al., ECCV 2018; A. Mishchuk et al., NIPS 2017.
    """
    _check(image, num_features)
    with torch.inference_mode():
        network = pretrained("KeyNet, AffNet and HardNet", KeyNetAffNetHardNet, num_features)
        frames, _, descriptors = network(_tensor(image))
    found = frames[0].flatten(1).any(1)  # Kornia pads with zeros
    lafs = frames[0, found].float()
    return _features(image, lafs[:, :, 2], descriptors[0, found].float())._replace(lafs=lafs.numpy())


def keep_features(features: Features, mask: NDArray[np.bool_]) -> Features:
    """Return the features whose pixels count and are more than 8 rows or columns away from those that do not.

    ``mask`` is true for the pixels that count, (H, W) bool; TypeError or ValueError for other arrays.
    """
    check_mask(mask, features.size)
    width, height = features.size
    inner = import_cv2().erode(mask.astype(np.uint8), np.ones([2 * MASK_MARGIN + 1] * 2, np.uint8)) > 0
    x, y = np.rint(features.points).astype(int).clip(0, (width - 1, height - 1)).T
    kept = inner[y, x]
    lafs = None if features.lafs is None else features.lafs[kept]
    return features._replace(points=features.points[kept], descriptors=features.descriptors[kept], lafs=lafs)


def check_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> None:
    """Raise TypeError or ValueError unless a mask is an array of bool with the (width, height) of its image."""
    if not isinstance(mask, np.ndarray) or mask.dtype != bool:
        raise TypeError(f"a mask must be an array of bool, got {getattr(mask, 'dtype', type(mask))}")
    if mask.shape != size[::-1]:
        raise ValueError(f"a mask must have the shape of its image, {size[::-1]}, got {mask.shape}")


# names on the command line
DETECTORS: dict[str, Callable[[Pixels, int], Features]] = {
    "sift": detect_sift,
    "rootsift": detect_rootsift,
    "aliked": detect_aliked,
    "disk": detect_disk,
    "xfeat": detect_xfeat,
    "keynet": detect_keynet,
}
READS_COLOUR = ("aliked", "disk", "xfeat")  # names of those that take colours


class _ErrorsOnly(StringIO):
    """Standard error without the lines of downloads that begin: Kornia prints one for each address and attempt."""

    def __init__(self) -> None:
        super().__init__()
        self.stream = sys.stderr

    def write(self, text: str) -> int:
        return len(text) if text.startswith("Downloading:") else self.stream.write(text)


@lru_cache(maxsize=2)  # a detector and a matcher
def pretrained(name: str, load: Callable[..., Any], *args: Any) -> Any:
    """Return the network of Kornia that ``load(*args)`` makes; MissingWeightsError if its weights cannot be loaded."""
    try:
        # a warning for each attempt to download
        with warnings.catch_warnings(action="ignore", category=UserWarning), redirect_stderr(_ErrorsOnly()):
            return load(*args)
    except (OSError, RuntimeError, EOFError, UnpicklingError) as error:  # the last two: a truncated file in the cache
        get = "run the command once with access to the internet, or save the file of the address as the path"
        folder = f"{torch.hub.get_dir()}/checkpoints"
        text = f"the weights of {name} are not in {folder} and could not be loaded: {error} ({get})"
        raise MissingWeightsError(text) from error


def _features(image: Pixels, points: torch.Tensor, descriptors: torch.Tensor) -> Features:
    return Features(points.float().numpy(), descriptors.numpy(), (image.shape[1], image.shape[0]))


def _tensor(image: Pixels) -> torch.Tensor:
    """Return grey values or colours in [0, 1], (1, C, H, W)."""
    return torch.from_numpy(np.atleast_3d(image)).permute(2, 0, 1)[None].float() / 255.0


def _check(image: Pixels, num_features: int, colour: bool = False) -> None:
    check_grey(image, colour)
    if num_features < 2:
        raise ValueError(f"num_features must be at least 2, got {num_features}")

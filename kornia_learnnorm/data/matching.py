"""Reading grey images and matching them: SIFT features, nearest neighbours, Lowe's ratio.

OpenCV does the work. It comes with the ``images`` extra and is imported only when a function here is called.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

__all__ = ["Matches", "import_cv2", "match_images", "read_image"]


class Matches(NamedTuple):
    """Correspondences of two images, one row per feature of image 1.

    Attributes:
        points1: pixels ``(x, y)`` in image 1 with shape :math:`(N, 2)`, float32.
        points2: pixels of the nearest neighbours in image 2 with shape :math:`(N, 2)`, float32.
        ratio: distance of the nearest over that of the second-nearest descriptor with shape :math:`(N,)`, float32, in
            :math:`[0, 1]`; small is distinctive (D. Lowe, Distinctive image features from scale-invariant keypoints,
            IJCV 2004, section 7.1).

    """

    points1: Tensor
    points2: Tensor
    ratio: Tensor


def import_cv2() -> ModuleType:
    """Return the module ``cv2``.

    Raises:
        ImportError: if OpenCV is not installed; the message names the extra that brings it.

    """
    try:
        import cv2
    except ImportError as error:
        message = "reading and matching images needs OpenCV: pip install 'kornia-learnnorm[images]'"
        raise ImportError(message) from error
    return cv2


def read_image(path: str | Path) -> npt.NDArray[np.uint8]:
    """Read an image file as grey values; colours and deeper pixels are converted.

    Args:
        path: a file in any format that OpenCV decodes.

    Returns:
        grey values with shape :math:`(H, W)`, uint8.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, not an image, or a truncated or corrupt image.
        ImportError: if OpenCV is not installed.

    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"image {path} does not exist")
    if path.is_dir():
        raise ValueError(f"image {path} is a folder, expected an image file")
    data = path.read_bytes()
    if not data:
        raise ValueError(f"image {path} is empty (0 bytes)")
    image = _decode(data) if _jpeg_ends(data) else None
    if image is None:
        raise ValueError(f"image {path} cannot be decoded: {len(data)} bytes, not an image or truncated or corrupt")
    return image


def _decode(data: bytes) -> npt.NDArray[np.uint8] | None:
    """Decode a file's bytes to grey values, None where OpenCV cannot; its log stays quiet meanwhile."""
    cv2 = import_cv2()
    log = getattr(cv2.utils, "logging", cv2)  # OpenCV 5 and 4
    level = log.setLogLevel(0)
    try:
        image: npt.NDArray[np.uint8] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    finally:
        log.setLogLevel(level)
    return image


def _jpeg_ends(data: bytes) -> bool:
    """Tell whether a JPEG has its end marker after its pixels; True for other formats.

    OpenCV 4 fills the missing part of a truncated JPEG with grey and says nothing.
    """
    if data[:2] != b"\xff\xd8":
        return True
    position = 2
    while data[position : position + 1] == b"\xff" and data[position + 1 : position + 2] != b"\xda":
        filler = data[position + 1 : position + 2] == b"\xff"
        position += 1 if filler else 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return b"\xff\xd9" in data[position:]


def match_images(image1: npt.NDArray[np.uint8], image2: npt.NDArray[np.uint8], num_features: int = 4000) -> Matches:
    """Match the SIFT features of image 1 to their nearest neighbours in image 2, by brute force.

    No match is dropped: keep ``ratio < 0.8`` for Lowe's ratio test. A place with several orientations gives several
    features, so correspondences can repeat, and several features of image 1 may share one of image 2.

    Args:
        image1: grey values with shape :math:`(H_1, W_1)`, uint8.
        image2: grey values with shape :math:`(H_2, W_2)`, uint8.
        num_features: how many of the strongest features to keep in each image.

    Returns:
        as many matches as image 1 has features.

    Raises:
        TypeError: if an image is not an array of uint8.
        ValueError: if an image is not of two dimensions, has no features, as a blank one, or ``num_features`` is
            below 2.
        ImportError: if OpenCV is not installed.

    """
    if num_features < 2:
        raise ValueError(f"num_features must be at least 2, got {num_features}")
    sift = import_cv2().SIFT_create(num_features)
    points1, descriptors1 = _features(sift, image1, "image 1")
    points2, descriptors2 = _features(sift, image2, "image 2")
    pairs = import_cv2().BFMatcher().knnMatch(descriptors1, descriptors2, k=2)
    index1, index2 = np.array([(nearest.queryIdx, nearest.trainIdx) for nearest, _ in pairs]).T
    distances = torch.tensor([[nearest.distance, second.distance] for nearest, second in pairs])
    # Two equal neighbours are a tie, a ratio of one, at distance zero too.
    ratio = torch.where(distances[:, 1] > 0, distances[:, 0] / distances[:, 1], 1.0)
    return Matches(torch.from_numpy(points1[index1]), torch.from_numpy(points2[index2]), ratio)


def _features(
    sift: Any, image: npt.NDArray[np.uint8], name: str
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return the pixels (N, 2) and the descriptors (N, 128) of an image's features."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        raise TypeError(f"{name} must be an array of uint8, got {getattr(image, 'dtype', type(image))}")
    if image.ndim != 2 or image.size == 0:
        raise ValueError(f"{name} must be grey with shape (H, W), got {image.shape}")
    keypoints, descriptors = sift.detectAndCompute(image, None)
    if len(keypoints) < 2:
        size = f"{image.shape[1]} x {image.shape[0]} pixels, values {image.min()} to {image.max()}"
        raise ValueError(f"{name} is blank or nearly so: {len(keypoints)} SIFT features in it ({size})")
    return np.array([keypoint.pt for keypoint in keypoints], np.float32), descriptors

"""Masks of the pixels that count: from a file, or inside of a black frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.images import Size, check_grey, image_size, read_image

__all__ = ["content_mask", "read_mask"]

MAX_BLACK = 2  # largest grey value of a black frame
MAX_UNEVEN = 0.05  # share of a frame's row or column that may differ from its median; more is noise of a dark image
MIN_USED = 128  # smallest grey value of a mask's pixel that counts


def read_mask(path: str | Path, size: Size, max_size: int | None = None) -> NDArray[np.bool_]:
    """Return which pixels of an image count by a mask file, (H, W) bool: those above 127.

    :func:`~kornia_learnnorm.data.images.read_image` reads the file, so transparent pixels do not count; ``max_size`` is
    the limit that the image was read with. A mask without a pixel that counts is a ValueError, and one that does not
    have the (width, height) of the image file, turned by EXIF.
    """
    mask = read_image(path, max_size) >= MIN_USED
    got = image_size(path)
    if got != size:
        raise ValueError(f"mask {path} has {got[0]} x {got[1]} pixels, its image {size[0]} x {size[1]}")
    if not mask.any():
        raise ValueError(f"mask {path} has no pixel above {MIN_USED - 1}")
    return mask


def content_mask(image: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """Return which pixels are inside of a black frame, (H, W) bool; None if there is no frame.

    The frame is made of the outermost rows and columns with grey values of at most 2, of which 95 % or more are equal.
    The rows and columns of a dark photograph have noise and are kept. An image that is black all over has no frame.
    Other arrays than grey values in uint8 are a TypeError or a ValueError.
    """
    check_grey(image)
    inside = [np.flatnonzero(~_black_rows(lines)) for lines in (image, image.T)]
    if any(len(kept) == 0 for kept in inside):
        return None
    (top, bottom), (left, right) = ((kept[0], kept[-1] + 1) for kept in inside)
    mask = np.zeros(image.shape, bool)
    mask[top:bottom, left:right] = True
    return None if mask.all() else mask


def _black_rows(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which rows are black and constant."""
    black = np.asarray(image.max(1) <= MAX_BLACK)
    rows = image[black]
    black[black] = (rows != np.median(rows, 1, keepdims=True)).mean(1) <= MAX_UNEVEN if len(rows) else False
    return black

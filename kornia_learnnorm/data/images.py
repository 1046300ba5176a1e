"""Reading images as grey values: from a file, or a frame with its undistortion and resizing.

Pillow decodes; OpenCV undistorts and resizes. Both come with the ``images`` extra and are imported on use.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kornia_learnnorm.data.datasets.frames import Frame, Size
from kornia_learnnorm.optional import import_extra

__all__ = ["image_size", "import_cv2", "read_frame", "read_image"]

# Weights of red, green and blue, and an offset that turns Pillow's rounding into rounding down: the integer arithmetic
# of libpng, so that a PNG has the grey values that OpenCV reads.
LUMA = (9797 / 32768, 19234 / 32768, 3737 / 32768, -0.5)
ORIENTATION = 0x0112  # tag of EXIF 2.32, section 4.6.4
QUARTER_TURNS = (5, 6, 7, 8)  # orientations that swap width and height


def import_cv2() -> Any:
    """Return the module ``cv2``; the ImportError names the extra that installs it."""
    return import_extra("cv2", "images", "matching images")


def read_image(path: str | Path) -> npt.NDArray[np.uint8]:
    """Return the grey values of an image file, turned as its EXIF orientation says.

    Colours become the luma of ITU-R BT.601, rounded down as in libpng; a JPEG gives its own luma channel. These are the
    grey values of OpenCV's ``IMREAD_GRAYSCALE``, which in other formats can be a level higher (two for CMYK). Of
    16 bits the upper eight are kept. Alpha is ignored.

    Args:
        path: a file in any format that Pillow decodes.

    Returns:
        grey values with shape :math:`(H, W)`, uint8.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, not an image, a truncated or corrupt image, one of floating-point pixels, or has
            more than twice ``PIL.Image.MAX_IMAGE_PIXELS`` pixels.
        ImportError: if Pillow is not installed.

    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"image {path} does not exist")
    size = path.stat().st_size
    if path.is_dir() or size == 0:
        got = "a folder" if path.is_dir() else "empty (0 bytes)"
        raise ValueError(f"image {path} is {got}, expected an image file")
    Image = _pillow()
    try:
        with _opened(path) as image:
            image.verify()  # the checksums of a PNG, which decoding skips
        with _opened(path) as image:
            return _grey_values(image)
    except Image.DecompressionBombError as error:
        limit = f"{2 * (Image.MAX_IMAGE_PIXELS or 0)} pixels, the limit, 2 * PIL.Image.MAX_IMAGE_PIXELS"
        raise ValueError(f"image {path} declares more than {limit}") from error
    except Exception as error:  # a broken file can end in nearly any error of Pillow's decoders
        what = f"{size} bytes, not an image or truncated or corrupt"
        raise ValueError(f"image {path} cannot be decoded: {what} ({error})") from error


def _grey_values(image: Any) -> npt.NDArray[np.uint8]:
    """Decode an open image of Pillow to grey values (H, W)."""
    image.draft("L", None)  # a JPEG: its luma channel, without a way through RGB
    if _has_exif(image):
        image = import_extra("PIL.ImageOps", "images", "reading images").exif_transpose(image)
    if image.mode == "F":
        raise ValueError("its pixels are floating-point numbers, expected 8 or 16 bits")
    if image.mode.startswith("I"):
        return (np.asarray(image).clip(0, 2**16 - 1) >> 8).astype(np.uint8)
    colours = image.mode not in ("1", "L", "LA", "La")
    return np.array(image.convert("RGB").convert("L", LUMA) if colours else image.convert("L"))


def read_frame(frame: Frame) -> npt.NDArray[np.uint8]:
    """Return the grey values (H, W) of a frame as it is matched: undistorted, of ``frame.matched_size``.

    Undistortion keeps the camera matrix; pixels without a source in the file become black.
    """
    cv2 = import_cv2()
    image = read_image(frame.path)
    if image.shape[::-1] != frame.size:
        got = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"image {frame.path} has {got} pixels, its camera {frame.size[0]} x {frame.size[1]}")
    if any(frame.distortion):
        if not np.isfinite(frame.camera).all():
            raise ValueError(f"image {frame.path} has a distortion, but no camera matrix, which undistortion needs")
        image = cv2.undistort(image, frame.camera, np.array(frame.distortion))
    if frame.matched_size != frame.size:
        image = cv2.resize(image, frame.matched_size, interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)


def image_size(path: str | Path) -> Size:
    """Return (width, height) of an image from its header, turned by EXIF; (0, 0) where it cannot be read."""
    _pillow()  # outside of the try block, which would hide that it is missing
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}")
    try:
        with _opened(path) as image:
            width, height = image.size
            turned = _has_exif(image) and image.getexif().get(ORIENTATION) in QUARTER_TURNS
    except Exception:  # a broken header can end in nearly any error of Pillow's parsers
        return 0, 0
    return (height, width) if turned else (width, height)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an image without Pillow's warnings about large images and odd metadata."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # an open file, not the path: Pillow 13 maps an uncompressed TIFF into memory and then turns it wrongly
        with path.open("rb") as file, _pillow().open(file) as image:
            yield image


def _has_exif(image: Any) -> bool:
    """Return whether an open image has EXIF data; ``getexif()`` without it would decode a whole PNG."""
    return "exif" in image.info


def _pillow() -> Any:
    return import_extra("PIL.Image", "images", "reading images")

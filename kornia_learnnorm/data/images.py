"""Reading images, grey: from a file, or a frame with its undistortion and its size.

OpenCV does the work. It comes with the ``images`` extra and is imported only when a function here is called.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import numpy.typing as npt

from kornia_learnnorm.data.datasets.frames import Frame, Size

__all__ = ["image_size", "import_cv2", "read_frame", "read_image"]

_ORIENTATION, _QUARTER_TURNS = 0x0112, {5, 6, 7, 8}  # EXIF 2.32, section 4.6.4: width and height change places


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
        path: a file in any format that OpenCV decodes and Pillow knows, which tells the size before it is decoded.

    Returns:
        grey values with shape :math:`(H, W)`, uint8.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, not an image, a truncated or corrupt image, or one of more pixels than Pillow
            opens, twice ``PIL.Image.MAX_IMAGE_PIXELS``: a small file can declare any number of them.
        ImportError: if OpenCV or Pillow is not installed.

    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"image {path} does not exist")
    if path.is_dir():
        raise ValueError(f"image {path} is a folder, expected an image file")
    data = path.read_bytes()
    if not data:
        raise ValueError(f"image {path} is empty (0 bytes)")
    image = _decode(data) if _size_is_allowed(path) and _jpeg_ends(data) else None
    if image is None:
        raise ValueError(f"image {path} cannot be decoded: {len(data)} bytes, not an image or truncated or corrupt")
    return image


def _size_is_allowed(path: Path) -> bool:
    """Tell whether Pillow knows an image's size, and raise if it is too large."""
    Image = _pillow()
    try:
        return _header_size(path)[0] > 0
    except Image.DecompressionBombError as error:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        message = f"image {path} declares more than {most} pixels, the limit, 2 * PIL.Image.MAX_IMAGE_PIXELS"
        raise ValueError(message) from error
    except Exception:  # a broken header can end in nearly any error of Pillow's parsers
        return False


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


def read_frame(frame: Frame) -> npt.NDArray[np.uint8]:
    """Read a frame as it is matched: grey, undistorted, resized.

    Undistortion keeps the camera matrix, so what has no pixel in the file turns black.

    Args:
        frame: where the image is and what is known of its camera.

    Returns:
        grey values of ``frame.matched_size``, (H, W) uint8.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a readable image, not of ``frame.size``, or distorted by an unknown camera.
        ImportError: if OpenCV is not installed.

    """
    cv2 = import_cv2()
    image = read_image(frame.path)
    if image.shape[::-1] != frame.size:
        got = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"image {frame.path} has {got} pixels, its camera {frame.size[0]} x {frame.size[1]}")
    if any(frame.distortion):
        if not np.isfinite(frame.camera).all():
            raise ValueError(f"image {frame.path} has a distortion, but no camera matrix")
        image = cv2.undistort(image, frame.camera, np.array(frame.distortion))
    if frame.matched_size != frame.size:
        image = cv2.resize(image, frame.matched_size, interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)


def image_size(path: str | Path) -> Size:
    """Return the size of an image as OpenCV decodes it, turned as its EXIF orientation says, from its header alone.

    Args:
        path: an image file.

    Returns:
        (width, height), pixels; (0, 0) where it cannot be read.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if Pillow is not installed; the message names the extra that brings it.

    """
    _pillow()
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}")
    try:
        return _header_size(path)
    except Exception:  # a broken header can end in nearly any error of Pillow's parsers
        return 0, 0


def _header_size(path: Path) -> Size:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large images and odd metadata: nothing is decoded here
        with _pillow().open(path) as image:
            width, height = image.size
            # getexif() without the test would decode a whole PNG; of a TIFF, Pillow has turned the size already
            turned = "exif" in image.info and image.getexif().get(_ORIENTATION) in _QUARTER_TURNS
    return (height, width) if turned else (width, height)


def _pillow() -> ModuleType:
    try:
        from PIL import Image
    except ImportError as error:
        message = "reading images needs Pillow: pip install 'kornia-learnnorm[images]'"
        raise ImportError(message) from error
    return Image

"""Reading images as grey values or colours, reduced to a size, and masks of the pixels that count.

Pillow decodes; OpenCV undistorts and resizes frames. Both come with the ``images`` extra and are imported on use.
Pixels follow OpenCV: the centre of the top left pixel is (0, 0).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kornia_learnnorm.data.datasets.frames import Frame, Size
from kornia_learnnorm.data.decoding import (
    QUARTER_TURNS,
    PixelError,
    decode,
    import_pillow,
    open_image,
    orientation,
    reduce,
    reduced_size,
)
from kornia_learnnorm.optional import import_extra

__all__ = [
    "content_mask",
    "image_size",
    "import_cv2",
    "read_colour",
    "read_frame",
    "read_image",
    "read_mask",
    "resize_image",
    "scale_points",
    "scaling",
]

TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
MAX_BLACK = 2  # largest grey value of a black frame
MAX_UNEVEN = 0.05  # share of a frame's row or column that may differ from its median; more is noise of a dark image
MIN_USED = 128  # smallest grey value of a mask's pixel that counts


def import_cv2() -> Any:
    """Return the module ``cv2``; the ImportError names the extra that installs it."""
    return import_extra("cv2", "images", "matching images")


def read_image(path: str | Path, max_size: int | None = None) -> npt.NDArray[np.uint8]:
    """Return the grey values of an image file, turned as its EXIF orientation says.

    Colours become the luma of ITU-R BT.601, rounded down as in libpng; a JPEG gives its own luma channel. These are the
    grey values of OpenCV's ``IMREAD_GRAYSCALE``, which in other formats can be a level higher (two for CMYK).

    - 16 bits: the depth is 8, 10, 12, 14 or 16, the smallest that holds the largest value, and the upper eight bits of
      that depth are kept. An image of 12 bits whose values stay below 1024 is thus read as one of 10.
    - Floating-point numbers: [0, 1] becomes [0, 255] if no value is outside; otherwise [0, 255] is kept if no value is
      outside; otherwise the values are stretched from their minimum and maximum. They are rounded.
    - Transparent pixels are composited over black.
    - CMYK in a JPEG is inverted, as Adobe writes it.
    - Of an animation the first frame is read, of several pages the first.

    Args:
        path: a file in any format that Pillow decodes.
        max_size: largest number of pixels on the longer side; a larger image is reduced, its outer edges in place,
            and a JPEG decoded at a fraction of its size. None keeps the size.

    Returns:
        grey values with shape :math:`(H, W)`, uint8. :func:`scale_points` moves points to the size of the file, which
        :func:`image_size` gives.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, not an image, a truncated or corrupt image, has more than twice
            ``PIL.Image.MAX_IMAGE_PIXELS`` pixels, or pixels that are NaN, infinite, negative or above 16 bits; or
            if ``max_size`` is below 1.
        ImportError: if Pillow is not installed.

    """
    return _read(Path(path), "L", max_size)


def read_colour(path: str | Path, max_size: int | None = None) -> npt.NDArray[np.uint8]:
    """Return the red, green and blue of an image file with shape :math:`(H, W, 3)`, uint8, for pictures.

    Arguments and errors are those of :func:`read_image`, and so are depth, alpha, turn and size.
    """
    return _read(Path(path), "RGB", max_size)


def read_mask(path: str | Path, size: Size, max_size: int | None = None) -> npt.NDArray[np.bool_]:
    """Return which pixels of an image count by a mask file: those above 127, half of the largest grey value.

    Args:
        path: an image file, read as :func:`read_image` does: EXIF turns it, and transparent pixels do not count.
        size: (width, height) of the image file that the mask is for, turned by EXIF; see :func:`image_size`.
        max_size: limit that the image was read with, so that the mask has the shape of the reduced image.

    Returns:
        a mask with shape :math:`(H, W)`, bool.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no image, its size is not that of the image, or no pixel counts.
        ImportError: if Pillow is not installed.

    """
    grey = _read(Path(path), "L", max_size, "mask")
    got = image_size(path)
    if got != size:
        raise ValueError(f"mask {path} has {got[0]} x {got[1]} pixels, its image {size[0]} x {size[1]}")
    mask = grey >= MIN_USED
    if not mask.any():
        raise ValueError(f"mask {path} has no pixel above {MIN_USED - 1}, its largest value is {grey.max()}")
    return mask


def content_mask(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_] | None:
    """Return which pixels lie inside of a black frame, as of a letterbox; None if there is no frame.

    The frame is made of the outermost rows and columns with grey values of at most 2, of which 95 % or more are equal.
    The rows and columns of a dark photograph have noise and are kept. An image that is black all over has no frame.

    Args:
        image: grey values with shape :math:`(H, W)`, uint8.

    Returns:
        a mask with shape :math:`(H, W)`, bool: true in a rectangle, false in the frame around it.

    Raises:
        TypeError: if the image is not an array of uint8.
        ValueError: if the image does not have two dimensions, or no pixel.

    Example:
        >>> image = np.pad(np.full((2, 3), 90, np.uint8), ((1, 2), (0, 1)))
        >>> content_mask(image).astype(int)
        array([[0, 0, 0, 0],
               [1, 1, 1, 0],
               [1, 1, 1, 0],
               [0, 0, 0, 0],
               [0, 0, 0, 0]])

    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        raise TypeError(f"an image must be an array of uint8, got {getattr(image, 'dtype', type(image))}")
    if image.ndim != 2 or image.size == 0:
        raise ValueError(f"an image must be grey with shape (H, W), got {image.shape}")
    inside = [np.flatnonzero(~_black_rows(lines)) for lines in (image, image.T)]
    if any(len(kept) == 0 for kept in inside):
        return None
    (top, bottom), (left, right) = ((kept[0], kept[-1] + 1) for kept in inside)
    if (bottom - top, right - left) == image.shape:
        return None
    mask = np.zeros(image.shape, bool)
    mask[top:bottom, left:right] = True
    return mask


def _black_rows(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Return which rows are black and constant."""
    black = np.asarray(image.max(1) <= MAX_BLACK)
    rows = image[black]
    black[black] = (rows != np.median(rows, 1, keepdims=True)).mean(1) <= MAX_UNEVEN if len(rows) else False
    return black


def scaling(size_from: Size, size_to: Size) -> Tensor:
    r"""Return the transform of pixels from an image of one (width, height) to the same image of another.

    Pixel centres are whole numbers and the outer edges stay in place: :math:`x' = (x + 0.5) s - 0.5` with a factor
    :math:`s` for each axis. If ``S1`` and ``S2`` lead from full images to reduced ones, :math:`S_2^\top F S_1` is the
    fundamental matrix of the full images for the matrix :math:`F` of the reduced ones.

    Args:
        size_from: (width, height) of the image whose pixels are given.
        size_to: (width, height) of the image whose pixels are wanted.

    Returns:
        the transform with shape :math:`(3, 3)`, float64.

    Raises:
        ValueError: if a width or height is below 1.

    Example:
        >>> scaling((400, 200), (100, 100))
        tensor([[ 0.2500,  0.0000, -0.3750],
                [ 0.0000,  0.5000, -0.2500],
                [ 0.0000,  0.0000,  1.0000]], dtype=torch.float64)

    """
    if min(*size_from, *size_to) < 1:
        raise ValueError(f"sizes must be a positive width and height, got {size_from} and {size_to}")
    x, y = (new / old for new, old in zip(size_to, size_from, strict=True))
    return torch.tensor([[x, 0.0, x / 2 - 0.5], [0.0, y, y / 2 - 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def scale_points(points: npt.NDArray[Any], size_from: Size, size_to: Size) -> npt.NDArray[np.float64]:
    """Return pixels :math:`(*, 2)` of an image of one (width, height) in the same image of another, by :func:`scaling`.

    Example:
        >>> scale_points(np.array([[0.0, 0.0], [99.0, 99.0]]), (100, 100), (400, 200))
        array([[  1.5,   0.5],
               [397.5, 198.5]])

    """
    factors = scaling(size_from, size_to).diagonal()[:2].numpy()
    return np.asarray((np.asarray(points, np.float64) + 0.5) * factors - 0.5)


def resize_image(image: npt.NDArray[np.uint8], max_size: int | None) -> npt.NDArray[np.uint8]:
    """Return grey values (H, W) or colours (H, W, 3) reduced as by :func:`read_image`; a small image as it is."""
    size = (image.shape[1], image.shape[0])
    if reduced_size(size, max_size) == size:
        return image
    return np.array(reduce(import_pillow().fromarray(image), reduced_size(size, max_size)))


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
    import_pillow()  # outside of the try block, which would hide that it is missing
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}")
    try:
        with open_image(path) as image:
            width, height = image.size
            turned = orientation(image) in QUARTER_TURNS
    except Exception:  # a broken header can end in nearly any error of Pillow's parsers
        return 0, 0
    return (height, width) if turned else (width, height)


def _read(path: Path, mode: str, max_size: int | None, kind: str = "image") -> npt.NDArray[np.uint8]:
    """Decode an image file; errors name the file and what is wrong with it."""
    if not path.exists():
        raise FileNotFoundError(f"{kind} {path} does not exist")
    reduced_size((1, 1), max_size)  # checks the limit before a file is read
    size = path.stat().st_size
    if path.is_dir() or size == 0:
        got = "a folder" if path.is_dir() else "empty (0 bytes)"
        raise ValueError(f"{kind} {path} is {got}, expected an image file")
    Image = import_pillow()
    try:
        return decode(path, mode, max_size)
    except PixelError as error:
        raise ValueError(f"{kind} {path} cannot be used: {error}") from error
    except Image.DecompressionBombError as error:
        limit = f"{2 * (Image.MAX_IMAGE_PIXELS or 0)} pixels, the limit, 2 * PIL.Image.MAX_IMAGE_PIXELS"
        raise ValueError(f"{kind} {path} declares more than {limit}") from error
    except Image.UnidentifiedImageError as error:
        raise ValueError(f"{kind} {path} cannot be decoded: {size} bytes, {_unknown_kind(path)}") from error
    except Exception as error:  # a broken file can end in nearly any error of Pillow's decoders
        reason = "truncated or corrupt"
        if isinstance(error, MemoryError):
            reason = "too large for the memory"
        elif isinstance(error, OSError) and error.strerror:  # of the system; Pillow's own have no number
            reason = error.strerror
        raise ValueError(f"{kind} {path} cannot be decoded: {size} bytes, {reason}") from error


def _unknown_kind(path: Path) -> str:
    """Return what is wrong with a file that Pillow does not recognise."""
    with path.open("rb") as file:
        if file.read(4) in TIFF_SIGNATURES:
            return (
                "a corrupt TIFF, or one of pixels that Pillow does not read, such as colours of floating-point numbers"
            )
    return "not an image of a kind that Pillow reads, or one with a truncated or corrupt header"

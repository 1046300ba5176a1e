"""Reading image files as grey values or colours of eight bits, reduced to a size, and masks of the pixels that count.

Pillow, of the extra ``images``, is imported on use. The centre of the top left pixel is (0, 0), as in OpenCV.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.optional import import_extra

__all__ = ["check_grey", "content_mask", "image_size", "read_colour", "read_image", "read_mask", "scaling"]

Size = tuple[int, int]  # width and height, pixels
Array = NDArray[Any]
Pixels = NDArray[np.uint8]  # grey values (H, W) or red, green and blue (H, W, 3)

# Weights of red, green and blue, and an offset that turns Pillow's rounding into rounding down: the integer arithmetic
# of libpng, so that a PNG has the grey values that OpenCV reads.
LUMA = (9797 / 32768, 19234 / 32768, 3737 / 32768, -0.5)
REDUCING_GAP = 2.0  # the last step of reducing, which is filtered, is by this factor or more, where there are others
ORIENTATION = 0x0112  # tag, EXIF 2.32, section 4.6.4
QUARTER_TURNS = (5, 6, 7, 8)  # orientations that swap width and height
MIRRORED_X, MIRRORED_Y = (2, 3, 7, 8), (3, 4, 6, 7)  # orientations of files whose x or y run the other way
MAX_BLACK = 2  # largest grey value of a black frame
MAX_UNEVEN = 0.05  # share of a frame's row or column that may differ from its median; more is noise of a dark image
MIN_USED = 128  # smallest grey value of a mask's pixel that counts


def import_cv2() -> Any:
    """Return the module ``cv2``; the ImportError names the extra that installs it."""
    return import_extra("cv2", "images", "matching images")


def import_pillow() -> Any:
    """Return the module ``PIL.Image``; see :func:`import_cv2`."""
    return import_extra("PIL.Image", "images", "reading images")


def check_grey(image: Pixels, colour: bool = False) -> None:
    """Raise TypeError or ValueError unless an image is an array of grey values (H, W), or colours (H, W, 3), uint8."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        raise TypeError(f"an image must be an array of uint8, got {getattr(image, 'dtype', type(image))}")
    if image.size == 0 or not (image.ndim == 2 or (colour and image.ndim == 3 and image.shape[2] == 3)):
        expected = "grey or RGB with shape (H, W) or (H, W, 3)" if colour else "grey with shape (H, W)"
        hint = "; .movedim(0, -1) brings the colours of a tensor to the end" if image.shape[:1] == (3,) else ""
        hint = "; image[..., :3] is without transparency" if image.shape[2:] == (4,) else hint
        raise ValueError(f"an image must be {expected}, got {image.shape}{hint}")


def read_image(path: str | Path, max_size: int | None = None) -> Pixels:
    """Return the grey values :math:`(H, W)`, uint8, of an image file, rotated by its EXIF orientation.

    They are those of OpenCV's ``IMREAD_GRAYSCALE``, up to a level higher in other formats than PNG and JPEG (two for
    CMYK). Of an animation the first image is read; transparency is over black.

    Args:
        path: a file in any format that Pillow decodes.
        max_size: largest number of pixels on the longer side; a larger image is reduced, its outer edges in place,
            and a JPEG decoded at a fraction of its size. None keeps the size of the file, as :func:`image_size` has it.

    FileNotFoundError if there is no such file; ValueError if it is no image, is truncated, corrupt, larger than twice
    ``PIL.Image.MAX_IMAGE_PIXELS``, has more than eight bits of grey, or if ``max_size`` is below 1.
    """
    return _read(Path(path), "L", max_size)


def read_colour(path: str | Path, max_size: int | None = None) -> Pixels:
    """Return the red, green and blue of an image file with shape :math:`(H, W, 3)`, uint8; see :func:`read_image`."""
    return _read(Path(path), "RGB", max_size)


def _read(path: Path, mode: str, max_size: int | None) -> Pixels:
    if not path.exists():
        raise FileNotFoundError(f"image {path} does not exist")
    reduced_size((1, 1), max_size)  # checks the limit before a file is read
    Image = import_pillow()
    try:
        return _decode(path, mode, max_size)
    except Exception as error:  # a broken file can end in nearly any error of Pillow's decoders
        reason = "not an image, truncated or corrupt"
        if isinstance(error, TypeError | MemoryError | Image.DecompressionBombError):
            reason = str(error) or "too large for the memory"
        elif isinstance(error, OSError) and error.strerror:  # of the system; Pillow's own have no number
            reason = error.strerror
        raise ValueError(f"image {path} cannot be decoded: {path.stat().st_size} bytes, {reason}") from error


def _decode(path: Path, mode: str, max_size: int | None) -> Pixels:
    """Return the pixels in a mode, L or RGB; TypeError for pixels of more than eight bits."""
    with open_image(path) as image:
        image.verify()  # the checksums of a PNG, which decoding skips
    with open_image(path) as image:
        turned = _orientation(image) > 1
        width, height = size = reduced_size(image.size, max_size)
        # for a grey image a JPEG gives its luma channel, without a way through RGB
        drafted = image.draft(mode, None if size == image.size else (2 * width, 2 * height))
        image.load()
        if drafted is None:
            size = reduced_size(image.size, max_size)  # again, since loading turns a TIFF
        box = drafted[1] if drafted else (0, 0, *image.size)  # a JPEG at an eighth has a part of a last pixel
        if image.mode[0] in "IF" or image.mode == "LAB":
            raise TypeError(f"pixels of the kind {image.mode} are not read, expected eight bits of grey or colours")
        clear = "transparency" in image.info or image.mode[-1] in "Aa"
        image = image.convert("RGBA" if clear else "L" if image.mode in ("1", "L") else "RGB")
    image = image if size == image.size else _reduce(image, size, box)
    if turned:
        image = import_extra("PIL.ImageOps", "images", "reading images").exif_transpose(image)
    if clear:  # over black
        image = import_pillow().fromarray(np.asarray(image.convert("RGBa"))[..., :3])
    if (image.mode, mode) == ("RGB", "L"):
        image = image.convert("L", LUMA)
    return np.array(image.convert(mode))


def _orientation(image: Any) -> int:
    """Return the EXIF orientation of an image that Pillow opened, 1 if it has none; Pillow itself turns a TIFF."""
    if "exif" not in image.info:  # getexif() would decode a whole PNG
        return 1
    return int(image.getexif().get(ORIENTATION) or 1)


def stored_pixels(path: Path, points: Array, size: Sequence[int], turned: bool = True) -> tuple[Array, Size]:
    """Return pixels (N, 2) and the (width, height) of an image, rotated by EXIF (``turned``) or not, in the file."""
    turn = 1
    if turned:
        if image_size(path) == (0, 0):
            raise ValueError(f"{path} is not an image that can be read")
        with open_image(path) as image:
            turn = image.tag_v2.get(ORIENTATION, 1) if image.format == "TIFF" else _orientation(image)
    x, y = np.asarray(points, np.float64).T
    width, height = map(int, size)
    if turn in QUARTER_TURNS:
        x, y, width, height = y, x, height, width
    x = width - 1 - x if turn in MIRRORED_X else x
    y = height - 1 - y if turn in MIRRORED_Y else y
    return np.stack([x, y], -1), (width, height)


def _reduce(image: Any, size: Size, box: tuple[float, float, float, float] | None = None) -> Any:
    """Return an image of Pillow, or the part of it in a box (left, top, right, bottom), reduced to (width, height)."""
    # not BOX or HAMMING, which move edges by up to a fifth of a pixel where the factor is no whole number
    return image.resize(size, import_pillow().Resampling.BICUBIC, box, REDUCING_GAP)


@contextmanager
def open_image(path: Path) -> Iterator[Any]:
    """Open an image without Pillow's warnings about large images and odd metadata."""
    # an open file, not the path: Pillow 13 maps an uncompressed TIFF into memory and then turns it wrongly
    with warnings.catch_warnings(action="ignore"), path.open("rb") as file, import_pillow().open(file) as image:
        yield image


def image_size(path: str | Path) -> Size:
    """Return (width, height) of an image from its header, after EXIF rotation; (0, 0) if it cannot be read."""
    import_pillow()  # outside of the try block, which would hide that it is missing
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}")
    try:
        with open_image(path) as image:
            width, height = image.size
            return (height, width) if _orientation(image) in QUARTER_TURNS else (width, height)
    except Exception:  # a broken header can end in nearly any error of Pillow's parsers
        return 0, 0


def reduced_size(size: Size, max_size: int | None) -> Size:
    """Return (width, height) with at most ``max_size`` pixels on the longer side, each side rounded."""
    if max_size is not None and max_size < 1:
        raise ValueError(f"max_size must be a number of pixels, 1 or more, or None for all, got {max_size}")
    longest = max(size)
    if max_size is None or longest <= max_size:
        return size
    width, height = (max(1, round(side * max_size / longest)) for side in size)
    return width, height


def resize_image(image: Pixels, max_size: int | None) -> Pixels:
    """Return grey values (H, W) or colours (H, W, 3) reduced as by :func:`read_image`; a small image as it is."""
    size = reduced_size((image.shape[1], image.shape[0]), max_size)
    return image if size == image.shape[1::-1] else np.array(_reduce(import_pillow().fromarray(image), size))


def scaling(size_from: Size, size_to: Size) -> Tensor:
    r"""Return the transform (3, 3), float64, of pixels from an image of one (width, height) to it at another.

    The outer edges stay in place: :math:`x' = (x + 0.5) s - 0.5` with a factor :math:`s` for each axis. If ``S1`` and
    ``S2`` lead from full images to reduced ones, :math:`S_2^\top F S_1` is the fundamental matrix of the full images
    for the matrix :math:`F` of the reduced ones. A size below 1 is a ValueError.
    """
    if min(*size_from, *size_to) < 1:
        raise ValueError(f"sizes must be a positive width and height, got {size_from} and {size_to}")
    x, y = (new / old for new, old in zip(size_to, size_from, strict=True))
    return torch.tensor([[x, 0.0, x / 2 - 0.5], [0.0, y, y / 2 - 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def read_mask(path: str | Path, size: Size) -> NDArray[np.bool_]:
    """Return which pixels of an image count by a mask file, (H, W) bool: those above 127, not transparent.

    A mask without a pixel that counts, or without the (width, height) of the image file after EXIF rotation, is a
    ValueError.
    """
    mask = read_image(path) >= MIN_USED
    got = image_size(path)
    if got != size:
        raise ValueError(f"mask {path} has {got[0]} x {got[1]} pixels, its image {size[0]} x {size[1]}")
    if not mask.any():
        raise ValueError(f"mask {path} has no pixel above {MIN_USED - 1}")
    return mask


def content_mask(image: Pixels) -> NDArray[np.bool_] | None:
    """Return which pixels are inside of a black frame, (H, W) bool; None without one, or if all pixels are black.

    The frame is made of the outermost rows and columns with grey values of at most 2, of which 95 % or more are equal;
    those of a dark photograph have noise. Errors are those of :func:`check_grey`.
    """
    check_grey(image)
    inside = [np.flatnonzero(~_black_rows(lines)) for lines in (image, image.T)]
    if not all(map(len, inside)):
        return None
    (top, bottom), (left, right) = ((kept[0], kept[-1] + 1) for kept in inside)
    mask = np.zeros(image.shape, bool)
    mask[top:bottom, left:right] = True
    return None if mask.all() else mask


def _black_rows(image: Pixels) -> NDArray[np.bool_]:
    black = np.asarray(image.max(1) <= MAX_BLACK)
    rows = image[black]
    black[black] = (rows != np.median(rows, 1, keepdims=True)).mean(1) <= MAX_UNEVEN if len(rows) else False
    return black

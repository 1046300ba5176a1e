"""Decoding an image file with Pillow to eight bits: bit depth, alpha, colours, a limit on the size, the EXIF turn.

Pillow comes with the ``images`` extra and is imported on use.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.optional import import_extra

__all__ = [
    "QUARTER_TURNS",
    "PixelError",
    "decode",
    "import_pillow",
    "open_image",
    "orientation",
    "reduce",
    "reduced_size",
]

# Weights of red, green and blue, and an offset that turns Pillow's rounding into rounding down: the integer arithmetic
# of libpng, so that a PNG has the grey values that OpenCV reads.
LUMA = (9797 / 32768, 19234 / 32768, 3737 / 32768, -0.5)
ORIENTATION = 0x0112  # tag of EXIF 2.32, section 4.6.4
QUARTER_TURNS = (5, 6, 7, 8)  # orientations that swap width and height
TURNS = {  # orientation -> name in PIL.Image.Transpose of the turn that undoes it
    2: "FLIP_LEFT_RIGHT",
    3: "ROTATE_180",
    4: "FLIP_TOP_BOTTOM",
    5: "TRANSPOSE",
    6: "ROTATE_270",
    7: "TRANSVERSE",
    8: "ROTATE_90",
}
BIT_DEPTHS = (8, 10, 12, 14, 16)  # of cameras and scanners
MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "HSV")  # and "I...", "F"
PHOTOMETRIC = 262  # tag of TIFF 6.0, section 3; 0: white is zero
REDUCING_GAP = 2.0  # the last step of reducing, which is filtered, is by this factor or more, where there are others
# Pillow unpacks 16-bit colours to their upper bytes. In the other byte order it unpacks the lower bytes.
FOREIGN = "16B" if sys.byteorder == "little" else "16L"
OTHER_ORDER = {"16B": "16L", "16L": "16B", "16N": FOREIGN}


class PixelError(ValueError):
    """Pixels of an intact file that have no meaning as eight bits."""


def import_pillow() -> Any:
    """Return the module ``PIL.Image``; the ImportError names the extra that installs it."""
    return import_extra("PIL.Image", "images", "reading images")


@contextmanager
def open_image(path: Path) -> Iterator[Any]:
    """Open an image without Pillow's warnings about large images and odd metadata."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # an open file, not the path: Pillow 13 maps an uncompressed TIFF into memory and then turns it wrongly
        with path.open("rb") as file, import_pillow().open(file) as image:
            yield image


def orientation(image: Any) -> int:
    """Return the EXIF orientation of an open image, 1 if it has none; Pillow itself turns a TIFF."""
    if "exif" not in image.info:  # getexif() would decode a whole PNG
        return 1
    return int(image.getexif().get(ORIENTATION) or 1)


def reduced_size(size: tuple[int, int], max_size: int | None) -> tuple[int, int]:
    """Return (width, height) with at most ``max_size`` pixels on the longer side, each side rounded.

    Example:
        >>> reduced_size((1000, 601), 500), reduced_size((1000, 601), 1000), reduced_size((1000, 601), None)
        ((500, 300), (1000, 601), (1000, 601))

    """
    if max_size is not None and max_size < 1:
        raise ValueError(f"max_size must be a number of pixels, 1 or more, or None for all, got {max_size}")
    longest = max(size)
    if max_size is None or longest <= max_size:
        return size
    width, height = (max(1, round(side * max_size / longest)) for side in size)
    return width, height


def decode(path: Path, mode: str, max_size: int | None = None) -> NDArray[np.uint8]:
    """Return the pixels of an image file, turned by EXIF: (H, W) for mode ``"L"``, (H, W, 3) for ``"RGB"``.

    A JPEG is decoded at an eighth, a quarter or half of its size, if that is at least twice the size wanted. Reducing
    keeps the outer edges of the image in place. PixelError if the pixels have no meaning as eight bits; a broken file
    can raise nearly any error of Pillow's decoders.
    """
    with open_image(path) as image:
        image.verify()  # the checksums of a PNG, which decoding skips
    with open_image(path) as image:
        turn = TURNS.get(orientation(image))
        width, height = size = reduced_size(image.size, max_size)
        # for a grey image a JPEG gives its luma channel, without a way through RGB
        drafted = image.draft(mode, None if size == image.size else (2 * width, 2 * height))
        orders = [_byte_order(tile) for tile in image.tile]
        image.load()
        if drafted is None:
            size = reduced_size(image.size, max_size)  # again, since loading turns a TIFF
        box = drafted[1] if drafted else (0, 0, *image.size)  # a JPEG at an eighth has a part of a last pixel
        image = _eight_bits(_stretched(path, image) if all(orders) and orders else image)
    image = _over_black(image if size == image.size else reduce(image, size, box))
    if turn:
        image = image.transpose(import_pillow().Transpose[turn])
    if (image.mode, mode) == ("RGB", "L"):
        image = image.convert("L", LUMA)
    return np.array(image if image.mode == mode else image.convert(mode))


def reduce(image: Any, size: tuple[int, int], box: tuple[float, float, float, float] | None = None) -> Any:
    """Return an image of Pillow, or the part of it in a box (left, top, right, bottom), reduced to (width, height)."""
    # not BOX or HAMMING, which move edges by up to a fifth of a pixel where the factor is no whole number
    return image.resize(size, import_pillow().Resampling.BICUBIC, box, REDUCING_GAP)


def _eight_bits(image: Any) -> Any:
    """Return a loaded image in one of the modes L, LA, RGB and RGBA."""
    if image.mode == "F":
        return import_pillow().fromarray(_bytes_of_floats(np.asarray(image)))
    if image.mode.startswith("I"):
        return import_pillow().fromarray(_bytes_of_integers(image))
    if image.mode not in MODES:
        raise PixelError(f"its pixels are of the kind {image.mode}, expected grey, RGB, CMYK or a palette")
    alpha = "A" if "transparency" in image.info or image.mode[-1] in "Aa" else ""
    mode = ("L" if image.mode in ("1", "L", "LA", "La") else "RGB") + alpha
    return image if image.mode == mode else image.convert(mode)


def _shift(largest: int) -> int:
    """Return by how many bits values are shifted to become eight, if their depth is the smallest that holds them."""
    return next(depth for depth in BIT_DEPTHS if largest < 1 << depth) - 8


def _bytes_of_integers(image: Any) -> NDArray[np.uint8]:
    """Return the grey values of an image of 16 or 32 bits."""
    values = np.asarray(image)
    low, high = int(values.min()), int(values.max())
    if low < 0 or high >= 1 << BIT_DEPTHS[-1]:
        raise PixelError(f"its grey values go from {low} to {high}, expected 0 to {(1 << BIT_DEPTHS[-1]) - 1}")
    grey = np.asarray(values >> _shift(high), np.uint8)
    if getattr(image, "tag_v2", {}).get(PHOTOMETRIC) == 0:  # Pillow inverts eight bits only
        grey = 255 - grey
    if "transparency" in image.info:
        grey[values == image.info["transparency"]] = 0
    return grey


def _bytes_of_floats(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Return the grey values of an image of floating-point numbers: of [0, 1], of [0, 255], or of their own range."""
    low, high = float(values.min()), float(values.max())
    if not np.isfinite([low, high]).all():
        number = values.size - int(np.isfinite(values).sum())
        raise PixelError(f"{number} of its {values.size} floating-point pixels are NaN or infinite")
    if low < 0 or high > 255:
        values = (values.astype(np.float64) - low) * (255 / (high - low) if high > low else 0.0)
    elif high <= 1:
        values = values * 255
    return np.asarray(np.rint(values), np.uint8)


def _byte_order(tile: Any) -> str | None:
    """Return the end of a tile's raw mode, a key of OTHER_ORDER, if its colours have 16 bits; None otherwise."""
    raw = tile[3][0] if isinstance(tile[3], tuple) and tile[3] else tile[3]
    mode, _, order = str(raw).partition(";")
    return order if mode in ("RGB", "RGBA") and order in OTHER_ORDER else None


def _stretched(path: Path, image: Any) -> Any:
    """Return an image of 16-bit colours at the depth in use; Pillow has kept the upper bytes alone."""
    largest = max(high for _, high in image.getextrema()[:3])
    image.info.pop("transparency", None)  # a colour of 16 bits, which Pillow would compare with eight
    if _shift(largest << 8 | 255) == _shift((1 << BIT_DEPTHS[-1]) - 1):
        return image
    with open_image(path) as other:
        other.tile = [_swapped(tile) for tile in other.tile]
        lower = np.asarray(other)[..., :3]
    upper = np.asarray(image)
    values = upper[..., :3].astype(np.uint16) << 8 | lower
    pixels = (values >> _shift(int(values.max()))).astype(np.uint8)
    return import_pillow().fromarray(np.dstack([pixels, upper[..., 3:]]))


def _swapped(tile: Any) -> Any:
    """Return a tile with the other byte order."""
    name, extents, offset, args = tile
    order = _byte_order(tile) or ""
    raw = (args if isinstance(args, str) else args[0]).removesuffix(order) + OTHER_ORDER[order]
    swapped = name, extents, offset, raw if isinstance(args, str) else (raw, *args[1:])
    return tile._make(swapped) if hasattr(tile, "_make") else swapped  # plain tuples before Pillow 11


def _over_black(image: Any) -> Any:
    """Return an image without alpha, by compositing over black."""
    if not image.mode.endswith("A"):
        return image
    opaque = image.convert(image.mode[:-1])
    return import_pillow().composite(opaque, import_pillow().new(opaque.mode, opaque.size), image.getchannel("A"))

"""EXIF data of a photograph: how it is turned, and its focal length (EXIF 2.32, section 4.6)."""

from __future__ import annotations

from typing import Any

__all__ = ["QUARTER_TURNS", "focal_length_35mm", "orientation", "turn_upright"]

ORIENTATION = 0x0112  # tag, section 4.6.4
EXIF_IFD = 0x8769  # tag, section 4.6.3
FOCAL_LENGTH_35MM = 0xA405  # tag, section 4.6.5; zero for unknown
QUARTER_TURNS = (5, 6, 7, 8)  # orientations that swap width and height
# Names in PIL.Image.Transpose of the turns that undo the orientations from 2 on.
TURNS = ("FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM", "TRANSPOSE", "ROTATE_270", "TRANSVERSE", "ROTATE_90")


def orientation(image: Any) -> int:
    """Return the EXIF orientation of an image that Pillow opened, 1 if it has none; Pillow itself turns a TIFF."""
    if "exif" not in image.info:  # getexif() would decode a whole PNG
        return 1
    return int(image.getexif().get(ORIENTATION) or 1)


def turn_upright(image: Any, orientation: int) -> Any:
    """Return an image of Pillow, turned so that an EXIF orientation becomes 1."""
    from PIL.Image import Transpose

    return image.transpose(Transpose[TURNS[orientation - 2]]) if 2 <= orientation <= 8 else image


def focal_length_35mm(image: Any) -> float:
    """Return the equivalent focal length on film of 36 x 24 mm, millimetres, by an image's EXIF data; 0 for unknown."""
    return float(image.getexif().get_ifd(EXIF_IFD).get(FOCAL_LENGTH_35MM, 0))

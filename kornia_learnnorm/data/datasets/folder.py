"""Folders of images as frames."""

from __future__ import annotations

from pathlib import Path

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.images import image_size

__all__ = ["read_folder"]

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}  # in any case


def read_folder(root: str | Path) -> list[Frame]:
    """Return the images of a folder and its subfolders as frames by folder and name, each folder a sequence.

    Images have the suffix png, jpg, jpeg, bmp, tif, tiff, webp, pgm or ppm, whatever the case; hidden files and folders
    are skipped. A folder without images is a FileNotFoundError.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    paths = [path for path in root.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    names = [path.relative_to(root).as_posix() for path in paths]
    names = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]
    if not names:
        raise FileNotFoundError(f"no images ({', '.join(sorted(SUFFIXES))}) in {root}")
    names.sort(key=lambda name: (name.rpartition("/")[0], name))
    return [Frame(root / name, name, name.rpartition("/")[0], image_size(root / name)) for name in names]

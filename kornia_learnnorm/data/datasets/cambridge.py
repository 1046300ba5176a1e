"""Cambridge Landmarks as frames."""

from __future__ import annotations

from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.textfiles import (
    camera_matrix,
    listed_image,
    parse_numbers,
    quaternion_pose,
    text_lines,
)
from kornia_learnnorm.data.images import image_size

__all__ = ["read_cambridge"]


def read_cambridge(root: str | Path, split: str | None = None) -> list[Frame]:
    """Return the frames of a scene of Cambridge Landmarks (A. Kendall et al., ICCV 2015).

    Focal lengths are those of the scene's reconstruction by VisualSFM, ``reconstruction.nvm``; the principal point is
    the centre of the image. The reconstruction's radial distortion is not applied.

    Args:
        root: the scene's folder, with ``dataset_train.txt`` and ``dataset_test.txt``: camera centres, approximately in
            metres, and quaternions from world to camera.
        split: ``train`` or ``test``; None for both.

    Returns:
        the frames by name, each folder a sequence; cameras are NaN where image or reconstruction do not give them.

    Raises:
        FileNotFoundError: if a list is missing, or an image that it lists.
        ValueError: if the split is unknown, a line is malformed, or a list is empty or has an image twice.

    """
    root = Path(root)
    if split not in (None, "train", "test"):
        raise ValueError(f"a split of Cambridge Landmarks must be 'train', 'test' or None for both, got {split!r}")
    model = root / "reconstruction.nvm"
    focals = _nvm_focals(model) if model.exists() else {}
    frames: dict[str, Frame] = {}
    for part in (split,) if split else ("train", "test"):
        path, before = root / f"dataset_{part}.txt", len(frames)
        for number, line in text_lines(path, "list of images"):
            if number <= 3:  # the header
                continue
            name, *words = line.split()
            row = parse_numbers(path, number, words, 7, "ImageFile X Y Z W P Q R", line)
            if name in frames:
                raise ValueError(f"{path}, line {number}: {name} is listed twice")
            size = image_size(root / listed_image(path, number, name))
            focal = focals.get(_without_suffix(name), np.nan) if size != (0, 0) else np.nan
            K = np.full((3, 3), np.nan)
            if focal > 0:
                K = camera_matrix(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
            pose = quaternion_pose(path, number, row[3:] * [1, -1, -1, -1], row[:3])
            frames[name] = Frame(root / name, name, name.rpartition("/")[0], size, K, pose)
        if len(frames) == before:
            raise ValueError(f"{path} lists no images after the three lines of its header")
    return sorted(frames.values(), key=lambda frame: (frame.sequence, frame.name))


def _nvm_focals(path: Path) -> dict[str, float]:
    """Return the focal lengths, pixels, by the images' names without suffix; the points after them are not read."""
    lines = text_lines(path, "reconstruction")
    number, line = next(lines, (1, ""))
    if line != "NVM_V3":
        raise ValueError(f"{path}, line {number}: NVM_V3 expected, got {line!r}")
    number, line = next(lines, (number, ""))
    if not line.isdecimal():
        raise ValueError(f"{path}, line {number}: the number of images expected, got {line!r}")
    expected, focals = "an image, its focal length, quaternion, centre, radial distortion and 0", {}
    for number, text in islice(lines, int(line)):
        name, *words = text.split()
        focal = float(parse_numbers(path, number, words, 10, expected, text)[0])
        focals[_without_suffix(name)] = focal
        if focal <= 0:
            raise ValueError(f"{path}, line {number}: a positive focal length expected, got {words[0]}")
    if len(focals) < int(line):
        raise ValueError(f"{path} announces {line} images and has {len(focals)}")
    return focals


def _without_suffix(name: str) -> str:
    """Return a name without the suffix, which differs between the lists and the reconstruction."""
    return str(PurePosixPath(name).with_suffix(""))

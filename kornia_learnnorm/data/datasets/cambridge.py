"""Cambridge Landmarks as frames."""

from itertools import islice
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.textfiles import TextLine, camera_matrix, rigid_motion, text_lines
from kornia_learnnorm.data.images import image_size


def read_cambridge(root: str | Path, split: str | None = None) -> list[Frame]:
    """Return the frames of a scene of Cambridge Landmarks (A. Kendall et al., ICCV 2015), each folder a sequence.

    ``root`` has ``dataset_train.txt`` and ``dataset_test.txt``, camera centres, approximately in metres, and
    quaternions from world to camera; ``split`` is ``train``, ``test`` or None for both. Focal lengths are those of
    ``reconstruction.nvm`` (VisualSFM), NaN without, whose radial distortion is not applied; the principal point is the
    centre of the image. FileNotFoundError if a list or one of its images is missing; ValueError if the split is
    unknown, a line is malformed, or a list is empty or has an image twice.
    """
    root = Path(root)
    if split not in (None, "train", "test"):
        raise ValueError(f"a split of Cambridge Landmarks must be 'train', 'test' or None for both, got {split!r}")
    model = root / "reconstruction.nvm"
    focals = _nvm_focals(model) if model.exists() else {}
    frames: dict[str, Frame] = {}
    for part in (split,) if split else ("train", "test"):
        path, before = root / f"dataset_{part}.txt", len(frames)
        for line in text_lines(path, "list of images"):
            if line.number <= 3:  # the header
                continue
            name, *words = line.text.split()
            row = line.numbers(words, 7, "ImageFile X Y Z W P Q R")
            if name in frames:
                raise ValueError(f"{path}, line {line.number}: {name} is listed twice")
            size = image_size(root / line.image(name))
            focal, K = focals.get(name.rsplit(".", 1)[0]), np.full((3, 3), np.nan)
            if focal and size != (0, 0):
                K = camera_matrix(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
            pose = rigid_motion(line.quaternion(row[3:]) * [1, -1, -1, -1], row[:3])  # the inverse rotation
            frames[name] = Frame(root / name, name, name.rpartition("/")[0], size, K, pose)
        if len(frames) == before:
            raise ValueError(f"{path} lists no images after the three lines of its header")
    return sorted(frames.values(), key=lambda frame: (frame.sequence, frame.name))


def _nvm_focals(path: Path) -> dict[str, float]:
    """Return the focal lengths, pixels, by the images' names without suffix, which differs from that of the lists."""
    lines = text_lines(path, "reconstruction")
    line = next(lines, TextLine(path, 1, ""))
    if line.text != "NVM_V3":
        raise line.error("NVM_V3")
    line = next(lines, line._replace(text=""))
    if not line.text.isdecimal():
        raise line.error("the number of images")
    number, focals = int(line.text), {}
    for line in islice(lines, number):
        name, *words = line.text.split()
        row = line.numbers(words, 10, "an image, its focal length, quaternion, centre, radial distortion and 0")
        focals[name.rsplit(".", 1)[0]] = float(row[0])
        if row[0] <= 0:
            raise ValueError(f"{path}, line {line.number}: a positive focal length expected, got {words[0]}")
    if len(focals) < number:
        raise ValueError(f"{path} announces {number} images and has {len(focals)}")
    return focals

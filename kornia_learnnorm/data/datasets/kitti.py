"""KITTI odometry as frames."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.sequences import choose_sequences
from kornia_learnnorm.data.datasets.textfiles import Array, rigid_motion, text_lines
from kornia_learnnorm.data.images import image_size


def read_kitti(root: str | Path, sequences: Sequence[str] | None = None, camera: str = "image_0") -> list[Frame]:
    """Return the frames of the KITTI odometry benchmark (A. Geiger et al., CVPR 2012; conventions of its devkit).

    ``root`` has ``sequences/SS/calib.txt``, ``sequences/SS/image_N/*.png`` and ``poses/SS.txt``, metres. ``sequences``
    are names ``SS`` in the order to read, None for all. Poses are NaN for a sequence without a file of poses.
    FileNotFoundError if a folder, an image or a ``calib.txt`` is missing; ValueError if a sequence or camera is
    unknown, a line is malformed, a frame lacks its pose, or the name of an image is not a number.
    """
    root = Path(root)
    if camera not in {f"image_{number}" for number in range(4)}:
        raise ValueError(f"a camera of KITTI must be one of image_0 to image_3, got {camera!r}")
    frames = []
    for name, folder in choose_sequences("kitti", root, sequences).items():
        K, shift = read_calibration(folder / "calib.txt", f"P{camera[-1]}")
        path = root / "poses" / f"{name}.txt"
        poses = {}
        for line in text_lines(path, "poses") if path.exists() else ():
            rows = line.numbers(line.text.split(), 12, "the 12 numbers of a pose").reshape(3, 4)
            poses[line.number - 1] = rigid_motion(rows[:, :3], rows[:, 3])
        for number, image in _images(folder / camera):
            if path.exists() and number not in poses:
                raise ValueError(f"{path} has no line {number + 1}, the pose of {image}")
            pose = poses[number] @ shift if path.exists() else np.full((4, 4), np.nan)
            frames.append(Frame(image, image.relative_to(root).as_posix(), name, image_size(image), K, pose))
    return frames


def read_calibration(path: Path, key: str) -> tuple[Array, Array]:
    """Return a camera's matrix (3, 3) and its pose in camera 0 (4, 4) from its projection K (I | b) in ``calib.txt``.

    ``key`` is the projection's name, ``P0`` to ``P3`` for ``image_0`` to ``image_3``; ValueError without it.
    """
    for line in text_lines(path, "calibration"):
        name, _, rest = line.text.partition(":")
        if name.strip() == key:
            numbers = line.numbers(rest.split(), 12, f"{key}: and 12 numbers")
            K, b = np.split(numbers.reshape(3, 4), [3], 1)
            if min(K[0, 0], K[1, 1]) <= 0 or K[1, 0] or K[2].tolist() != [0, 0, 1]:
                raise line.error("a camera matrix and a fourth column")
            return K, rigid_motion(np.eye(3), np.asarray(-np.linalg.solve(K, b)[:, 0], np.float64))
    raise ValueError(f"{path} has no line '{key}: 12 numbers'")


def _images(folder: Path) -> list[tuple[int, Path]]:
    if not (images := list(folder.glob("*.png"))):
        raise FileNotFoundError(f"no images *.png in {folder}")
    if wrong := [image for image in images if not (image.stem.isascii() and image.stem.isdecimal())]:
        raise ValueError(f"{wrong[0]}: an image's name must be its frame's number, as in 000000.png")
    return sorted((int(image.stem), image) for image in images)

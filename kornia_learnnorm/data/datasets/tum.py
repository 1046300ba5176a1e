"""TUM RGB-D as frames."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.sequences import choose_sequences
from kornia_learnnorm.data.datasets.textfiles import Array, camera_matrix, rigid_motion, text_lines
from kornia_learnnorm.data.images import image_size

# fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3 of the three Kinects; https://cvg.cit.tum.de/data/datasets/rgbd-dataset,
# file formats, calibration of the colour camera. The images of the third are already undistorted.
KINECTS: dict[str, tuple[Array, tuple[float, ...]]] = {
    "1": (camera_matrix(517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": (camera_matrix(520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": (camera_matrix(535.4, 539.2, 320.1, 247.6), ()),
}


def read_tum(root: str | Path, sequences: Sequence[str] | None = None, max_difference: float = 0.02) -> list[Frame]:
    """Return the frames of the TUM RGB-D benchmark (J. Sturm et al., IROS 2012), by sequence and time.

    ``root`` is a sequence's folder, with ``rgb.txt`` and ``groundtruth.txt``, metres, or a folder of sequences, of
    which ``sequences`` are names in the order to read, None for all. A frame gets the nearest pose, the earlier one of
    a tie, or NaN if there is none within ``max_difference`` seconds. Cameras are NaN unless the folder's name has
    ``freiburg1`` to ``freiburg3`` or ``fr1`` to ``fr3`` in it. FileNotFoundError if there is no sequence, or an image
    is missing; ValueError if a sequence is unknown, a line malformed, a file empty or ``max_difference`` negative.
    """
    root = Path(root)
    if not max_difference >= 0:
        raise ValueError(f"max_difference must be zero or more seconds, got {max_difference}")
    frames = []
    for name, folder in choose_sequences("tum", root, sequences).items():
        kinect = re.search(r"(?<![a-z])fr(?:eiburg)?([1-3])(?!\d)", name)
        K, distortion = KINECTS[kinect[1]] if kinect else (np.full((3, 3), np.nan), ())
        trajectory = _trajectory(folder / "groundtruth.txt")
        for time, listed in _images(folder):
            # Stamps have microseconds; at 1e9 s float64 resolves a quarter of one, which must not decide on ties.
            differences = np.abs(trajectory[:, 0] - time).round(6)
            pose = np.full((4, 4), np.nan)
            if len(differences) and differences.min() <= max_difference:
                row = trajectory[differences.argmin()]
                pose = rigid_motion(row[4:], row[1:4])
            image, short = folder / listed, str(PurePosixPath(folder.relative_to(root), listed))
            frames.append(Frame(image, short, name, image_size(image), K, pose, distortion))
    return frames


def _images(folder: Path) -> list[tuple[float, str]]:
    path, images = folder / "rgb.txt", []
    for line in text_lines(path, "list of images"):
        time, _, name = line.text.replace("\t", " ").partition(" ")
        seconds = line.numbers([time] if name else [], 1, "a timestamp and a file name")
        images.append((float(seconds[0]), line.image(name.strip())))
    if not images:
        raise ValueError(f"{path} lists no images")
    return sorted(images)


def _trajectory(path: Path) -> Array:
    """Return times, translations and unit quaternions (w, x, y, z) by time, (N, 8); N = 0 without a file."""
    rows = []
    for line in text_lines(path, "poses") if path.exists() else ():
        row = line.numbers(line.text.split(), 8, "timestamp tx ty tz qx qy qz qw")
        rows.append([*row[:4], *line.quaternion(row[[7, 4, 5, 6]])])
    if not rows and path.exists():
        raise ValueError(f"{path} has no poses")
    return np.array(sorted(rows, key=lambda row: row[0])).reshape(-1, 8)

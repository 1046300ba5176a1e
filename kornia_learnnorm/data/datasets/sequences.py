r"""Readers of image sequences: KITTI odometry, TUM RGB-D and plain folders of images.

Each returns frames, sequence after sequence, in their order. Of the images only the headers are read, by Pillow; it
comes with the ``images`` extra and is imported only when a function here is called. An image that cannot be read does
not stop a reader: its frame has size (0, 0).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.textfiles import (
    camera_matrix,
    listed_image,
    parent_name,
    parse_numbers,
    rigid_motion,
    rotation,
    text_lines,
)
from kornia_learnnorm.data.images import image_size

__all__ = ["SPLITS", "read_folder", "read_kitti", "read_tum", "split_sequences"]

Array = NDArray[np.float64]

SPLITS: dict[str, dict[str, tuple[str, ...] | None]] = {
    "kitti": {"train": ("00", "01", "02", "03", "04", "05"), "test": ("06", "07", "08", "09", "10")},
    "tum": {"train": None, "val": ("rgbd_dataset_freiburg3_long_office_household",)},
    "cambridge": {"train": ("StMarysChurch",), "test": ("StMarysChurch",)},
}
"""Sequences by dataset and split, as B. Fan et al. (A revisit of the normalized eight-point algorithm and a
self-supervised deep solution, section 5.1) choose them; None for all that no other split of the dataset names. The
scene of Cambridge Landmarks splits its images itself, see
:func:`~kornia_learnnorm.data.datasets.cambridge.read_cambridge`."""

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}
# fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3 of the three Kinects; https://cvg.cit.tum.de/data/datasets/rgbd-dataset,
# file formats, calibration of the colour camera. The images of the third are already undistorted.
_KINECTS: dict[str, tuple[tuple[float, float, float, float], tuple[float, ...]]] = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}


def split_sequences(dataset: str, split: str, root: str | Path) -> list[str]:
    """Return the names of a split's sequences that are below a folder, for the readers' ``sequences``.

    Args:
        dataset: a key of :data:`SPLITS`.
        split: a key of its splits.
        root: what the reader takes; for ``cambridge`` a scene's folder or the folder of the scenes.

    Raises:
        FileNotFoundError: if there is no sequence of the dataset, or none of the split.
        ValueError: if there is no such dataset or split.

    """
    if dataset not in SPLITS:
        raise ValueError(f"a dataset with splits must be one of {', '.join(SPLITS)}, got {dataset!r}")
    splits = SPLITS[dataset]
    if split not in splits:
        raise ValueError(f"a split of {dataset} must be one of {', '.join(splits)}, got {split!r}")
    if dataset == "kitti":
        found = _kitti_folders(Path(root))
    else:
        found = _marked_folders(Path(root), "rgb.txt" if dataset == "tum" else "dataset_train.txt")
    wanted, taken = splits[split], [name for names in splits.values() for name in names or ()]
    chosen = [name for name in found if (name not in taken if wanted is None else name in wanted)]
    if not chosen:
        expected = f"others than {', '.join(taken)}" if wanted is None else ", ".join(wanted)
        raise FileNotFoundError(f"no {split} sequence of {dataset} at {root}: expected {expected}, got {_some(found)}")
    return chosen


def read_kitti(root: str | Path, sequences: Sequence[str] | None = None, camera: str = "image_0") -> list[Frame]:
    """Read the KITTI odometry benchmark (A. Geiger et al., CVPR 2012; conventions of its development kit).

    Args:
        root: folder with ``sequences/SS/calib.txt``, ``sequences/SS/image_N/*.png`` and ``poses/SS.txt``, metres.
        sequences: names ``SS`` in the order to read; None for all.
        camera: ``image_0`` and ``image_1`` are grey, ``image_2`` and ``image_3`` colour, left and right.

    Returns:
        the frames; poses are NaN where a sequence has no file of poses, as 11 to 21 have none.

    Raises:
        FileNotFoundError: if a folder, an image of a sequence or a ``calib.txt`` is missing.
        ValueError: if a sequence or camera is unknown, a line is malformed, a frame has no pose, or a file's name is no
            number.
        TypeError: if ``sequences`` is a string.

    """
    root = Path(root)
    if camera not in {f"image_{number}" for number in range(4)}:
        raise ValueError(f"a camera of KITTI must be one of image_0 to image_3, got {camera!r}")
    frames = []
    for name, folder in _chosen(_kitti_folders(root), sequences, root).items():
        K, shift = _kitti_camera(folder / "calib.txt", f"P{camera[-1]}")
        path = root / "poses" / f"{name}.txt"
        poses = _kitti_poses(path) if path.exists() else None
        for number, image in _kitti_images(folder / camera):
            if poses is not None and number not in poses:
                raise ValueError(f"{path} has no line {number + 1}, the pose of {image}")
            pose = np.full((4, 4), np.nan) if poses is None else poses[number] @ shift
            frames.append(Frame(image, image.relative_to(root).as_posix(), name, image_size(image), K, pose))
    return frames


def _kitti_folders(root: Path) -> dict[str, Path]:
    parent = root / "sequences"
    if not parent.is_dir():
        raise FileNotFoundError(f"no folder {parent}: KITTI's sequences are expected in it")
    return {folder.name: folder for folder in sorted(parent.iterdir()) if folder.is_dir()}


def _kitti_camera(path: Path, key: str) -> tuple[Array, Array]:
    """Read a camera's matrix (3, 3) and its pose in camera 0 (4, 4) from its projection K (I | b)."""
    for number, line in text_lines(path, "calibration"):
        name, _, rest = line.partition(":")
        if name.strip() != key:
            continue
        K, b = np.split(
            parse_numbers(path, number, rest.split(), 12, f"{key}: and 12 numbers", line).reshape(3, 4), [3], 1
        )
        if min(K[0, 0], K[1, 1]) <= 0 or K[1, 0] or K[2].tolist() != [0, 0, 1]:
            raise ValueError(f"{path}, line {number}: a camera matrix beside a fourth column expected, got {line!r}")
        return K, rigid_motion(np.eye(3), np.asarray(-np.linalg.solve(K, b)[:, 0], np.float64))
    raise ValueError(f"{path} has no line '{key}: 12 numbers'")


def _kitti_poses(path: Path) -> dict[int, Array]:
    poses = {}
    for number, line in text_lines(path, "poses"):
        rows = parse_numbers(path, number, line.split(), 12, "the 12 numbers of a pose").reshape(3, 4)
        poses[number - 1] = rigid_motion(rows[:, :3], rows[:, 3])
    return poses


def _kitti_images(folder: Path) -> list[tuple[int, Path]]:
    images = list(folder.glob("*.png"))
    if not images:
        raise FileNotFoundError(f"no images *.png in {folder}")
    for image in images:
        if not (image.stem.isascii() and image.stem.isdecimal()):
            raise ValueError(f"{image}: an image's name must be its frame's number, as in 000000.png")
    return sorted((int(image.stem), image) for image in images)


def read_tum(root: str | Path, sequences: Sequence[str] | None = None, max_difference: float = 0.02) -> list[Frame]:
    """Read the TUM RGB-D benchmark (J. Sturm et al., IROS 2012; conventions and cameras of its file formats page).

    Args:
        root: a sequence's folder, with ``rgb.txt`` and ``groundtruth.txt``, metres, or a folder of such folders.
        sequences: names of folders in the order to read; None for all.
        max_difference: a frame has the pose that is nearest in time, the earlier of two; NaN beyond this, seconds.

    Returns:
        the frames by time; cameras are NaN where a folder's name has none of ``freiburg1`` to ``freiburg3``, or ``fr1``
        to ``fr3``, poses where it has no ``groundtruth.txt``, as the benchmark's own test sequences.

    Raises:
        FileNotFoundError: if there is no sequence, or an image that ``rgb.txt`` lists is missing.
        ValueError: if a sequence is unknown, a line malformed, a file without entries or ``max_difference`` negative.
        TypeError: if ``sequences`` is a string.

    """
    root = Path(root)
    if not max_difference >= 0:
        raise ValueError(f"max_difference must be zero or more seconds, got {max_difference}")
    frames = []
    for name, folder in _chosen(_marked_folders(root, "rgb.txt"), sequences, root).items():
        K, distortion = _tum_camera(name)
        times, poses = _tum_trajectory(folder / "groundtruth.txt")
        for time, listed in _tum_images(folder):
            # Stamps have microseconds; at 1e9 s float64 resolves a quarter of one, which must not decide on ties.
            differences = np.abs(times - time).round(6)
            known = len(times) > 0 and differences.min() <= max_difference
            pose = poses[int(differences.argmin())] if known else np.full((4, 4), np.nan)
            image, short = folder / listed, str(PurePosixPath(folder.relative_to(root), listed))
            frames.append(Frame(image, short, name, image_size(image), K, pose, distortion))
    return frames


def _tum_camera(name: str) -> tuple[Array, tuple[float, ...]]:
    """Return the camera matrix (3, 3) and the distortion of a sequence; NaN and none where its name does not tell."""
    kinect = re.search(r"(?<![a-z])fr(?:eiburg)?([1-3])(?!\d)", name)
    if kinect is None:
        return np.full((3, 3), np.nan), ()
    focal, distortion = _KINECTS[kinect[1]]
    return camera_matrix(*focal), distortion


def _tum_images(folder: Path) -> list[tuple[float, str]]:
    path, images = folder / "rgb.txt", []
    for number, line in text_lines(path, "list of images"):
        time, _, listed = line.replace("\t", " ").partition(" ")
        seconds = parse_numbers(path, number, [time] if listed else [], 1, "a timestamp and a file name", line)
        images.append((float(seconds[0]), listed_image(path, number, listed.strip())))
    if not images:
        raise ValueError(f"{path} lists no images")
    return sorted(images)


def _tum_trajectory(path: Path) -> tuple[Array, Array]:
    """Read the times (N,) and the poses (N, 4, 4) by time; N = 0 where there is no file."""
    if not path.exists():
        return np.empty(0), np.empty((0, 4, 4))
    rows = []
    for number, line in text_lines(path, "poses"):
        row = parse_numbers(path, number, line.split(), 8, "timestamp tx ty tz qx qy qz qw")
        rows.append((row[0], rigid_motion(rotation(path, number, row[[7, 4, 5, 6]]), row[1:4])))
    if not rows:
        raise ValueError(f"{path} has no poses")
    rows.sort(key=lambda row: row[0])
    return np.array([time for time, _ in rows]), np.array([pose for _, pose in rows])


def read_folder(root: str | Path) -> list[Frame]:
    """Read a folder of images and its subfolders, each of which is a sequence; hidden ones are left out.

    Args:
        root: a folder with images; png, jpg, jpeg, bmp, tif, tiff, webp, pgm or ppm, whatever the case.

    Returns:
        the frames by folder and name; cameras and poses are NaN.

    Raises:
        FileNotFoundError: if there is no such folder, or no image in it.

    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    paths = [path for path in root.rglob("*") if path.suffix.lower() in _SUFFIXES and path.is_file()]
    names = [path.relative_to(root).as_posix() for path in paths]
    names = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]
    if not names:
        raise FileNotFoundError(f"no images ({', '.join(sorted(_SUFFIXES))}) in {root}")
    names.sort(key=lambda name: (parent_name(name), name))
    return [Frame(root / name, name, parent_name(name), image_size(root / name)) for name in names]


def _marked_folders(root: Path, marker: str) -> dict[str, Path]:
    """Return the folder itself where it has the file, otherwise its subfolders that have it, by name."""
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    folders = [root] if (root / marker).exists() else sorted(root.iterdir())
    found = {folder.resolve().name: folder for folder in folders if (folder / marker).exists()}
    if not found:
        raise FileNotFoundError(f"no {marker} in {root}, nor in a folder in it")
    return found


def _chosen(found: dict[str, Path], sequences: Sequence[str] | None, root: Path) -> dict[str, Path]:
    if isinstance(sequences, str):
        raise TypeError(f"sequences must be a list of names, got the string {sequences!r}")
    names = list(found if sequences is None else sequences)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"sequences must be one name or more, each once, got {names}")
    for name in names:
        if name not in found:
            raise ValueError(f"no sequence {name!r} at {root}, there are {_some(found)}")
    return {name: found[name] for name in names}


def _some(names: dict[str, Path]) -> str:
    return ", ".join(islice(names, 30)) + (", ..." if len(names) > 30 else "") or "none"

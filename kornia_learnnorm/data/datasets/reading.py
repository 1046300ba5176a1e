"""Reading a dataset by its name, or a folder of images, and naming the ground truth that is missing."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kornia_learnnorm.data.datasets import cambridge, colmap, kitti, tum
from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.sequences import sequence_folders, split_sequences
from kornia_learnnorm.data.images import image_size

__all__ = ["read_folder"]

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}  # in any case


def read_folder(root: str | Path) -> list[Frame]:
    """Return the images of a folder and its subfolders as frames by folder and name, each folder a sequence.

    Numbers in names count as numbers: 9.png comes before 10.png. Links to folders are not followed. Images
    have the suffix png, jpg, jpeg, bmp, tif, tiff, webp, pgm or ppm, whatever the case; hidden files and folders are
    skipped. A folder without images is a FileNotFoundError.
    """
    root = Path(root)
    paths = [path for path in root.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    names = [name for name in (path.relative_to(root).as_posix() for path in paths) if "/." not in f"/{name}"]
    if not names:
        raise FileNotFoundError(f"no images ({', '.join(sorted(SUFFIXES))}) in {root}")
    numbered = {name: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)] for name in names}
    names.sort(key=lambda name: (name.rpartition("/")[0], numbered[name], name))
    return [Frame(root / name, name, name.rpartition("/")[0], image_size(root / name)) for name in names]


# name: title, reader, and the options that the reader takes
DATASETS: dict[str, tuple[str, Callable[..., list[Frame]], tuple[str, ...]]] = {
    "kitti": ("KITTI odometry", kitti.read_kitti, ("sequences", "split", "camera")),
    "tum": ("TUM RGB-D", tum.read_tum, ("sequences", "split", "max_difference")),
    "cambridge": ("Cambridge Landmarks", cambridge.read_cambridge, ("split",)),
    "folder": ("images of", read_folder, ()),
    "colmap": ("COLMAP model", lambda root, model: colmap.read_colmap(model, root), ("model",)),
}


def read_dataset(dataset: str, root: str | Path, **options: Any) -> list[Frame]:
    """Return the frames of a dataset, a key of ``DATASETS``, by the arguments of its reader or ``split``."""
    if dataset not in DATASETS:
        raise ValueError(f"a dataset must be one of {', '.join(DATASETS)}, got {dataset!r}")
    _, read, known = DATASETS[dataset]
    for name in options.keys() - set(known):
        takers = " and ".join(key for key, (_, _, names) in DATASETS.items() if name in names) or "no dataset"
        raise ValueError(f"{name} is for {takers}, got {dataset}")
    if dataset == "colmap" and "model" not in options:
        raise ValueError("colmap needs a model, the folder of cameras, images and points, got none")
    if not Path(root).is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    if "split" in options and "sequences" in known:
        if "sequences" in options:
            raise ValueError("sequences and split exclude each other, got both")
        options["sequences"] = split_sequences(dataset, options.pop("split"), root)
    return read(root, **options)


def missing_ground_truth(dataset: str, root: str | Path, frames: Sequence[Frame]) -> list[str]:
    """Return a line for each file and camera that a dataset lacks, without which pairs have no ground truth."""
    root = Path(root)
    sequences, wanted, lines = {frame.sequence: frame for frame in frames}, dict[str, Path](), list[str]()
    if dataset == "kitti":
        wanted = {f"pose known for sequence {name}": root / "poses" / f"{name}.txt" for name in sequences}
    elif dataset == "tum":
        folders = sequence_folders("tum", root)
        wanted = {f"pose known for sequence {name}": folders[name] / "groundtruth.txt" for name in sequences}
        unknown = [name for name, frame in sequences.items() if not np.isfinite(frame.camera).all()]
        lines = [f"no camera known for sequence {name}: its name has no fr1, fr2 or fr3" for name in unknown]
    elif dataset == "cambridge":
        wanted = {"camera known": root / "reconstruction.nvm"}
    return lines + [f"no {what}: no file {path}" for what, path in wanted.items() if not path.exists()]

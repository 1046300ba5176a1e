"""What a dataset lacks for ground truth, in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.sequences import _marked_folders

__all__ = ["missing_ground_truth"]


def missing_ground_truth(reader: str, root: str | Path, frames: Sequence[Frame]) -> list[str]:
    """Say which files and cameras a reader did not find, without which pairs have no ground truth.

    Args:
        reader: ``kitti``, ``tum`` or ``cambridge``; of other readers there is nothing to say.
        root: what the reader read.
        frames: what it returned.

    Returns:
        a line for each thing that is not there.

    """
    root = Path(root)
    sequences = {frame.sequence: frame for frame in frames}
    wanted: dict[str, Path] = {}
    lines = []
    if reader == "kitti":
        wanted = {f"pose known for sequence {name}": root / "poses" / f"{name}.txt" for name in sequences}
    elif reader == "tum":
        folders = _marked_folders(root, "rgb.txt")
        wanted = {f"pose known for sequence {name}": folders[name] / "groundtruth.txt" for name in sequences}
        unknown = [name for name, frame in sequences.items() if not np.isfinite(frame.camera).all()]
        lines = [f"no camera known for sequence {name}: its name has no fr1, fr2 or fr3" for name in unknown]
    elif reader == "cambridge":
        wanted = {"camera known": root / "reconstruction.nvm"}
    return lines + [f"no {what}: no file {path}" for what, path in wanted.items() if not path.exists()]

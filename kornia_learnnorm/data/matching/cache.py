"""A cache on disk for the features of frames."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.datasets.frames import Frame, FramePair
from kornia_learnnorm.data.matching.features import Features

__all__ = ["FeatureCache"]


class FeatureCache:
    """Keep the features of frames in a folder, each until the last of all ``pairs`` with the frame is released.

    The context manager starts with an empty folder, without what a killed run left, and removes it at the end.
    """

    def __init__(self, folder: Path, pairs: Sequence[FramePair]) -> None:
        self.folder = folder
        self.uses = Counter(frame.name for pair in pairs for frame in pair)
        self.held: dict[str, Path | str] = {}

    def __enter__(self) -> FeatureCache:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def missing(self, pairs: Sequence[FramePair]) -> list[Frame]:
        """Return the frames of the pairs that have not been put, each once."""
        frames = {frame.name: frame for pair in pairs for frame in pair}
        return [frame for name, frame in frames.items() if name not in self.held]

    def put(self, frame: Frame, features: Features | str) -> None:
        """Keep the features of a frame, or the reason why it has none; OSError on a full disk."""
        if isinstance(features, str):
            self.held[frame.name] = features
            return
        path = self.folder / f"{sha256(frame.name.encode()).hexdigest()}.npz"
        try:
            np.savez(path, points=features.points, descriptors=features.descriptors, size=features.size)
        except OSError as error:  # NumPy's message does not name the file
            target = f"the features of {frame.name} to {self.folder}"
            raise OSError(f"cannot write {target}, is the disk full? {error}") from error
        self.held[frame.name] = path

    def get(self, pair: FramePair) -> tuple[Features | str, Features | str]:
        """Return the features of both frames of a pair, or the reason why there are none."""
        return self._get(pair.frame1), self._get(pair.frame2)

    def _get(self, frame: Frame) -> Features | str:
        held = self.held[frame.name]
        if isinstance(held, str):
            return held
        with np.load(held) as data:
            width, height = data["size"].tolist()
            return Features(data["points"], data["descriptors"], (width, height))

    def release(self, pair: FramePair) -> None:
        """Mark a pair as done and delete features that no other pair needs."""
        for frame in pair:
            self.uses[frame.name] -= 1
            if self.uses[frame.name] == 0:
                held = self.held.pop(frame.name)
                if isinstance(held, Path):
                    held.unlink()

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
        self.held: dict[str, str] = {}  # name -> reason why there are none; empty where there are some

    def __enter__(self) -> FeatureCache:
        self.__exit__()
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
        self.held[frame.name] = features if isinstance(features, str) else ""
        if not isinstance(features, str):
            try:
                np.savez(self._path(frame), **features._asdict())
            except OSError as error:  # NumPy's message does not name the file
                target = f"the features of {frame.name} to {self.folder}"
                raise OSError(f"cannot write {target}, is the disk full? {error}") from error

    def get(self, frame: Frame) -> Features | str:
        """Return the features of a frame, or the reason why there are none."""
        if reason := self.held[frame.name]:
            return reason
        with np.load(self._path(frame)) as data:
            return Features(data["points"], data["descriptors"], tuple(data["size"].tolist()))

    def release(self, pair: FramePair) -> None:
        """Mark a pair as done and delete features that no other pair needs."""
        for frame in pair:
            self.uses[frame.name] -= 1
            if self.uses[frame.name] == 0:
                self._path(frame).unlink(missing_ok=True)

    def _path(self, frame: Frame) -> Path:
        return self.folder / f"{sha256(frame.name.encode()).hexdigest()}.npz"

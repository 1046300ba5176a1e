r"""Frames and pairs of frames: what a reader of a dataset yields and what matching takes.

Pixels follow OpenCV: the centre of the top left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["Frame", "FramePair", "listed_pairs", "pair_frames", "resize_frames"]

Size = tuple[int, int]


def _unknown(*shape: int) -> NDArray[np.float64]:
    return np.full(shape, np.nan)


@dataclass(frozen=True, eq=False)
class Frame:
    """An image, its camera and its pose.

    Attributes:
        path: the image file.
        name: what stores call it: its path below the root of the dataset, with slashes.
        sequence: what it belongs to; only frames of one sequence are paired by their order.
        size: (width, height) of the file, pixels; (0, 0) where it cannot be read.
        camera: camera matrix of the file's pixels, (3, 3) float64, NaN where unknown.
        pose: camera to world, metres, (4, 4) float64, NaN where unknown.
        distortion: OpenCV's ``k1, k2, p1, p2[, k3]`` of the file's pixels, which are undistorted before matching;
            empty for none.
        resized: (width, height) to resize to after undistortion; None keeps the file's.
    """

    path: Path
    name: str
    sequence: str
    size: Size
    camera: NDArray[np.float64] = field(default_factory=lambda: _unknown(3, 3))
    pose: NDArray[np.float64] = field(default_factory=lambda: _unknown(4, 4))
    distortion: tuple[float, ...] = ()
    resized: Size | None = None

    @property
    def matched_size(self) -> Size:
        """(width, height) of the image that is matched."""
        return self.resized or self.size

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """Camera matrix of the image that is matched, (3, 3); resizing keeps the outer edges of the image in place."""
        x, y = (new / old if old else 1.0 for new, old in zip(self.matched_size, self.size, strict=True))
        scale = np.array([[x, 0.0, x / 2 - 0.5], [0.0, y, y / 2 - 0.5], [0.0, 0.0, 1.0]])
        return np.asarray(scale @ self.camera)


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames.

    Attributes:
        frame1: the first view.
        frame2: the second view.
    """

    frame1: Frame
    frame2: Frame

    @property
    def motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation R (3, 3) and translation t (3,) of x2 = R x1 + t, NaN where a pose is unknown."""
        if not (np.isfinite(self.frame1.pose).all() and np.isfinite(self.frame2.pose).all()):
            return _unknown(3, 3), _unknown(3)
        pose1, pose2 = self.frame1.pose, self.frame2.pose
        R = np.linalg.solve(pose2[:3, :3], pose1[:3, :3])
        # The difference first: a camera that stood still has a translation of exactly zero.
        t = np.linalg.solve(pose2[:3, :3], pose1[:3, 3] - pose2[:3, 3])
        return np.asarray(R, np.float64), np.asarray(t, np.float64)

    @property
    def F(self) -> NDArray[np.float64]:  # noqa: N802
        """Ground truth with x2^T F x1 = 0 and unit norm, (3, 3); NaN where unknown or where the camera did not move."""
        R, t = self.motion
        K1, K2 = self.frame1.K, self.frame2.K
        if not (np.isfinite(K1).all() and np.isfinite(K2).all() and np.isfinite(t).all() and t.any()):
            return _unknown(3, 3)
        x, y, z = t
        E = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ R
        F = np.linalg.solve(K2.T, E) @ np.linalg.inv(K1)
        return np.asarray(F / np.linalg.norm(F), np.float64)


def pair_frames(frames: Iterable[Frame], gap: int = 1) -> Iterator[FramePair]:
    """Pair each frame with the one ``gap`` later in its sequence.

    Args:
        frames: frames in their order, sequence after sequence.
        gap: 1 for consecutive frames.

    Yields:
        the pairs in the order of their first frames.

    Raises:
        ValueError: if ``gap`` is not positive.

    """
    if gap < 1:
        raise ValueError(f"the gap between the frames of a pair must be at least 1, got {gap}")
    for _, group in groupby(frames, key=lambda frame: frame.sequence):
        members = list(group)
        for frame1, frame2 in zip(members, members[gap:], strict=False):
            yield FramePair(frame1, frame2)


def listed_pairs(frames: Sequence[Frame], path: str | Path) -> Iterator[FramePair]:
    """Pair the frames that a file lists: two names a line, as hloc writes them.

    Args:
        frames: the frames that the names are of.
        path: text file; ``Frame.name`` twice a line, with white space between; empty lines are skipped.

    Yields:
        the pairs in the order of the lines.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not text, or a line is not two names, names no frame, one frame twice, or the pair of
            an earlier line; the other way round is another pair.

    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no list of pairs at {path}")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text file in UTF-8: {error}") from error
    named = {frame.name: frame for frame in frames}
    first: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(lines, 1):
        names = tuple(line.split())
        if not names:
            continue
        if len(names) != 2:
            raise ValueError(f"{path}, line {number}: two names expected, got {line.strip()!r}")
        if names[0] == names[1]:
            raise ValueError(f"{path}, line {number}: two images expected, got {names[0]!r} with itself")
        if first.setdefault(names, number) != number:
            raise ValueError(f"{path}, line {number}: {line.strip()!r} is in line {first[names]} already")
        for name in names:
            if name not in named:
                some = next(iter(named), "none")
                raise ValueError(f"{path}, line {number}: no frame {name!r} among {len(named)}, such as {some!r}")
        yield FramePair(named[names[0]], named[names[1]])


def resize_frames(frames: Iterable[Frame], size: Size) -> list[Frame]:
    """Return the frames with another size to resize to; their ``K`` scale with it.

    Args:
        frames: frames of any size.
        size: (width, height), pixels.

    Raises:
        ValueError: if the size is not positive.

    """
    if min(size) < 1:
        raise ValueError(f"a size must be a positive width and height, got {size[0]} x {size[1]}")
    return [replace(frame, resized=size) for frame in frames]

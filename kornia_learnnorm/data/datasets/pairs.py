"""Pairs of frames: neighbours in a sequence, pairs that a file lists, or images of a COLMAP model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

from kornia_learnnorm.data.datasets.colmap import covisible_pairs
from kornia_learnnorm.data.datasets.frames import Frame, FramePair

__all__ = ["choose_pairs", "listed_pairs", "pair_frames"]


def choose_pairs(
    frames: Sequence[Frame],
    gap: int = 1,
    listed: Path | None = None,
    model: Path | None = None,
    min_points: int | None = None,
) -> tuple[list[FramePair], str]:
    """Return pairs of frames, and in words how they were chosen.

    Args:
        frames: frames in their order, sequence after sequence.
        gap: as for :func:`pair_frames`, which chooses the pairs unless the next arguments say otherwise.
        listed: file for :func:`listed_pairs`; None for no list.
        model: COLMAP model for :func:`~kornia_learnnorm.data.datasets.colmap.covisible_pairs`.
        min_points: points that the frames of a pair share in ``model``; None for pairs by their order.

    Raises:
        ValueError: if there is no pair, ``min_points`` comes without ``model``, or as the three functions say.
        FileNotFoundError: if the list or the model is missing.

    """
    if listed is not None:
        pairs, text = list(listed_pairs(frames, listed)), f"listed in {listed.name}"
    elif min_points is not None:
        if model is None:
            raise ValueError(f"min_points {min_points} needs a COLMAP model, got none")
        pairs, text = list(covisible_pairs(model, frames, min_points)), f"sharing at least {min_points} points"
    else:
        pairs = list(pair_frames(frames, gap))
        text = "consecutive frames" if gap == 1 else f"frames {gap} apart"
    if not pairs:
        raise ValueError(f"no pairs of frames to match ({text}) among {len(frames)} frames")
    return pairs, text


def pair_frames(frames: Iterable[Frame], gap: int = 1) -> Iterator[FramePair]:
    """Yield each frame with the one ``gap`` later in its sequence.

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
    """Yield the pairs of frames that a file lists, two names a line as hloc writes them.

    Args:
        frames: the frames that can be named.
        path: text file; ``Frame.name`` twice a line, with white space between; empty lines are skipped.

    Yields:
        the pairs in the order of the lines.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not text, or a line is not two names, names an unknown frame or one frame twice, or
            repeats an earlier line; the same names in the other order are another pair.

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

"""Pairs of frames: neighbours in a sequence, pairs that a file lists, or images of a COLMAP model."""

import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, combinations, groupby, starmap
from pathlib import Path

from kornia_learnnorm.data.datasets.colmap import read_reconstruction
from kornia_learnnorm.data.datasets.frames import Frame, FramePair
from kornia_learnnorm.data.datasets.textfiles import text_lines
from kornia_learnnorm.files import explained


def choose_pairs(
    frames: Sequence[Frame],
    gap: int | None = 1,
    listed: Path | None = None,
    model: Path | None = None,
    min_points: int | None = None,
    overlap: bool = False,
) -> tuple[list[FramePair], str]:
    """Return pairs of frames, listed, by common points, ``gap`` apart or for None all, and how they were chosen.

    With ``overlap``, frames that are less than ``gap`` apart are pairs, too.
    """
    found: Iterable[FramePair]
    if listed is not None:
        found, text = listed_pairs(frames, listed), f"listed in {listed.name}"
    elif min_points is not None:
        if model is None:
            raise ValueError(f"min_points {min_points} needs a COLMAP model, got none")
        found, text = covisible_pairs(model, frames, min_points), f"sharing at least {min_points} points"
    elif gap is None:
        found, text = starmap(FramePair, combinations(frames, 2)), "all pairs"
    else:
        gaps = [*(range(1, gap) if overlap else []), gap]
        found = chain.from_iterable(pair_frames(frames, apart) for apart in gaps)
        text = "consecutive frames" if gap == 1 else f"frames {'up to ' if overlap else ''}{gap} apart"
    pairs = list(found)
    if not pairs:
        raise ValueError(f"no pairs of frames to match ({text}) among {len(frames)} frames")
    return pairs, text


def pair_frames(frames: Iterable[Frame], gap: int = 1) -> Iterator[FramePair]:
    """Yield each frame with the one ``gap`` later in its sequence; the frames come sequence after sequence."""
    if gap < 1:
        raise ValueError(f"the gap between the frames of a pair must be at least 1, got {gap}")
    for _, group in groupby(frames, key=lambda frame: frame.sequence):
        members = list(group)
        yield from map(FramePair, members, members[gap:])


def listed_pairs(frames: Sequence[Frame], path: str | Path) -> Iterator[FramePair]:
    """Yield the pairs that a file lists as hloc does: two names a line with white space between, no line twice.

    Names with spaces stand in quotation marks.
    """
    path, named = Path(path), {frame.name: frame for frame in frames}
    first: dict[tuple[str, ...], int] = {}
    for line in text_lines(path, "list of pairs"):
        names = tuple(line.text.split())
        if len(names) > 2:
            with explained(f"{path}, line {line.number}", ValueError):
                names = tuple(shlex.split(line.text))
        if len(names) != 2 or names[0] == names[1]:
            raise line.error("two names of two images")
        if first.setdefault(names, line.number) != line.number:
            raise ValueError(f"{path}, line {line.number}: {line.text!r} is in line {first[names]} already")
        if unknown := [name for name in names if name not in named]:
            what = f"no frame {unknown[0]!r} among {len(named)}, such as {next(iter(named), 'none')!r}"
            raise ValueError(f"{path}, line {line.number}: {what}")
        yield FramePair(named[names[0]], named[names[1]])


def covisible_pairs(model: str | Path, frames: Sequence[Frame], min_points: int = 30) -> Iterator[FramePair]:
    """Yield the pairs of frames that see at least ``min_points`` 3D points of a COLMAP model in common, by name."""
    if min_points < 1:
        raise ValueError(f"the frames of a pair must share at least 1 point, got min_points {min_points}")
    reconstruction, named = read_reconstruction(Path(model)), {frame.name: frame for frame in frames}
    images = {number: image.name for number, image in reconstruction.images.items()}
    if unknown := sorted(named.keys() - set(images.values())):
        raise ValueError(f"no image {unknown[0]!r} among the {len(images)} of the model {model}")
    shared: Counter[tuple[str, str]] = Counter()
    for point in reconstruction.points3D.values():
        seen_by = {images[element.image_id] for element in point.track.elements}
        shared.update(combinations(sorted(named.keys() & seen_by), 2))
    for first, second in sorted(names for names, count in shared.items() if count >= min_points):
        yield FramePair(named[first], named[second])

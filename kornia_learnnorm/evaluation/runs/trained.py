"""Whether a method was trained on a store."""

from __future__ import annotations

import re
from collections.abc import Iterable

__all__ = ["was_trained_on"]


def was_trained_on(store: str, trained_on: Iterable[str]) -> bool:
    """Return whether image pairs of a store are among the training data, going by their names.

    Args:
        store: name of a store, with ``@first:stop`` for some of its pairs.
        trained_on: the names in :attr:`~kornia_learnnorm.LearnedNormalizer.trained_on`.

    Example:
        >>> was_trained_on("tum@10:19", ["tum@0:9"]), was_trained_on("tum", ["tum@0:9"])
        (False, True)

    """
    name, first, stop = _parse(store)
    return any(name == other and first < end and start < stop for other, start, end in map(_parse, trained_on))


def _parse(store: str) -> tuple[str, float, float]:
    match = re.fullmatch(r"(.+)@(\d+):(\d+)", store)
    return (match[1], float(match[2]), float(match[3])) if match else (store, 0.0, float("inf"))

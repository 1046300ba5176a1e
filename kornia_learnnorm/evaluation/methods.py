"""The methods that an evaluation compares, by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Literal, NamedTuple

from torch import Tensor

from kornia_learnnorm.evaluation.predict import Normalizer
from kornia_learnnorm.learned import WEIGHTS, LearnedNormalizer
from kornia_learnnorm.normalizers import Hartley, Identity, Whitening
from kornia_learnnorm.refine import refine_fundamental
from kornia_learnnorm.reweighting import ReweightedWhitening
from kornia_learnnorm.search import SearchedNormalizer
from kornia_learnnorm.solver import find_fundamental

__all__ = ["DEFAULT_METHODS", "Method", "base_name", "find_method", "identify_method", "short_names"]

CLOSED_FORMS: dict[str, Callable[[], Normalizer]] = {
    "none": Identity,
    "Hartley": Hartley,
    "whitening": Whitening,
    "reweighted": ReweightedWhitening,
    "searched": SearchedNormalizer,
}
REFINED, OPTIMAL = "+LM", "+optimal"
DEFAULT_METHODS = (
    "none",
    "Hartley",
    "whitening",
    "reweighted",
    "paper",
    "crossview",
    "crossview-synthetic",
    "searched",
    "Hartley+optimal",
    "Hartley+LM",
    "crossview+LM",
)


class Method(NamedTuple):
    """A normaliser and what follows the direct linear transformation.

    Attributes:
        normalizer: maps ``(points1, points2, weights)`` to two transforms.
        solve: maps points in pixels, (B, N, 2) float64 each, and a normaliser to fundamental matrices (B, 3, 3).
    """

    normalizer: Normalizer
    solve: Callable[[Tensor, Tensor, Normalizer], Tensor]

    def estimate(self, points1: Tensor, points2: Tensor) -> Tensor:
        """Return the fundamental matrices (B, 3, 3) of points in pixels, (B, N, 2) float64 each."""
        return self.solve(points1, points2, self.normalizer)


def find_method(name: str) -> Method:
    """Return a method by its name.

    Args:
        name: ``none``, ``Hartley``, ``whitening``, ``reweighted`` or ``searched``; weights that ship or the path of a
            ``.safetensors`` file; or the import path of a normaliser class or function, ``package.module:Name``. With
            ``+LM``, the result is refined by Levenberg-Marquardt on the Sampson distance; with ``+optimal``, the
            covariance-weighted correction takes the place of the projection to rank 2.

    Raises:
        ValueError: if there is no such method.
        FileNotFoundError: if there are no such weights.

    """
    normalizer = _find_normalizer(base_name(name))
    if name.endswith(OPTIMAL):
        return Method(normalizer, lambda x1, x2, n: _solve(x1, x2, n, "optimal"))
    if name.endswith(REFINED):
        return Method(normalizer, lambda x1, x2, n: refine_fundamental(x1, x2, _solve(x1, x2, n)).F_mat)
    return Method(normalizer, _solve)


def base_name(name: str) -> str:
    """Return a method's name without what follows the normalisation.

    Example:
        >>> base_name("Hartley+LM")
        'Hartley'

    """
    return name.removesuffix(REFINED).removesuffix(OPTIMAL)


def _find_normalizer(name: str) -> Normalizer:
    if name in CLOSED_FORMS:
        return CLOSED_FORMS[name]()
    if ":" not in name:
        return LearnedNormalizer.from_pretrained(name)
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"no normaliser at {name!r}: {error}") from error
    made: Normalizer = found() if isinstance(found, type) else found
    if not callable(made):
        raise ValueError(f"{name!r} is not a normaliser: it cannot be called")
    return made


def _solve(x1: Tensor, x2: Tensor, normalizer: Normalizer, rank2: Literal["optimal"] | None = None) -> Tensor:
    return find_fundamental(x1, x2, normalizer=normalizer, rank2=rank2)


def identify_method(name: str) -> str:
    """Return what a method's predictions depend on: its name, of weights with the digest of their file."""
    base = base_name(name)
    if base in CLOSED_FORMS or ":" in base:
        return name
    path = Path(base) if Path(base).is_file() else WEIGHTS / f"{base}.safetensors"
    return f"{name} {sha256(path.read_bytes()).hexdigest()[:16]}"


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return each method's name for tables and files: of a path, the run's folder or the file's name.

    Raises:
        ValueError: if two methods have the same name.

    """
    short = {}
    for name in names:
        base = base_name(name)
        path = Path(base)
        if path.suffix == ".safetensors":
            stem = path.resolve().parent.name if path.name == "weights.safetensors" else path.stem
            short[name] = stem + name[len(base) :]
        else:
            short[name] = name
    if len(set(short.values())) < len(names):
        raise ValueError(f"two methods have the same name: {', '.join(names)}")
    return short

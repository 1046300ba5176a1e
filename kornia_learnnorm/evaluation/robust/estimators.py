"""The robust estimators that ``learnnorm robust`` compares, by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from kornia.geometry.epipolar.fundamental import run_7point

from kornia_learnnorm.evaluation.methods import OPTIMAL, REFINED, base_name, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.robust.budgets import Estimate, Estimator, Solver, best_of, peer_estimator, ransac
from kornia_learnnorm.evaluation.robust.matches import Matches
from kornia_learnnorm.evaluation.robust.peers import PEERS, find_peer, peer_version
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE

__all__ = [
    "DEFAULT_ESTIMATORS",
    "DEFAULT_SOLVERS",
    "estimator_names",
    "find_estimator",
    "find_solver",
    "identify_estimator",
    "is_slow",
    "is_timed",
]

SEVEN_POINT = "seven-point"
TRUTH = "ground-truth"
COUNT = 1000  # samples of a run of equal hypotheses
SECONDS = 0.05  # of a run of equal time
MOST = 20_000  # samples of RANSAC with a normaliser, which can be a network
DEFAULTS = "RANSAC"
KINDS = ("count:", "time:", f"{DEFAULTS}:")
_SOLVERS = ("Hartley", "whitening", "paper", "crossview", "Hartley+optimal")
DEFAULT_SOLVERS = ("none", "Hartley", "whitening", "reweighted", *_SOLVERS[2:], SEVEN_POINT, "searched")
DEFAULT_ESTIMATORS = (
    *PEERS,
    *(f"count:{name}" for name in (*_SOLVERS, SEVEN_POINT)),
    *(f"time:{name}" for name in _SOLVERS),
    DEFAULTS,
    f"{DEFAULTS}:crossview",
    TRUTH,
)


def find_solver(name: str) -> Solver:
    """Return a minimal solver by its name.

    Args:
        name: ``seven-point``, Kornia's, or as for :func:`~kornia_learnnorm.evaluation.methods.find_method`.

    Raises:
        ValueError: if there is no such method.
        FileNotFoundError: if there are no such weights.

    """
    if name == SEVEN_POINT:
        return Solver(7, run_7point)
    method = find_method(name)
    return Solver(SAMPLE_SIZE, lambda x1, x2: method.estimate(x1, x2)[:, None])


def find_estimator(name: str) -> Estimator:
    """Return a robust estimator by its name.

    Args:
        name: one of those in :mod:`~kornia_learnnorm.evaluation.robust.peers`; ``count:SOLVER``, the best of 1,000
            minimal samples, the same for all solvers; ``time:METHOD``, the best of those of 50 ms; ``RANSAC``,
            :class:`~kornia_learnnorm.RANSAC` with its defaults; ``RANSAC:METHOD``, with another normaliser and at most
            20,000 samples; ``ground-truth``, the true matrix, which says how far the others' figures can be trusted.

    Raises:
        ValueError: if there is no such estimator.
        FileNotFoundError: if there are no such weights.
        ImportError: if its package is not installed.

    """
    if name in PEERS:
        return peer_estimator(find_peer(name))
    if name == TRUTH:
        return _truth
    kind, _, method = name.partition(":")
    if kind == "count" and method:
        return best_of(COUNT, find_solver(method))
    if name == DEFAULTS:
        return ransac(None, {})
    if kind == DEFAULTS and method:
        return _ransac(method, {"max_samples": MOST})
    if kind == "time" and method:
        return _ransac(method, {"max_samples": 10**7, "max_seconds": SECONDS, "confidence": 1, "refine": False})
    raise ValueError(
        f"no estimator {name!r}: expected {', '.join(PEERS)}, count:SOLVER, time:METHOD, RANSAC, RANSAC:METHOD or "
        f"{TRUTH}"
    )


def is_slow(name: str) -> bool:
    """Return whether an estimator can take a second and more where inliers are few."""
    return not name.startswith(("opencv", TRUTH, *KINDS[:2]))


def is_timed(name: str) -> bool:
    """Return whether an estimator gets a time and not a number of samples."""
    return name.startswith("time:")


def identify_estimator(name: str) -> str:
    """Return what an estimator's or solver's figures depend on: a package's version, or the digest of weights."""
    if name in PEERS:
        return peer_version(name)
    kind, colon, method = _split(name)
    return name if method in (DEFAULTS, SEVEN_POINT, TRUTH) else f"{kind}{colon}{identify_method(method)}"


def estimator_names(names: Sequence[str]) -> dict[str, str]:
    """Return the names of estimators or solvers for tables and files: of weights, the run's folder or the file's name.

    Args:
        names: as for :func:`find_estimator` or :func:`find_solver`.

    Raises:
        ValueError: if two are the same.

    """
    short = {}
    for name in names:
        kind, colon, method = _split(name)
        short[name] = kind + colon + short_names([method])[method]
    if len(set(short.values())) < len(names):
        raise ValueError(f"two estimators have the same name: {', '.join(names)}")
    return short


def _split(name: str) -> tuple[str, str, str]:
    """Return kind, colon and method; a method may have a colon of its own."""
    return name.partition(":") if name.startswith(KINDS) else ("", "", name)


def _truth(matches: Matches, _: int, thresholds: Sequence[float]) -> list[Estimate]:
    return [Estimate(matches.F_mat, 0.0, math.nan) for _ in thresholds]


def _ransac(name: str, options: dict[str, Any]) -> Estimator:
    """RANSAC with the normaliser of a method."""
    if name.endswith(REFINED):
        raise ValueError(f"RANSAC refines by itself: {base_name(name)!r} without {REFINED}, got {name!r}")
    optimal = {"rank2": "optimal"} if name.endswith(OPTIMAL) else {}
    return ransac(find_method(name).normalizer, {**options, **optimal})

"""Robust estimators and minimal solvers by name, as ``learnnorm robust`` takes them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from kornia.geometry.epipolar.fundamental import run_7point

from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.evaluation.methods import OPTIMAL, REFINED, base_name, find_method, identify_method, short_name_of
from kornia_learnnorm.evaluation.robust.budgets import (
    Estimate,
    Estimator,
    Solver,
    best_of,
    guided_ransac,
    learned,
    peer_estimator,
    ransac,
)
from kornia_learnnorm.evaluation.robust.matches import Matches
from kornia_learnnorm.evaluation.robust.peers import CALIBRATED, PEERS, find_peer, peer_version
from kornia_learnnorm.evaluation.tables import names_of
from kornia_learnnorm.pretrained import weights_digest
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
NUM_SAMPLES = 1000  # minimal samples of count:
MAX_SECONDS = 0.05  # of a run of time:
MAX_SAMPLES = 20_000  # minimal samples of RANSAC:METHOD, whose normaliser can be a network
DEFAULTS = "RANSAC"  # RANSAC with its default options
LEARNED = ("learned:", "guided:")  # followed by the name of weights of an estimator
KINDS = ("count:", "time:", *LEARNED, f"{DEFAULTS}:")
_SOLVERS = ("Hartley", "whitening", "paper", "crossview", "Hartley+optimal")
DEFAULT_SOLVERS = ("none", "Hartley", "whitening", "reweighted", *_SOLVERS[2:], SEVEN_POINT, "searched")
DEFAULT_ESTIMATORS = (
    *(name for name in PEERS if not name.endswith(CALIBRATED)),
    *(f"count:{name}" for name in (*_SOLVERS, SEVEN_POINT)),
    *(f"time:{name}" for name in _SOLVERS),
    DEFAULTS,
    f"{DEFAULTS}:crossview",
    "learned:robust",
    "learned:robust-synthetic",
    "guided:robust",
    "guided:robust-synthetic",
    TRUTH,
)


def find_solver(name: str) -> Solver:
    """Return a minimal solver: ``seven-point``, which is Kornia's, or a name for ``find_method``."""
    if name == SEVEN_POINT:
        return Solver(7, run_7point)
    method = find_method(name)
    return Solver(SAMPLE_SIZE, lambda x1, x2: method.estimate(x1, x2)[:, None])


def find_estimator(name: str) -> Estimator:
    """Return a robust estimator by its name.

    Args:
        name: one of

            - a name in :data:`~kornia_learnnorm.evaluation.robust.peers.PEERS`;
            - ``learned:WEIGHTS``, a :class:`~kornia_learnnorm.LearnedEightPoint`; ``learned:WEIGHTS+LM``, refined with
              Geman and McClure's loss at the threshold;
            - ``guided:WEIGHTS``, RANSAC with the probabilities of the learned estimator as weights of the matches;
            - ``count:SOLVER``, the best of 1,000 minimal samples, which all solvers share;
            - ``time:METHOD``, the best of the samples drawn in 50 ms;
            - ``RANSAC``, :class:`~kornia_learnnorm.RANSAC` with its defaults;
            - ``RANSAC-calibrated``, RANSAC with the cameras of the store;
            - ``RANSAC:METHOD``, RANSAC with another normaliser and at most 20,000 samples;
            - ``ground-truth``, the true matrix, which shows how far the metrics can be trusted.

    Raises:
        ValueError: if there is no estimator of this name.
        FileNotFoundError: if there are no weights of this name.
        ImportError: if the package of the estimator is not installed.

    """
    if name in PEERS:
        return peer_estimator(find_peer(name), name.endswith(CALIBRATED))
    if name == TRUTH:
        return _truth
    kind, _, method = name.partition(":")
    if kind == "count" and method:
        return best_of(NUM_SAMPLES, find_solver(method))
    if name in (DEFAULTS, DEFAULTS + CALIBRATED):
        return ransac(None, {}, calibrated=name != DEFAULTS)
    if kind == DEFAULTS and method:
        return _ransac(method, {"max_samples": MAX_SAMPLES})
    if kind == "learned" and method:
        weights = method.removesuffix(REFINED)
        return learned(LearnedEightPoint.from_pretrained(weights), refined=weights != method)
    if kind == "guided" and method:
        return guided_ransac(LearnedEightPoint.from_pretrained(method))
    if kind == "time" and method:
        return _ransac(method, {"max_samples": 10**7, "max_seconds": MAX_SECONDS, "confidence": 1, "refine": False})
    raise ValueError(
        f"no estimator {name!r}: expected {', '.join(PEERS)}, learned:WEIGHTS, learned:WEIGHTS{REFINED},"
        f" guided:WEIGHTS, count:SOLVER, time:METHOD, RANSAC, RANSAC{CALIBRATED}, RANSAC:METHOD or {TRUTH}"
    )


def is_slow(name: str) -> bool:
    """Return whether an estimator can take more than a second on pairs with few inliers."""
    return not name.startswith(("opencv", TRUTH, "count:", "time:", "learned:"))


def is_timed(name: str) -> bool:
    """Return whether the budget of an estimator is a time instead of a number of samples."""
    return name.startswith("time:")


def identify_estimator(name: str) -> str:
    """Return what the results of an estimator or solver depend on: a package's version, or the digest of weights."""
    if name in PEERS:
        return peer_version(name)
    kind, colon, method = _split(name)
    if name.startswith(LEARNED):
        return f"{name} {weights_digest(method.removesuffix(REFINED))}"
    known = (DEFAULTS, DEFAULTS + CALIBRATED, SEVEN_POINT, TRUTH)
    return name if method in known else f"{kind}{colon}{identify_method(method)}"


def estimator_names(names: Sequence[str]) -> dict[str, str]:
    """Return short names of estimators or solvers for tables and files; raise ValueError if two are equal."""

    def shorten(name: str) -> str:
        kind, colon, method = _split(name)
        return kind + colon + short_name_of(method)

    return names_of(names, shorten, "estimators")


def _split(name: str) -> tuple[str, str, str]:
    """Return kind, colon and method; a method may have a colon of its own."""
    return name.partition(":") if name.startswith(KINDS) else ("", "", name)


def _truth(matches: Matches, _: int, thresholds: Sequence[float]) -> list[Estimate]:
    return [Estimate(matches.F_mat, 0.0, math.nan) for _ in thresholds]


def _ransac(name: str, options: dict[str, Any]) -> Estimator:
    """Return RANSAC with the normaliser of a method."""
    if name.endswith(REFINED):
        raise ValueError(f"RANSAC refines by itself: expected {base_name(name)!r} without {REFINED}, got {name!r}")
    optimal = {"rank2": "optimal"} if name.endswith(OPTIMAL) else {}
    return ransac(find_method(name).normalizer, {**options, **optimal})

"""Robust estimators by name, as ``learnnorm robust`` takes them."""

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.geometry.epipolar import fundamental_from_essential
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm import RANSAC, GemanMcClure, LearnedEightPoint, LearnedRelativePose, refine_fundamental
from kornia_learnnorm.evaluation.methods import REFINED, base_name, find_method, identify_method, short_name_of
from kornia_learnnorm.evaluation.robust.peers import CALIBRATED, PEERS, Peer, find_peer, peer_version
from kornia_learnnorm.evaluation.tables import names_of
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.pretrained import weights_model, weights_path

TRUTH = "ground-truth"
MAX_SAMPLES = 20_000  # minimal samples of RANSAC:METHOD, whose normaliser can be a network
DEFAULTS = "RANSAC"  # RANSAC with its default options
LEARNED, GUIDED = "learned:", "guided:"  # followed by the name of weights of an estimator
SCORED = "+scores"  # suffix of a learned estimator that reads the scores of the matches
KINDS = (LEARNED, GUIDED, f"{DEFAULTS}:")
DEFAULT_ESTIMATORS = (
    *(name for name in PEERS if not name.endswith(CALIBRATED)),
    DEFAULTS,
    f"{DEFAULTS}:crossview",
    *(kind + weights for kind in (LEARNED, GUIDED) for weights in ("robust", "robust-synthetic")),
    TRUTH,
)


class EvaluatedPair(NamedTuple):
    """The correspondences of an image pair, in the order in which estimators get them, and its ground truth."""

    points1: Tensor  # pixels in the first image, (N, 2) float64
    points2: Tensor  # pixels in the second image, (N, 2) float64
    F_mat: Tensor  # true fundamental matrix, (3, 3)
    K: Tensor  # camera matrices, (2, 3, 3)
    R: Tensor  # true rotation, (3, 3)
    t: Tensor  # true translation, (3,)
    size: NDArray[np.int32]  # (width, height) of both images, (2, 2)
    scores: Tensor  # of the correspondences, those of the store, (N,)


class Estimate(NamedTuple):
    """A fundamental matrix, its time and its number of samples."""

    F_mat: Tensor  # (3, 3) float64; NaN for a failure
    seconds: float  # wall-clock time
    samples: float  # number of minimal samples solved; NaN if unknown


Learned = LearnedEightPoint | LearnedRelativePose
Found = tuple[Tensor | None, float]  # a matrix, None for a failure, and the number of minimal samples
Estimator = Callable[[EvaluatedPair, int, float], Found]  # of a pair, a seed and a threshold in pixels


@torch.no_grad()
def run_estimator(estimator: Estimator, pair: EvaluatedPair, seed: int, threshold: float) -> Estimate:
    """Return the estimate and its time; a failure if there are fewer than eight correspondences."""
    start = time.perf_counter()
    F_mat, samples = (None, 0.0) if len(pair.points1) < Fundamental.min_points else estimator(pair, seed, threshold)
    seconds = time.perf_counter() - start
    return Estimate(torch.full((3, 3), torch.nan).double() if F_mat is None else F_mat, seconds, samples)


def find_estimator(name: str) -> Estimator:
    """Return a robust estimator by its name; raise ValueError, FileNotFoundError or ImportError if there is none.

    Args:
        name: one of

            - a name in :data:`~kornia_learnnorm.evaluation.robust.peers.PEERS`;
            - ``learned:WEIGHTS``, a :class:`~kornia_learnnorm.LearnedEightPoint`, or a
              :class:`~kornia_learnnorm.LearnedRelativePose` with the cameras of the store; ``+scores`` behind it reads
              the scores of the matches, ``+LM`` refines with Geman and McClure's loss at the threshold;
            - ``guided:WEIGHTS``, RANSAC with the probabilities of the learned estimator as weights of the matches;
            - ``RANSAC``, :class:`~kornia_learnnorm.RANSAC` with its defaults;
            - ``RANSAC-calibrated``, RANSAC with the cameras of the store;
            - ``RANSAC:METHOD``, RANSAC with another normaliser and at most 20,000 samples;
            - ``ground-truth``, the true matrix, which shows how far the metrics can be trusted.
    """
    kind, method = _split(name)
    if name in PEERS:
        return partial(_peer, find_peer(name), name.endswith(CALIBRATED))
    if name == TRUTH:
        return lambda pair, *_: (pair.F_mat, math.nan)
    if name in (DEFAULTS, DEFAULTS + CALIBRATED):
        return partial(_ransac, {}, name != DEFAULTS)
    if kind == LEARNED and method:
        weights = _weights_of(method)
        calibrated = weights_model(weights) == LearnedRelativePose.model_name
        if calibrated and method.endswith(REFINED):
            raise ValueError(f"relative poses are refined by themselves: expected {weights!r}, got {method!r}")
        layer = (LearnedRelativePose if calibrated else LearnedEightPoint).from_pretrained(weights)
        return partial(_learned, layer, method)
    if kind == GUIDED and method:
        return partial(_guided, LearnedEightPoint.from_pretrained(method))
    if kind and method:
        found = find_method(method)
        if found.refined:
            raise ValueError(f"RANSAC refines by itself: expected {base_name(method)!r}, got {method!r}")
        options = {"normalizer": found.normalizer, "rank2": found.rank2, "max_samples": MAX_SAMPLES}
        return partial(_ransac, options, False)
    own = f"learned:WEIGHTS, with {REFINED} or {SCORED}, guided:WEIGHTS, RANSAC, RANSAC{CALIBRATED}, RANSAC:METHOD"
    raise ValueError(f"no estimator {name!r}: expected {', '.join(PEERS)}, {own} or {TRUTH}")


def _peer(peer: Peer, calibrated: bool, pair: EvaluatedPair, seed: int, threshold: float) -> Found:
    if calibrated and not bool(pair.K.isfinite().all()):
        return None, math.nan
    cameras = [pair.K.numpy()] if calibrated else []
    F_mat = peer(pair.points1.numpy(), pair.points2.numpy(), pair.size, seed, threshold, *cameras)
    # OpenCV stacks up to three matrices if there are only seven points.
    good = F_mat is not None and F_mat.shape == (3, 3)
    return torch.tensor(np.array(F_mat, float)) if good else None, math.nan


def _ransac(
    options: dict[str, Any], calibrated: bool, pair: EvaluatedPair, seed: int, threshold: float, **more: Any
) -> Found:
    if calibrated and not bool(pair.K.isfinite().all()):
        return None, 0.0
    cameras = {"K1": pair.K[0], "K2": pair.K[1]} if calibrated else {}
    found = RANSAC(inl_th=threshold, seed=seed, **options).estimate(pair.points1, pair.points2, **cameras, **more)
    return found.F_mat if bool(found.F_mat.any()) else None, found.num_samples


def _learned(layer: Learned, method: str, pair: EvaluatedPair, seed: int, threshold: float) -> Found:
    points1, points2 = pair.points1[None], pair.points2[None]
    scores = pair.scores[None] if method.removesuffix(REFINED).endswith(SCORED) else None
    if isinstance(layer, LearnedRelativePose):
        if not bool(pair.K.isfinite().all()):
            return None, math.nan
        return fundamental_from_essential(layer(points1, points2, *pair.K, scores=scores)[0], *pair.K), math.nan
    F_mat = layer(points1, points2, scores=scores)
    if method.endswith(REFINED):
        F_mat = refine_fundamental(points1, points2, F_mat, loss=GemanMcClure(threshold)).F_mat
    return F_mat[0], math.nan


def _guided(layer: LearnedEightPoint, pair: EvaluatedPair, seed: int, threshold: float) -> Found:
    weights = layer.estimate(pair.points1[None], pair.points2[None]).weights[0]
    return _ransac({}, False, pair, seed, threshold, weights=weights)


def is_slow(name: str) -> bool:
    """Return whether an estimator can take more than a second on pairs with few inliers."""
    return not name.startswith(("opencv", TRUTH, LEARNED))


def identify_estimator(name: str) -> str:
    """Return what the results of an estimator depend on: a package's version, or the digest of weights."""
    if name in PEERS:
        return peer_version(name)
    kind, method = _split(name)
    if kind in (LEARNED, GUIDED):
        return f"{name} {sha256(weights_path(_weights_of(method)).read_bytes()).hexdigest()[:16]}"
    return f"{kind}{identify_method(method)}" if kind else name


def estimator_names(names: Sequence[str]) -> dict[str, str]:
    """Return short names of estimators for tables and files; raise ValueError if two are equal."""

    def shorten(name: str) -> str:
        kind, method = _split(name)
        weights = _weights_of(method)
        return kind + short_name_of(weights) + method.removeprefix(weights)

    return names_of(names, shorten, "estimators")


def _weights_of(method: str) -> str:
    return method.removesuffix(REFINED).removesuffix(SCORED)


def _split(name: str) -> tuple[str, str]:
    """Return kind, with its colon, and method, which may have a colon of its own."""
    kind = next((kind for kind in KINDS if name.startswith(kind)), "")
    return kind, name.removeprefix(kind)

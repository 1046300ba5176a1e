"""Robust estimators of other packages, with their defaults but for the threshold and the seed.

Each function takes points in pixels (N, 2), the sizes of both images, a seed and a threshold in pixels, and returns a
matrix (3, 3), or nothing where it failed. Each package means a distance of its own by its threshold.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

__all__ = ["PEERS", "Peer", "find_peer", "peer_version"]

Array = NDArray[np.float64]
Peer = Callable[[Array, Array, NDArray[np.int32], int, float], Any]


def _opencv(method: str) -> Peer:
    cv2: Any = importlib.import_module("cv2")

    def estimate(x1: Array, x2: Array, size: NDArray[np.int32], seed: int, threshold: float) -> Any:
        cv2.setRNGSeed(seed)
        return cv2.findFundamentalMat(x1, x2, getattr(cv2, method), threshold)[0]

    return estimate


def _poselib() -> Peer:
    poselib: Any = importlib.import_module("poselib")

    def estimate(x1: Array, x2: Array, size: NDArray[np.int32], seed: int, threshold: float) -> Any:
        return poselib.estimate_fundamental(x1, x2, {"max_epipolar_error": threshold, "seed": seed}, {})[0]

    return estimate


def _kornia(model: str) -> Peer:
    ransac: Any = importlib.import_module("kornia.geometry.ransac").RANSAC

    def estimate(x1: Array, x2: Array, size: NDArray[np.int32], seed: int, threshold: float) -> Any:
        points = (torch.from_numpy(x).float() for x in (x1, x2))  # its default type
        return ransac(model, inl_th=threshold, seed=seed)(*points)[0].double().numpy()

    return estimate


def _pydegensac() -> Peer:
    pydegensac: Any = importlib.import_module("pydegensac")

    def estimate(x1: Array, x2: Array, size: NDArray[np.int32], seed: int, threshold: float) -> Any:
        return pydegensac.findFundamentalMatrix(x1, x2, px_th=threshold, seed=seed + 1)[0]  # 0 is no seed

    return estimate


def _pymagsac() -> Peer:
    pymagsac: Any = importlib.import_module("pymagsac")

    def estimate(x1: Array, x2: Array, size: NDArray[np.int32], seed: int, threshold: float) -> Any:
        # Its default sampler needs a probability of every match: 0 is the uniform one.
        (w1, h1), (w2, h2) = size.tolist()
        joined, no = np.ascontiguousarray(np.hstack([x1, x2])), np.zeros(0)
        return pymagsac.findFundamentalMatrix(joined, w1, h1, w2, h2, no, sampler=0, sigma_th=threshold)[0]

    return estimate


def _pysuperansac() -> Peer:
    pysuperansac: Any = importlib.import_module("pysuperansac")

    def estimate(x1: Array, x2: Array, size: NDArray[np.int32], seed: int, threshold: float) -> Any:
        settings = pysuperansac.RANSACSettings()
        settings.inlier_threshold = threshold
        joined = np.ascontiguousarray(np.hstack([x1, x2]))
        return pysuperansac.estimateFundamentalMatrix(joined, size.ravel().astype(float).tolist(), config=settings)[0]

    return estimate


# What makes each, and the distribution that it is from.
PEERS: dict[str, tuple[Callable[[], Peer], str]] = {
    "opencv-ransac": (lambda: _opencv("FM_RANSAC"), "opencv"),
    "opencv-lmeds": (lambda: _opencv("FM_LMEDS"), "opencv"),
    "opencv-usac": (lambda: _opencv("USAC_DEFAULT"), "opencv"),
    "opencv-usac-accurate": (lambda: _opencv("USAC_ACCURATE"), "opencv"),
    "opencv-usac-magsac": (lambda: _opencv("USAC_MAGSAC"), "opencv"),
    "poselib": (_poselib, "poselib"),
    "kornia": (lambda: _kornia("fundamental"), "kornia"),
    "kornia-8pt": (lambda: _kornia("fundamental_8pt"), "kornia"),
    "pydegensac": (_pydegensac, "pydegensac"),
    "pymagsac": (_pymagsac, "pymagsac"),
    "pysuperansac": (_pysuperansac, "pysuperansac"),
}


def find_peer(name: str) -> Peer:
    """Return an estimator of another package.

    Args:
        name: one of the names in ``PEERS``.

    Raises:
        ImportError: if the package is not installed.

    """
    return PEERS[name][0]()


def peer_version(name: str) -> str:
    """Return the package of an estimator and its version.

    Args:
        name: one of the names in ``PEERS``, whose package is installed.

    """
    package = PEERS[name][1]
    if package == "opencv":  # of several distributions
        return f"opencv {importlib.import_module('cv2').__version__}"
    return f"{package} {importlib.metadata.version(package)}"

"""Robust estimators of other packages, with their defaults except for the threshold and the seed.

Each estimator takes its package, points in pixels (N, 2), the (width, height) of both images (2, 2), a seed and a
threshold in pixels, and those with the suffix ``-calibrated`` also the finite matrices of both cameras (2, 3, 3). It
returns a fundamental matrix (3, 3), or None for a failure. Each package applies the threshold to a different distance.
"""

import importlib
import importlib.metadata
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.optional import import_extra

Array = NDArray[np.float64]
Sizes = NDArray[np.int32]
Peer = Callable[..., Any]
CALIBRATED = "-calibrated"  # suffix of the names of estimators that know the cameras; a failure where a store has none


def _opencv(
    name: str, cv2: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float, K: Array | None = None
) -> Any:
    # These methods draw their samples from a generator with a fixed seed: runs differ by the order of the matches.
    method = getattr(cv2, name)
    try:
        if K is None:
            return cv2.findFundamentalMat(x1, x2, method, threshold)[0]
        E = cv2.findEssentialMat(x1, x2, K[0], None, K[1], None, method=method, threshold=threshold)[0]
    except cv2.error:  # an assertion in USAC, where it has fewer inliers than it samples
        return None
    return None if E is None or E.shape != (3, 3) else _to_pixels(E, K)


def _poselib(poselib: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float) -> Any:
    return poselib.estimate_fundamental(x1, x2, {"max_epipolar_error": threshold, "seed": seed}, {})[0]


def _poselib_calibrated(poselib: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float, K: Array) -> Any:
    cameras = [
        {"model": "PINHOLE", "width": w, "height": h, "params": [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]}
        for k, (w, h) in zip(K, sizes.tolist(), strict=True)
    ]
    pose = poselib.estimate_relative_pose(x1, x2, *cameras, {"max_epipolar_error": threshold, "seed": seed}, {})[0]
    return _to_pixels(np.cross(np.eye(3), pose.t).T @ pose.R, K) if np.any(pose.t) else None


def _to_pixels(E: Array, K: Array) -> Array:
    inverse1, inverse2 = np.linalg.inv(K)
    F: Array = inverse2.T @ E @ inverse1
    return F / np.linalg.norm(F)


def _kornia(model: str, ransac: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float) -> Any:
    points = (torch.from_numpy(x).float() for x in (x1, x2))  # float32 is its default
    return ransac.RANSAC(model, inl_th=threshold, seed=seed)(*points)[0].double().numpy()


def _pydegensac(pydegensac: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float) -> Any:
    return pydegensac.findFundamentalMatrix(x1, x2, px_th=threshold, seed=seed + 1)[0]  # 0 means no seed


def _pymagsac(pymagsac: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float) -> Any:
    (w1, h1), (w2, h2) = sizes.tolist()
    joined, no_probabilities = np.ascontiguousarray(np.hstack([x1, x2])), np.zeros(0)
    # sampler=0 is the uniform one; the default sampler needs a probability of each match.
    return pymagsac.findFundamentalMatrix(joined, w1, h1, w2, h2, no_probabilities, sampler=0, sigma_th=threshold)[0]


def _pysuperansac(pysuperansac: Any, x1: Array, x2: Array, sizes: Sizes, seed: int, threshold: float) -> Any:
    settings = pysuperansac.RANSACSettings()
    settings.inlier_threshold = threshold
    joined = np.ascontiguousarray(np.hstack([x1, x2]))
    return pysuperansac.estimateFundamentalMatrix(joined, sizes.ravel().astype(float).tolist(), config=settings)[0]


# The module that an estimator needs, of a distribution of the same name, and the function that takes it.
PEERS: dict[str, tuple[str, Callable[..., Any]]] = {
    "opencv-ransac": ("cv2", partial(_opencv, "FM_RANSAC")),
    "opencv-lmeds": ("cv2", partial(_opencv, "FM_LMEDS")),
    "opencv-usac": ("cv2", partial(_opencv, "USAC_DEFAULT")),
    "opencv-usac-accurate": ("cv2", partial(_opencv, "USAC_ACCURATE")),
    "opencv-usac-magsac": ("cv2", partial(_opencv, "USAC_MAGSAC")),
    f"opencv-usac-magsac{CALIBRATED}": ("cv2", partial(_opencv, "USAC_MAGSAC")),
    "poselib": ("poselib", _poselib),
    f"poselib{CALIBRATED}": ("poselib", _poselib_calibrated),
    "kornia": ("kornia.geometry.ransac", partial(_kornia, "fundamental")),
    "kornia-8pt": ("kornia.geometry.ransac", partial(_kornia, "fundamental_8pt")),
    "pydegensac": ("pydegensac", _pydegensac),
    "pymagsac": ("pymagsac", _pymagsac),
    "pysuperansac": ("pysuperansac", _pysuperansac),
}


def find_peer(name: str) -> Peer:
    """Return an estimator of another package by its name in ``PEERS``."""
    module, estimate = PEERS[name]
    return partial(estimate, import_extra(module, "images" if module == "cv2" else "robust", f"the estimator {name}"))


def peer_version(name: str) -> str:
    """Return the package of an estimator and its version."""
    package = PEERS[name][0].partition(".")[0]
    if package == "cv2":  # several distributions provide the module
        return f"opencv {importlib.import_module('cv2').__version__}"
    return f"{package} {importlib.metadata.version(package)}"

"""What the page of ``learnnorm demo`` shows: decoded images, the results of three methods, epipolar lines."""

from __future__ import annotations

import math
import timeit
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.images import Size, image_size, import_cv2, read_colour
from kornia_learnnorm.data.synthetic.render import render_pair
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.estimators.linear import find_fundamental
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.statistics import median
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.two_view.estimate_pair import MatchedPair, match_two_images
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

__all__ = ["MAX_BYTES", "METHODS", "Example", "ImageFile", "MethodResult"]
__all__ += ["compare", "epipolar_segment", "read_file", "render_example"]

METHODS = ("Hartley", "Learned", "RANSAC")
MAX_BYTES = 50_000_000  # of an uploaded file
SHOWN_SIZE = 1200  # pixels of the longer side of an image as the browser gets it
REPETITIONS = 3  # of a timed call, the fastest counts
EDGE = 1e-9  # pixels by which rounding may move the end of a line off the border of an image


@dataclass(frozen=True, eq=False)
class ImageFile:
    """An image file that the page shows."""

    name: str
    content: bytes
    pixels: NDArray[np.uint8]  # RGB, (H, W, 3), reduced
    size: Size  # of the full image


@dataclass(frozen=True, eq=False)
class Example:
    """A rendered image pair with exact correspondences."""

    images: tuple[ImageFile, ImageFile]
    points1: Tensor  # pixels in image 1, (M, 2), float64
    points2: Tensor  # their pixels in image 2, (M, 2), float64


@dataclass(frozen=True, eq=False)
class MethodResult:
    """What a method makes of the matches; without an estimate, why there is none."""

    estimate: PairEstimate | None  # its predicted error is NaN where the method does not predict it
    failure: str = ""
    seconds: float = math.nan  # of one call, which gives the matrix alone

    def median_distance(self, points1: Tensor, points2: Tensor) -> float:
        """Return the median distance of correspondences (N, 2) to the matrix, pixels; NaN without one."""
        if self.estimate is None:
            return math.nan
        return median(symmetric_epipolar_distance(points1, points2, self.estimate.matrix)).item()

    def as_dict(self) -> dict[str, Any]:
        """Return the estimate as ``learnnorm estimate --json`` writes it."""
        if self.estimate is None:
            raise ValueError(self.failure)
        content = self.estimate.as_dict()
        return {**content, "predicted_error_px": None} if math.isnan(self.estimate.predicted_error) else content


def read_file(name: str, content: bytes) -> ImageFile:
    """Return an image file that a user chose, decoded and reduced; the name is for messages only."""
    if len(content) > MAX_BYTES:
        raise ValueError(f"{name} has {len(content) / 1e6:.0f} MB, at most {MAX_BYTES / 1e6:.0f} MB are taken")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "image"
        path.write_bytes(content)
        try:
            return ImageFile(name, content, read_colour(path, SHOWN_SIZE), image_size(path))
        except ValueError as error:
            raise ValueError(str(error).replace(f"image {path}", name)) from error


@cache
def render_example() -> Example:
    """Return a rendered pair."""
    pair = render_pair()
    encoded = (bytes(import_cv2().imencode(".png", image)[1]) for image in (pair.image1, pair.image2))
    first, second = (read_file(f"image{number}.png", content) for number, content in enumerate(encoded, 1))
    return Example((first, second), torch.from_numpy(pair.points1), torch.from_numpy(pair.points2))


def compare(
    image1: ImageFile, image2: ImageFile, detector: str = "sift", matcher: str = "nearest"
) -> dict[str, MethodResult]:
    """Return what every method, a key of ``METHODS``, makes of the matches of two images.

    Raises NoReliableMatrixError if neither RANSAC nor the learned layer finds a matrix.
    """
    with TemporaryDirectory() as folder:
        paths = Path(folder) / "1", Path(folder) / "2"
        for path, image in zip(paths, (image1, image2), strict=True):
            path.write_bytes(image.content)
        try:
            matched = match_two_images(*paths, detector=detector, matcher=matcher)
        except NoReliableMatrixError as error:
            raise _without_names(error) from error
    matched = replace(matched, path1=Path(image1.name), path2=Path(image2.name))
    robust = {"Learned": _estimate(matched, _layer()), "RANSAC": _estimate(matched, None)}
    found = next((result.estimate for result in robust.values() if result.estimate is not None), None)
    if found is None:
        raise NoReliableMatrixError("no_matrix", robust["RANSAC"].failure)
    results = {"Hartley": MethodResult(_hartley(found)), **robust}
    seconds = _time_methods(found)
    return {name: replace(result, seconds=seconds[name]) for name, result in results.items()}


def _estimate(matched: MatchedPair, layer: LearnedEightPoint | None) -> MethodResult:
    try:
        return MethodResult(matched.estimate(layer, model="fundamental"))
    except NoReliableMatrixError as error:
        return MethodResult(None, str(_without_names(error)))


def _without_names(error: NoReliableMatrixError) -> NoReliableMatrixError:
    """Return the error without the names of both images before its text."""
    return NoReliableMatrixError(error.code, str(error).partition(": ")[2])


@cache
def _layer() -> LearnedEightPoint:
    return LearnedEightPoint.from_pretrained()


def _hartley(estimate: PairEstimate) -> PairEstimate:
    """Return the estimate with the matrix of all its matches by Hartley's eight-point algorithm."""
    F_mat = find_fundamental(estimate.points1[None], estimate.points2[None])[0]
    inliers = symmetric_epipolar_distance(estimate.points1, estimate.points2, F_mat) < estimate.threshold
    found = replace(estimate, F_mat=F_mat, estimator="EightPoint", weights=torch.ones_like(estimate.weights))
    return replace(found, inliers=inliers, warnings=(), predicted_error=math.nan)


@torch.no_grad()
def _time_methods(estimate: PairEstimate) -> dict[str, float]:
    """Return for each method the seconds of a call that gives the matrix of the matches and nothing else."""
    x1, x2, scores = estimate.points1, estimate.points2, estimate.scores
    ransac, layer = RANSAC(inl_th=estimate.threshold, seed=estimate.seed), _layer()
    calls = {
        "Hartley": lambda: find_fundamental(x1[None], x2[None]),
        "Learned": lambda: layer(x1[None], x2[None], scores=scores[None]),
        "RANSAC": lambda: ransac(x1, x2, scores.clamp(min=1e-3)),
    }
    return {name: min(timeit.repeat(call, number=1, repeat=REPETITIONS)) for name, call in calls.items()}


def epipolar_segment(F_mat: Tensor, point: tuple[float, float], size: Size) -> NDArray[np.float64] | None:
    """Return the ends (2, 2) of the part of the epipolar line F x in an image of a size; None where it misses it.

    F_mat (3, 3) maps to the image of the line: transposed, from image 2 to image 1. The point x is of the other image.
    """
    line = F_mat.double().numpy() @ [*point, 1.0]
    low, high = np.array([-0.5, -0.5]), np.array(size) - 0.5
    borders = np.array([[1, 0, -low[0]], [1, 0, -high[0]], [0, 1, -low[1]], [0, 1, -high[1]]])
    crossings = np.cross(line, borders)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = crossings[:, :2] / crossings[:, 2:]
    points = points[((points >= low - EDGE) & (points <= high + EDGE)).all(1)]
    points = points[np.lexsort(points.T[::-1])]
    return points[[0, -1]] if len(points) and not np.allclose(points[0], points[-1], atol=EDGE, rtol=0) else None

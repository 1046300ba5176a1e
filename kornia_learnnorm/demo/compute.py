"""What the page of ``learnnorm demo`` shows: decoded images, the results of three methods, epipolar lines."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.images import image_size, import_cv2, read_colour
from kornia_learnnorm.data.synthetic.kinds import render_kind
from kornia_learnnorm.estimators.fundamental import find_fundamental
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.summary import median
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.two_view.estimate_pair import MatchedPair, match_two_images
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

__all__ = [
    "EXAMPLES",
    "MAX_BYTES",
    "METHODS",
    "Comparison",
    "Example",
    "Picture",
    "Result",
    "compare",
    "epipolar_segment",
    "read_picture",
    "render_example",
]

METHODS = ("Hartley", "Learned", "RANSAC")
EXAMPLES = {  # name on the page -> kind and seed of kornia_learnnorm.data.synthetic.kinds.render_kind
    "Room": ("room", 0),
    "Facade with little relief": ("facade", 0),
    "Repeated windows": ("repeated", 0),
    "Plane (F undetermined)": ("plane", 0),
}
MAX_BYTES = 50_000_000  # of an uploaded file
MAX_PIXELS = 150_000_000  # of an uploaded image; Pillow's own limit is a little above
SHOWN_SIZE = 1200  # pixels of the longer side of an image as the browser gets it
REPETITIONS = 3  # of a timed call, the fastest counts


@dataclass(frozen=True, eq=False)
class Picture:
    """An image that the page shows."""

    name: str  # of the file
    content: bytes  # the file
    pixels: NDArray[np.uint8]  # RGB, (H, W, 3), reduced
    size: tuple[int, int]  # width and height of the full image


@dataclass(frozen=True, eq=False)
class Example:
    """A rendered image pair with exact correspondences."""

    picture1: Picture
    picture2: Picture
    points1: Tensor  # pixels in image 1, (M, 2), float64
    points2: Tensor  # their pixels in image 2, (M, 2), float64
    determined: bool  # whether they determine F: those of a plane agree with many matrices


@dataclass(frozen=True, eq=False)
class Result:
    """What a method makes of the matches; without an estimate, why there is none."""

    estimate: PairEstimate | None
    failure: str = ""
    seconds: float = math.nan  # of one call, which gives the matrix alone
    has_prediction: bool = True  # whether the method predicts its error

    def as_dict(self) -> dict[str, Any]:
        """Return the estimate as ``learnnorm estimate --json`` writes it."""
        if self.estimate is None:
            raise ValueError(self.failure)
        content = self.estimate.as_dict()
        return content if self.has_prediction else {**content, "predicted_error_px": None}


@dataclass(frozen=True, eq=False)
class Comparison:
    """The same matches of two images by every method, a key of ``METHODS`` each."""

    points1: Tensor  # pixels of the matches in image 1, (N, 2), float64
    points2: Tensor  # pixels of the matches in image 2, (N, 2), float64
    results: Mapping[str, Result]

    def distance(self, method: str) -> float:
        """Return the median distance of RANSAC's inliers to the matrix of a method, pixels; NaN without either."""
        ransac, estimate = self.results["RANSAC"].estimate, self.results[method].estimate
        if ransac is None or estimate is None:
            return math.nan
        return _median_distance(self.points1[ransac.inliers], self.points2[ransac.inliers], estimate)

    def true_error(self, method: str, example: Example) -> float:
        """Return the median distance of exact correspondences to the matrix of a method, pixels.

        NaN where there is no matrix, or where the correspondences do not determine it: the distance says nothing then.
        """
        estimate = self.results[method].estimate
        if estimate is None or not example.determined:
            return math.nan
        return _median_distance(example.points1, example.points2, estimate)


def read_picture(name: str, content: bytes) -> Picture:
    """Return an image file that a user chose, decoded and reduced.

    Args:
        name: name of the file, for messages only.
        content: the bytes of the file.

    Raises:
        ValueError: if the file is too large, has too many pixels, or is not an intact image.

    Example:
        >>> read_picture("notes.txt", b"no pixels")
        Traceback (most recent call last):
        ValueError: notes.txt cannot be decoded: 9 bytes, not an image of a kind that Pillow reads, or one with a
        truncated or corrupt header

    """
    if len(content) > MAX_BYTES:
        raise ValueError(f"{name} has {len(content) / 1e6:.0f} MB, at most {MAX_BYTES / 1e6:.0f} MB are taken")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "image"
        path.write_bytes(content)
        width, height = image_size(path)
        if width * height > MAX_PIXELS:
            limit = f"at most {MAX_PIXELS // 10**6} million pixels are taken"
            raise ValueError(f"{name} has {width} x {height} pixels, {limit}")
        try:
            return Picture(name, content, read_colour(path, SHOWN_SIZE), (width, height))
        except ValueError as error:
            raise ValueError(str(error).replace(f"image {path}", name)) from error


@cache
def render_example(name: str) -> Example:
    """Return a rendered pair, by its name in ``EXAMPLES``."""
    pair = render_kind(*EXAMPLES[name])
    return Example(
        read_picture("image1.png", _png(pair.image1)),
        read_picture("image2.png", _png(pair.image2)),
        torch.from_numpy(pair.points1),
        torch.from_numpy(pair.points2),
        EXAMPLES[name][0] != "plane",
    )


def compare(picture1: Picture, picture2: Picture) -> Comparison:
    """Return the matches of two images and what every method makes of them.

    Raises:
        NoReliableMatrixError: if neither RANSAC nor the learned layer finds a matrix.

    """
    with TemporaryDirectory() as folder:
        path1, path2 = Path(folder) / "1", Path(folder) / "2"
        path1.write_bytes(picture1.content)
        path2.write_bytes(picture2.content)
        try:
            matched = match_two_images(path1, path2)
        except NoReliableMatrixError as error:
            raise _without_paths(error) from error
    matched = replace(matched, path1=Path(picture1.name), path2=Path(picture2.name))
    robust = {"Learned": _try(matched, _layer()), "RANSAC": _try(matched, None)}
    found = [result.estimate for result in robust.values() if result.estimate is not None]
    if not found:
        raise NoReliableMatrixError("no_matrix", robust["RANSAC"].failure)
    results = {"Hartley": Result(_hartley(found[0]), has_prediction=False), **robust}
    calls = _calls(found[0])
    timed = {name: replace(results[name], seconds=_seconds(calls[name])) for name in METHODS}
    return Comparison(found[0].points1, found[0].points2, timed)


def epipolar_segment(
    F_mat: Tensor, point: tuple[float, float], size: tuple[int, int]
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    r"""Return the part of the epipolar line :math:`F x` that lies in an image, as its two ends; None where none does.

    Args:
        F_mat: fundamental matrix :math:`(3, 3)` to the image of the line; transposed, from image 2 to image 1.
        point: pixel :math:`x` in the other image.
        size: width and height of the image of the line.

    Example:
        >>> sideways = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        >>> epipolar_segment(sideways, (3.0, 7.0), (20, 10))
        ((-0.5, 7.0), (19.5, 7.0))

    """
    a, b, c = (F_mat.double() @ torch.tensor([*point, 1.0], dtype=torch.float64)).tolist()
    norm = math.hypot(a, b)
    if not norm > 0:
        return None
    a, b, c = a / norm, b / norm, c / norm
    start, direction = (-a * c, -b * c), (-b, a)  # the point nearest to the origin
    low, high = -math.inf, math.inf
    for origin, step, side in zip(start, direction, size, strict=True):
        edges = -0.5 - origin, side - 0.5 - origin
        if step == 0:
            if not edges[0] <= 0 <= edges[1]:
                return None
            continue
        near, far = sorted(edge / step for edge in edges)
        low, high = max(low, near), min(high, far)
    if not low < high:
        return None
    ends = [(start[0] + s * direction[0], start[1] + s * direction[1]) for s in (low, high)]
    first, last = sorted(ends)
    return first, last


def _png(image: NDArray[np.uint8]) -> bytes:
    return bytes(import_cv2().imencode(".png", image)[1])


def _try(matched: MatchedPair, layer: LearnedEightPoint | None) -> Result:
    try:
        return Result(matched.estimate(layer))
    except NoReliableMatrixError as error:
        return Result(None, str(_without_paths(error)))


def _without_paths(error: NoReliableMatrixError) -> NoReliableMatrixError:
    """Return the error without the names of both images before its text."""
    return NoReliableMatrixError(error.code, str(error).partition(": ")[2])


@cache
def _layer() -> LearnedEightPoint:
    return LearnedEightPoint.from_pretrained()


def _hartley(estimate: PairEstimate) -> PairEstimate:
    """Return the estimate with the matrix of all its matches by Hartley's eight-point algorithm."""
    F_mat = find_fundamental(estimate.points1[None], estimate.points2[None])[0]
    distance = symmetric_epipolar_distance(estimate.points1, estimate.points2, F_mat)
    inliers = distance < estimate.threshold
    ones = torch.ones_like(estimate.weights)
    return replace(estimate, F_mat=F_mat, estimator="EightPoint", weights=ones, inliers=inliers, warnings=())


def _calls(estimate: PairEstimate) -> dict[str, Callable[[], object]]:
    """Return for each method a call that gives the matrix of the matches and nothing else."""
    x1, x2, scores = estimate.points1, estimate.points2, estimate.scores
    ransac, layer = RANSAC(inl_th=estimate.threshold, seed=estimate.seed), _layer()
    return {
        "Hartley": lambda: find_fundamental(x1[None], x2[None]),
        "Learned": lambda: layer(x1[None], x2[None], scores=scores[None]),
        "RANSAC": lambda: ransac(x1, x2, scores.clamp(min=1e-3)),
    }


@torch.no_grad()
def _seconds(call: Callable[[], object]) -> float:
    """Return the time of the fastest of a few calls."""
    times = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def _median_distance(points1: Tensor, points2: Tensor, estimate: PairEstimate) -> float:
    return median(symmetric_epipolar_distance(points1, points2, estimate.F_mat)).item()

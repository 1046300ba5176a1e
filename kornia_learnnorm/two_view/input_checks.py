"""Input checks of the estimates of matches and images, all made before the work begins."""

from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.geometry.checks import check_cameras, check_choice

MODELS = ("auto", "fundamental", "homography")
MAX_THRESHOLD = 1000.0  # pixels
MAX_FOCAL = 1e9  # pixels; poses of far longer ones are rounding
MIN_INSIDE = 0.8  # of the points of an image
FAR = 3.0  # times the 90th percentile of the coordinates; farther points do not count for the size of the image
Points = Tensor | NDArray[Any]
Cameras = tuple[Tensor, Tensor]


def read_matches(points1: Points, points2: Points, scores: Points | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return matches (N, 2), (N, 2) and scores (N,) in float64; scores of one where there are none."""
    x1, x2 = _as_float64("points1", points1), _as_float64("points2", points2)
    score = torch.ones(len(x1), dtype=torch.float64) if scores is None else _as_float64("scores", scores)
    if x1.shape != x2.shape or x1.shape[1:] != (2,) or score.shape != x1.shape[:1]:
        given = (x1, x2) if scores is None else (x1, x2, score)
        shapes = " and ".join(str([*value.shape]) for value in given)
        hint = "; this takes one pair, points1[0]" if x1.ndim == 3 else ""
        hint = "; points1[:, 0] of OpenCV's points" if x1.ndim == 3 and x1.shape[1] == 1 else hint
        raise ValueError(f"points of shape (N, 2) and scores of shape (N,) expected, got {shapes}{hint}")
    known = score[(x1.isfinite() & x2.isfinite()).all(-1)]
    wrong = known[~((known >= 0) & (known <= 1))]
    if len(wrong):
        raise ValueError(f"scores must be from 0 to 1, got {len(wrong)} others, the first {float(wrong[0]):g}")
    return x1, x2, score


def read_cameras(K1: Points | None, K2: Points | None) -> Cameras | None:
    """Return the cameras (3, 3) of both images in float64, or None where none is given.

    Errors are those of ``check_cameras``, and a ValueError for a focal length that is not positive, or above 1e9 px.
    """
    camera1, camera2 = (None if K is None else _as_float64(name, K) for name, K in (("K1", K1), ("K2", K2)))
    check_cameras(camera1, camera2)
    for name, camera in (("K1", camera1), ("K2", camera2)):
        focal = torch.ones(2) if camera is None else camera.diagonal()[:2] / camera[2, 2]
        if not bool(((focal > 0) & (focal <= MAX_FOCAL)).all()):
            raise ValueError(f"{name} must have positive focal lengths of at most 1e9 px, got {focal.tolist()}")
    return None if camera1 is None or camera2 is None else (camera1, camera2)


def read_size(name: str, size: Size | Points | None, points: Tensor) -> Size:
    """Return the width and height of an image, pixels; when not given, the smallest that holds its points.

    Four of five points must lie inside; undistortion moves only a few beyond the borders.
    """
    near = points <= FAR * points.quantile(0.9, dim=0)
    given: Any = torch.where(near, points, 1.0).amax(0).clamp(min=1.0).ceil() + 1 if size is None else size
    if isinstance(given, np.ndarray | Tensor):  # LightGlue's are float32
        given = tuple(int(value) if value.is_integer() else value for value in map(float, given.reshape(-1)))
    if not isinstance(given, tuple | list):
        raise TypeError(f"{name} must be a width and a height, got {given!r}")
    for value in given:
        check_number(f"width and height of {name}", value, whole=True)
    if len(given) != 2 or min(given) < 1:
        raise ValueError(f"{name} must be a positive width and height, got {tuple(given)}")
    width, height = int(given[0]), int(given[1])
    inside = ((points >= -1) & (points <= points.new_tensor([width, height]))).all(-1)
    if int(inside.sum()) < MIN_INSIDE * len(points):
        text = f"{int(inside.sum())} of {len(points)} points lie in the image of {name}, {width} x {height} pixels"
        raise ValueError(f"{text}: points are pixels from its upper left corner")
    return width, height


def check_settings(threshold: float, seed: int, layer: object = None, model: str = "auto") -> None:
    """Raise a clear error for a threshold that is not positive, a seed out of range, or another layer or model."""
    check_number("threshold", threshold)
    if not 0 < threshold <= MAX_THRESHOLD:
        raise ValueError(f"threshold must be positive and at most {MAX_THRESHOLD:g} px, got {threshold:g} px")
    check_number("seed", seed, whole=True)
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed must lie in [0, 2^63), got {seed}")
    if not isinstance(layer, LearnedEightPoint | None):
        raise TypeError(f"layer must be a LearnedEightPoint or None, got {type(layer)}")
    check_choice("model", model, MODELS)
    if layer is not None and model == "homography":
        raise ValueError("layer estimates fundamental matrices: leave it out with model homography")


def check_number(name: str, value: object, whole: bool = False) -> None:
    """Raise a TypeError for anything but a real number, or a whole one."""
    if isinstance(value, bool) or not isinstance(value, Integral if whole else Real):
        raise TypeError(f"{name} must be a {'whole ' if whole else ''}number, got {value!r}")


def _as_float64(name: str, value: object) -> Tensor:
    """Return an array or tensor of floating-point or whole numbers as a tensor on the CPU, float64."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "iuf":
        return torch.from_numpy(np.array(value, np.float64))  # a copy: strides and byte order may be any
    if isinstance(value, Tensor) and not (value.dtype == torch.bool or value.is_complex()):
        return value.detach().cpu().double()
    got = f"one of {value.dtype}" if isinstance(value, np.ndarray | Tensor) else str(type(value))
    hint = f"; numpy.array({name}, float) makes one" if isinstance(value, list | tuple) else ""
    raise TypeError(f"{name} must be a NumPy array or a tensor of numbers, got {got}{hint}")

r"""Rendered image pairs with an exact fundamental matrix: two views of a room made of textured planes.

For a first run without a data set; use real images to compare methods. A back wall, a floor and slanted boards are
warped into each view by the homographies of their planes, from back to front. The scene is far from planar, so
:math:`F` is well determined.
Images need OpenCV (the extra ``images``), which is imported on use.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.data.images import import_cv2
from kornia_learnnorm.data.motion import fundamental_from_motion
from kornia_learnnorm.data.synthetic.planes import (
    SUPERSAMPLING,
    Array,
    Plane,
    correspondences,
    expose,
    relief_of,
    render_planes,
    rotation,
)
from kornia_learnnorm.data.synthetic.textures import Random, circles, framed, letters, masonry, polygons
from kornia_learnnorm.files import atomic_write, write_text

__all__ = ["RenderedPair", "camera", "check_size", "render_pair", "render_views", "room", "write_pair"]


class RenderedPair(NamedTuple):
    r"""Two rendered images and their geometry; :math:`X_2 = R X_1 + t` for points in space.

    Args:
        image1: first image, grey, uint8 with shape :math:`(H, W)`.
        image2: second image, grey, uint8 with shape :math:`(H, W)`.
        K: intrinsics of both cameras with shape :math:`(3, 3)`; pixel centres are at whole numbers.
        R: rotation with shape :math:`(3, 3)`.
        t: translation in metres with shape :math:`(3,)`.
        F_mat: fundamental matrix with shape :math:`(3, 3)`, unit Frobenius norm, :math:`x_2^\top F x_1 = 0`;
            NaN where the camera only turns.
        points1: exact correspondences on the surfaces that both images show, pixels with shape :math:`(M, 2)`: a grid
            in the first image.
        points2: their pixels in the second image with shape :math:`(M, 2)`.
        relief: how far surfaces stand out from the rearmost plane, at most, as a share of the first camera's distance
            to it; 0 for a plane.

    """

    image1: NDArray[np.uint8]
    image2: NDArray[np.uint8]
    K: Array
    R: Array
    t: Array
    F_mat: Array
    points1: Array
    points2: Array
    relief: float


def render_pair(seed: int = 0, width: int = 640, height: int = 480) -> RenderedPair:
    r"""Render two views of a room with pictures on stands; equal seeds give equal images.

    The second camera is about half a metre to the side of and ahead of the first one and turned a little. The ground
    truth is :math:`F = K^{-\top} [t]_\times R K^{-1}`.

    Args:
        seed: seed of textures, boards and motion, 0 or more.
        width: width of the images in pixels.
        height: height of the images in pixels.

    Raises:
        ImportError: if OpenCV is not installed.
        ValueError: if the seed is negative, or the height is below 64 pixels or above the width.

    Example:
        >>> pair = render_pair(seed=0, width=320, height=240)
        >>> pair.image1.shape, pair.image1.dtype
        ((240, 320), dtype('uint8'))

    """
    check_size(seed, width, height)
    cv2 = import_cv2()
    rng = np.random.default_rng(seed)
    yaw, pitch, roll = np.deg2rad([rng.uniform(-5, -3), rng.uniform(-1, 1), rng.uniform(-1.5, 1.5)])
    R = rotation(yaw, pitch, roll)
    t = -R @ np.array([rng.uniform(0.5, 0.65), rng.uniform(-0.1, 0.05), rng.uniform(0.2, 0.4)])
    planes = room(rng, cv2, texels=SUPERSAMPLING * width / 640)
    return render_views(rng, cv2, planes, R, t, (width, height))


def check_size(seed: int, width: int, height: int) -> None:
    """Raise ValueError for a negative seed or a size that the scenes do not fill."""
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    if not 64 <= height <= width:
        raise ValueError(f"images must be at least 64 pixels high and no higher than wide, got {width} x {height}")


def camera(width: int, height: int) -> Array:
    """Return the intrinsics of rendered images: the focal length is 0.9 widths."""
    return np.array([[0.9 * width, 0, (width - 1) / 2], [0, 0.9 * width, (height - 1) / 2], [0, 0, 1]])


def render_views(
    rng: Random, cv2: Any, planes: Sequence[Plane], R: Array, t: Array, size: tuple[int, int]
) -> RenderedPair:
    """Render planes, given from back to front, from the origin and from a camera with :math:`X_2 = R X_1 + t`."""
    K = camera(*size)
    image1 = expose(render_planes(cv2, planes, K, np.eye(3), np.zeros(3), size), rng)
    image2 = expose(render_planes(cv2, planes, K, R, t, size), rng)
    F_mat = fundamental_from_motion(*map(torch.from_numpy, (K, K, R, t))).numpy()
    points1, points2 = correspondences(planes, K, R, t, size)
    return RenderedPair(image1, image2, K, R, t, F_mat, points1, points2, relief_of(planes))


def write_pair(folder: str | Path, pair: RenderedPair) -> None:
    """Write ``image1.png``, ``image2.png`` and ``ground_truth.json``, each complete or not at all.

    Args:
        folder: folder to write to; created if missing. Existing files of these names are replaced.
        pair: the rendered pair. The ground truth holds ``K``, ``R``, ``t``, ``F_mat``, ``width`` and ``height``;
            ``F_mat`` is null where the camera only turns.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_pair(folder, render_pair(width=160, height=120))
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['ground_truth.json', 'image1.png', 'image2.png']

    """
    cv2, folder = import_cv2(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    height, width = pair.image1.shape
    truth = {name: getattr(pair, name).tolist() for name in ("K", "R", "t", "F_mat")}
    if np.isnan(pair.F_mat).any():
        truth["F_mat"] = None
    for name in ("image1", "image2"):
        with atomic_write(folder / f"{name}.png") as temporary:
            temporary.write_bytes(cv2.imencode(".png", getattr(pair, name))[1].tobytes())
    write_text(folder / "ground_truth.json", json.dumps({"width": width, "height": height, **truth}, indent=2) + "\n")


def room(rng: Random, cv2: Any, texels: float) -> list[Plane]:
    """Return the planes of the room from back to front, with ``texels`` per pixel of an image 640 pixels wide."""
    wall_z, floor_y = 7.0, 1.35
    wall = masonry(rng, cv2, (15.0, 6.0), 85 * texels, brick=(0.62, 0.27), shift=0.5)
    floor = masonry(rng, cv2, (15.0, 5.8), 110 * texels, brick=(0.45, 0.45), shift=0.0)
    planes = [
        Plane(np.array([-7.5, floor_y - 6.0, wall_z]), np.array([15.0, 0, 0]), np.array([0, 6.0, 0]), wall),
        Plane(np.array([-7.5, floor_y, wall_z]), np.array([15.0, 0, 0]), np.array([0, 0, -5.8]), floor),
    ]
    # Boards, leaning back a little: x and z of the foot on the floor, width, height, angle in degrees, painter.
    boards = [
        (0.4, 5.9, 2.1, 2.3, 8, circles),
        (-1.4, 4.7, 1.6, 1.7, -32, polygons),
        (1.5, 4.3, 1.3, 1.6, 30, letters),
        (0.2, 3.6, 0.85, 0.75, -14, circles),
    ]
    for x, z, wide, high, degrees, paint in boards:
        foot = np.array([x + rng.uniform(-0.1, 0.1), floor_y, z + rng.uniform(-0.1, 0.1)])
        angle = np.deg2rad(degrees + rng.uniform(-4, 4))
        right = wide * np.array([np.cos(angle), 0, -np.sin(angle)])
        down = high * np.array([-0.12 * np.sin(angle), 1, -0.12 * np.cos(angle)])
        _darken_floor(cv2, planes[1], foot, right)
        picture = framed(rng, cv2, paint, (wide, high), 160 * texels)
        planes.append(Plane(foot - right / 2 - down, right, down, picture))
    return planes


def _darken_floor(cv2: Any, floor: Plane, foot: Array, right: Array) -> None:
    """Paint the soft shadow of a board on the floor's texture."""
    density = floor.texture.shape[1] / np.linalg.norm(floor.right)
    behind = np.array([right[2], 0, -right[0]]) * -0.2
    outline = np.array([foot - right / 2, foot + right / 2, foot + right / 2 + behind, foot - right / 2 + behind])
    pixels = np.stack([outline[:, 0] - floor.corner[0], floor.corner[2] - outline[:, 2]], -1) * density
    shadow = np.zeros(floor.texture.shape, np.float32)
    cv2.fillConvexPoly(shadow, pixels.round().astype(np.int32), 0.6)
    floor.texture[...] *= 1 - cv2.blur(shadow, (int(0.3 * density), int(0.3 * density)))

"""Scenes of textured planes: rendering, exact correspondences and relief; rendering needs OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.synthetic.textures import Random, Texture

__all__ = ["SUPERSAMPLING", "Array", "Plane", "correspondences", "expose", "relief_of", "render_planes", "rotation"]

Array = NDArray[np.float64]

SUPERSAMPLING = 3  # samples per pixel and axis
GRID = 80  # exact correspondences in a row of the first image, before occlusions


class Plane(NamedTuple):
    """A textured rectangle in space: its top left corner and its two sides, in metres of the first camera's frame."""

    corner: Array
    right: Array
    down: Array
    texture: Texture


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation about the axes y, then x, then z, in radians."""
    (cy, sy), (cx, sx), (cz, sz) = ((np.cos(angle), np.sin(angle)) for angle in (yaw, pitch, roll))
    Ry = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(Rz @ Rx @ Ry)


def render_planes(cv2: Any, planes: Sequence[Plane], K: Array, R: Array, t: Array, size: tuple[int, int]) -> Texture:
    """Render the planes from back to front on a finer grid and average it."""
    fine = (size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING)
    centre = (SUPERSAMPLING - 1) / 2
    K_fine = np.array([[SUPERSAMPLING, 0, centre], [0, SUPERSAMPLING, centre], [0, 0, 1]]) @ K
    image = np.zeros(fine[::-1], np.float32)
    for plane in planes:
        height, width = plane.texture.shape
        # Texel centres are at whole numbers: texel u lies (u + 1/2) / width along the side.
        to_space = np.stack([plane.right / width, plane.down / height, plane.corner], -1)
        to_space[:, 2] += (to_space[:, 0] + to_space[:, 1]) / 2
        H = K_fine @ (R @ to_space + np.outer(t, [0, 0, 1]))
        painted = cv2.warpPerspective(plane.texture, H, fine, flags=cv2.INTER_LINEAR)
        cover = cv2.warpPerspective(np.ones_like(plane.texture), H, fine, flags=cv2.INTER_LINEAR)
        image = painted + (1 - cover) * image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def expose(image: Texture, rng: Random) -> NDArray[np.uint8]:
    """Return the grey levels of brightness in 0-1, with noise of one level."""
    levels = 235 * image + 8 + rng.standard_normal(image.shape)
    return levels.round().clip(0, 255).astype(np.uint8)


def correspondences(
    planes: Sequence[Plane], K: Array, R: Array, t: Array, size: tuple[int, int]
) -> tuple[Array, Array]:
    """Return exact correspondences, pixels ``(M, 2)``, of a grid of pixels of the first image.

    Points that the second image does not show, or that another plane hides there, are left out.
    """
    step = max(1, size[0] // GRID)
    x, y = np.meshgrid(np.arange(step // 2, size[0], step), np.arange(step // 2, size[1], step))
    points1 = np.stack([x.ravel(), y.ravel()], -1).astype(float)
    surface1, X1 = _front_surface(planes, K, np.eye(3), np.zeros(3), points1)
    shown = surface1 >= 0
    points1, surface1 = points1[shown], surface1[shown]
    X2 = X1[shown] @ R.T + t
    ahead = X2[:, 2] > 0
    projected = X2[ahead] @ K.T
    points1, surface1, points2 = points1[ahead], surface1[ahead], projected[:, :2] / projected[:, 2:]
    surface2, _ = _front_surface(planes, K, R, t, points2)
    both = (surface1 == surface2) & ((points2 >= 0) & (points2 <= np.array(size) - 1)).all(-1)
    return points1[both], points2[both]


def relief_of(planes: Sequence[Plane]) -> float:
    """Return how far planes stand out from the first one, at most, as a share of the first camera's distance to it."""
    back = planes[0]
    normal = np.cross(back.right, back.down)
    corners = np.concatenate(
        [p.corner + np.outer([0, 1, 0, 1], p.right) + np.outer([0, 0, 1, 1], p.down) for p in planes]
    )
    shares = np.abs((corners - back.corner) @ normal / (back.corner @ normal))
    return round(float(shares.max()), 12)  # exactly 0 for a plane


def _front_surface(
    planes: Sequence[Plane], K: Array, R: Array, t: Array, pixels: Array
) -> tuple[NDArray[np.int64], Array]:
    """Return the index of the plane that a camera sees at each pixel, -1 for none, and the point in its frame."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    surface, X = np.full(len(pixels), -1), np.full((len(pixels), 3), np.nan)
    for index, plane in enumerate(planes):  # from back to front, as they are painted
        to_camera = R @ np.stack([plane.right, plane.down, plane.corner], -1) + np.outer(t, [0, 0, 1])
        u, v, inverse_depth = np.linalg.solve(to_camera, rays.T)  # shares of the sides, times the inverse depth
        inside = (inverse_depth > 0) & (u >= 0) & (v >= 0) & (u <= inverse_depth) & (v <= inverse_depth)
        surface[inside], X[inside] = index, rays[inside] / inverse_depth[inside, None]
    return surface, X

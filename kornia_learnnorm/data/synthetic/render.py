"""A rendered image pair with an exact fundamental matrix: two views of a room made of textured planes.

It is for a first run without a data set; use real images to compare methods.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.data.datasets.frames import fundamental_from_motion
from kornia_learnnorm.data.images import Pixels, Size, import_cv2
from kornia_learnnorm.files import atomic_write, write_text

__all__ = ["Plane", "RenderedPair", "check_size", "circles", "framed", "letters", "masonry", "noise", "polygons"]
__all__ += ["render_pair", "render_views", "room", "rotation", "write_pair"]

SUPERSAMPLING = 3  # samples per pixel and axis
GRID = 80  # exact correspondences in a row of the first image, before occlusions

Array = NDArray[np.float64]
Texture = NDArray[np.float32]  # brightness in 0-1
Random = np.random.Generator
Painter = Callable[[Random, Any, Texture], None]
Metres = tuple[float, float]  # width and height
Planes = Sequence["Plane"]  # from back to front


class RenderedPair(NamedTuple):
    """Two rendered images and their geometry: X2 = R X1 + t for points in space, x2^T F x1 = 0."""

    image1: Pixels  # grey, (H, W)
    image2: Pixels
    K: Array  # intrinsics of both cameras, pixels, (3, 3); pixel centres are at whole numbers
    R: Array  # (3, 3)
    t: Array  # metres, (3,)
    F_mat: Array  # unit norm, (3, 3); NaN where the camera only rotates
    points1: Array  # exact correspondences on the surfaces that both images show, pixels, (M, 2): a grid in image 1
    points2: Array  # their pixels in image 2, (M, 2)


class Plane(NamedTuple):
    """A textured rectangle in space: its top left corner and its two sides, in metres of the first camera's frame."""

    corner: Array
    right: Array
    down: Array
    texture: Texture


def render_pair(seed: int = 0, width: int = 640, height: int = 480) -> RenderedPair:
    """Render two views of a room with pictures on stands; equal seeds give equal images.

    The second camera is about half a metre to the side of and ahead of the first one and rotated a little. A seed below
    0 and a height below 64 pixels or above the width are a ValueError.
    """
    check_size(seed, width, height)
    cv2 = import_cv2()
    rng = np.random.default_rng(seed)
    yaw, pitch, roll = np.deg2rad([rng.uniform(-5, -3), rng.uniform(-1, 1), rng.uniform(-1.5, 1.5)])
    R = rotation(yaw, pitch, roll)
    t = -R @ np.array([rng.uniform(0.5, 0.65), rng.uniform(-0.1, 0.05), rng.uniform(0.2, 0.4)])
    return render_views(rng, cv2, room(rng, cv2, texels=SUPERSAMPLING * width / 640), R, t, (width, height))


def check_size(seed: int, width: int, height: int) -> None:
    """Raise ValueError for a negative seed or a size that the scenes do not fill."""
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    if not 64 <= height <= width:
        raise ValueError(f"images must be at least 64 pixels high and no higher than wide, got {width} x {height}")


def write_pair(folder: str | Path, pair: RenderedPair) -> None:
    """Write ``image1.png``, ``image2.png`` and ``ground_truth.json`` to a folder, each complete or not at all.

    The ground truth holds ``K``, ``R``, ``t``, ``F_mat`` (null where the camera only rotates), and the size.
    """
    cv2, folder = import_cv2(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    height, width = pair.image1.shape
    truth = {name: getattr(pair, name).tolist() for name in ("K", "R", "t", "F_mat")}
    truth |= {"F_mat": None} if np.isnan(pair.F_mat).any() else {}
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


def render_views(rng: Random, cv2: Any, planes: Planes, R: Array, t: Array, size: Size) -> RenderedPair:
    """Render planes, given from back to front, from the origin and from a camera with :math:`X_2 = R X_1 + t`."""
    width, height = size
    K = np.array([[0.9 * width, 0, (width - 1) / 2], [0, 0.9 * width, (height - 1) / 2], [0, 0, 1]])
    image1 = render_view(rng, cv2, planes, K, np.eye(3), np.zeros(3), size)
    image2 = render_view(rng, cv2, planes, K, R, t, size)
    F_mat = fundamental_from_motion(*map(torch.from_numpy, (K, K, R, t))).numpy()
    points1, points2 = correspondences(planes, K, R, t, size)
    return RenderedPair(image1, image2, K, R, t, F_mat, points1, points2)


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation about the axes y, then x, then z, in radians."""
    (cy, sy), (cx, sx), (cz, sz) = ((np.cos(angle), np.sin(angle)) for angle in (yaw, pitch, roll))
    Ry = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(Rz @ Rx @ Ry)


def render_view(rng: Random, cv2: Any, planes: Planes, K: Array, R: Array, t: Array, size: Size) -> Pixels:
    """Render the planes from back to front on a finer grid, average it, and add noise of one grey level."""
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
    levels = 235 * cv2.resize(image, size, interpolation=cv2.INTER_AREA) + 8 + rng.standard_normal(size[::-1])
    return np.asarray(levels.round().clip(0, 255), np.uint8)


def correspondences(planes: Planes, K: Array, R: Array, t: Array, size: Size) -> tuple[Array, Array]:
    """Return exact correspondences, pixels ``(M, 2)``, of a grid of image 1: those that image 2 shows unhidden."""
    step = max(1, size[0] // GRID)
    x, y = np.meshgrid(np.arange(step // 2, size[0], step), np.arange(step // 2, size[1], step))
    points1 = np.stack([x.ravel(), y.ravel()], -1).astype(float)
    surface1, X1 = _front_surface(planes, K, np.eye(3), np.zeros(3), points1)
    X2 = X1 @ R.T + t  # NaN where image 1 shows nothing
    projected = X2 @ K.T
    points2 = projected[:, :2] / projected[:, 2:]
    surface2, _ = _front_surface(planes, K, R, t, points2)
    inside = ((points2 >= 0) & (points2 <= np.array(size) - 1)).all(-1)
    both = inside & (surface1 == surface2) & (X2[:, 2] > 0)
    return points1[both], points2[both]


def _front_surface(planes: Planes, K: Array, R: Array, t: Array, pixels: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the index of the plane that a camera sees at each pixel, -1 for none, and the point in its frame."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    surface, X = np.full(len(pixels), -1), np.full((len(pixels), 3), np.nan)
    for index, plane in enumerate(planes):  # from back to front, as they are painted
        to_camera = R @ np.stack([plane.right, plane.down, plane.corner], -1) + np.outer(t, [0, 0, 1])
        u, v, inverse_depth = np.linalg.solve(to_camera, rays.T)  # shares of the sides, times the inverse depth
        inside = (inverse_depth > 0) & (u >= 0) & (v >= 0) & (u <= inverse_depth) & (v <= inverse_depth)
        surface[inside], X[inside] = index, rays[inside] / inverse_depth[inside, None]
    return surface, X


def noise(rng: Random, cv2: Any, shape: tuple[int, int], finest: int) -> Texture:
    """Return noise of all scales from the whole texture to ``finest`` texels, with standard deviation one."""
    total = np.zeros(shape, np.float32)
    cell = max(shape) // 2
    while cell >= finest:
        grid = rng.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2)).astype(np.float32)
        total += cv2.resize(grid, shape[::-1], interpolation=cv2.INTER_CUBIC) * np.float32(cell**0.3)
        cell //= 2
    return np.asarray(total / total.std(), np.float32)


def masonry(rng: Random, cv2: Any, size: Metres, density: float, brick: Metres, shift: float) -> Texture:
    """Return bricks or tiles of random tones; every other row is shifted by a share of a brick."""
    rows, columns = (np.arange(int(metres * density)) / density for metres in size[::-1])
    row = rows / brick[1]
    column = columns / brick[0] + shift * (row.astype(int)[:, None] % 2)
    tones = rng.uniform(0.3, 0.75, (int(row[-1]) + 1, int(column.max()) + 1))
    tone = tones[row.astype(int)[:, None], column.astype(int)]
    joint = (row % 1 < 0.02 / brick[1])[:, None] | (column % 1 < 0.02 / brick[0])
    texture = np.where(joint, 0.85, tone).astype(np.float32)
    texture += 0.09 * noise(rng, cv2, texture.shape, finest=4)
    return np.asarray(cv2.GaussianBlur(texture, None, 0.8), np.float32)


def framed(rng: Random, cv2: Any, paint: Painter, size: Metres, density: float) -> Texture:
    """Return a painting in a dark frame with a pale mount."""
    width, height = (int(metres * density) for metres in size)
    texture = 0.55 + 0.12 * noise(rng, cv2, (height, width), finest=4)
    paint(rng, cv2, texture)
    edge = int(0.05 * density)
    for inset, tone in ((2 * edge, 0.92), (edge, 0.12)):
        texture = np.pad(texture[inset:-inset, inset:-inset], inset, constant_values=tone)
    texture += 0.03 * noise(rng, cv2, texture.shape, finest=4)
    return np.asarray(cv2.GaussianBlur(texture, None, 0.8), np.float32)


def circles(rng: Random, cv2: Any, texture: Texture) -> None:
    """Paint rings and discs, large ones first."""
    height, width = texture.shape
    for radius in np.sort(rng.uniform(0.015, 0.16, 70))[::-1] * min(height, width):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        for share in (1.0, rng.uniform(0.5, 0.85), rng.uniform(0.15, 0.4)):
            cv2.circle(texture, centre, max(1, int(share * radius)), rng.uniform(0.05, 1.0), -1, cv2.LINE_AA)


def polygons(rng: Random, cv2: Any, texture: Texture) -> None:
    """Paint triangles and quadrilaterals, large ones first."""
    height, width = texture.shape
    for radius in np.sort(rng.uniform(0.02, 0.25, 110))[::-1] * min(height, width):
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 5)))
        corners = rng.uniform((0, 0), (width, height)) + radius * np.stack([np.cos(angles), np.sin(angles)], -1)
        cv2.fillPoly(texture, [corners.round().astype(np.int32)], rng.uniform(0.05, 1.0), cv2.LINE_AA)


def letters(rng: Random, cv2: Any, texture: Texture) -> None:
    """Set lines of random letters in several sizes on pale paper."""
    height, width = texture.shape
    ink = np.zeros(texture.shape, np.uint8)  # OpenCV writes on eight bits only
    left, baseline = int(0.1 * width), int(0.06 * height)
    while baseline < height:
        scale = rng.uniform(0.0018, 0.005) * width
        baseline += int(32 * scale)
        text = "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ23456789&"), 24))
        thickness = max(1, int(2.5 * scale))
        cv2.putText(ink, text, (left, baseline), cv2.FONT_HERSHEY_DUPLEX, scale, 255, thickness, cv2.LINE_AA)
    texture[...] = (0.3 * texture + 0.6) * (1 - ink.astype(np.float32) / 280)

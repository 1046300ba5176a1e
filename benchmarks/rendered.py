"""Rendered image pairs of kinds that are difficult for two-view estimation, with exact ground truth.

- `room`: the scene of `kornia_learnnorm.data.synthetic.render`
- `facade`: a wall with boards that stand out from it by up to 0-20 % of its distance, more often little than much
- `plane`: a wall with pictures painted on it: the correspondences do not determine F, which the motion does
- `rotation`: the room, from a camera that only turns: t is zero and F NaN
- `repeated`: a wall of equal windows, with balconies of equal bars and a few unlike boards that stand out by 3-20 %
- `borders`: the room inside of a constant black frame (even seeds) or below a constant caption and logo (odd seeds)

Where the camera moves, the baseline is 2-35 % of the distance to the scene, and the camera turns to keep the scene in
view. Tests and tutorials use these pairs too.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.synthetic import render
from kornia_learnnorm.data.synthetic.render import SUPERSAMPLING, Array, Metres, Plane, Random, RenderedPair, Texture

KINDS = ("room", "facade", "plane", "rotation", "repeated", "borders")
DISTANCE = 6.0  # of facades and of the middle of the room, metres
BASELINES = (0.02, 0.35)  # shares of the distance
MAX_RELIEF = 0.2  # share of the distance to the wall
WALL = (13.0, 8.5)  # width and height, metres; fills every view
TEXELS = 85  # of a wall, per metre and sample of an image 640 pixels wide; those of nearer boards are denser
PAINTERS = (render.circles, render.polygons, render.letters)


def render_kind(kind: str, seed: int = 0, width: int = 640, height: int = 480) -> RenderedPair:
    """Return an image pair of a kind; equal seeds give equal images, and no correspondence lies below a caption."""
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: expected one of {', '.join(KINDS)}")
    render.check_size(seed, width, height)
    rng = np.random.default_rng([*kind.encode(), seed])
    texels = SUPERSAMPLING * width / 640
    R, t = _turn(rng) if kind == "rotation" else _motion(rng)
    if kind == "facade":
        planes = _facade(rng, texels, MAX_RELIEF * rng.uniform() ** 2)
    elif kind == "plane":
        planes = _facade(rng, texels, 0.0)
    elif kind == "repeated":
        planes = _repeated(rng, texels)
    else:
        planes = render.room(rng, cv2, texels)
    pair = render.render_views(rng, cv2, planes, R, t, (width, height))
    if kind == "borders":
        overlay = _caption(rng, width, height) if seed % 2 else _frame(rng, width, height)
        pair = _covered(pair, *overlay)
    return pair


def _motion(rng: Random) -> tuple[Array, Array]:
    """Draw a motion, mostly sideways, that keeps the scene in view."""
    baseline = DISTANCE * np.exp(rng.uniform(*np.log(BASELINES)))
    side = rng.choice([-1, 1])
    direction = np.array([side, rng.uniform(-0.15, 0.15), rng.uniform(-0.3, 0.5)])
    centre = baseline * direction / np.linalg.norm(direction)
    yaw = -rng.uniform(0.6, 1.0) * np.arctan2(centre[0], DISTANCE)
    pitch, roll = np.deg2rad(rng.uniform(-2, 2, 2))
    R = render.rotation(yaw, pitch, roll)
    return R, -R @ centre


def _turn(rng: Random) -> tuple[Array, Array]:
    """Draw a rotation about the camera's centre by 3 to 15 degrees and no translation."""
    yaw, pitch, roll = rng.choice([-1, 1]) * rng.uniform(3, 14), *rng.uniform(-4, 4, 2)
    return render.rotation(*np.deg2rad([yaw, pitch, roll])), np.zeros(3)


class _Wall:
    """A slanted wall in front of the camera, and what hangs on it, painted from back to front."""

    def __init__(self, rng: Random, texture: Texture) -> None:
        yaw, pitch, roll = np.deg2rad(rng.uniform((-12, -4, -2), (12, 4, 2)))
        self.right, self.down, away = render.rotation(yaw, pitch, roll).T
        self.centre = np.array([0.0, 0.0, DISTANCE])
        self.outwards = -away * (away @ self.centre)  # to the camera's height above the wall
        self.plane = self.board((0.0, 0.0), WALL, 0.0, texture)

    def board(self, middle: tuple[float, float], size: tuple[float, float], share: float, texture: Texture) -> Plane:
        """Return a board parallel to the wall that stands out by a share of the camera's distance to the wall."""
        right, down = size[0] * self.right, size[1] * self.down
        place = self.centre + middle[0] * self.right + middle[1] * self.down + share * self.outwards
        return Plane(place - (right + down) / 2, right, down, texture)


def _facade(rng: Random, texels: float, relief: float) -> list[Plane]:
    """Return a wall with nine pictures, of which the one that stands out most does so by the relief."""
    wall = _Wall(rng, render.masonry(rng, cv2, WALL, TEXELS * texels, brick=(0.62, 0.27), shift=0.5))
    shares = np.sort(relief * rng.uniform(size=9))
    shares[-1] = relief
    places = rng.permutation([(x, y) for x in (-2.2, 0.0, 2.2) for y in (-1.6, 0.0, 1.6)])
    boards = [_picture(rng, wall, place, share, texels) for place, share in zip(places, shares, strict=True)]
    return [wall.plane, *boards]


def _repeated(rng: Random, texels: float) -> list[Plane]:
    """Return a wall of equal windows with two rows of balconies and three pictures in front of it."""
    cell = (rng.uniform(0.8, 1.3), rng.uniform(1.1, 1.5))
    wall = _Wall(rng, windows(rng, WALL, TEXELS * texels, cell))
    relief = rng.uniform(0.03, MAX_RELIEF)
    planes, bars = [wall.plane], windows(rng, (WALL[0], 0.4), 110 * texels, (0.3, 0.4))
    for y in (-1.3, 1.4):
        share = relief * rng.uniform(0.3, 0.7)
        planes.append(wall.board((0.0, y + rng.uniform(-0.2, 0.2)), (WALL[0], 0.4), share, bars))
    shares = np.sort([relief, *(relief * rng.uniform(0.7, 1.0, 2))])
    places = rng.permutation([(x, rng.uniform(-1.6, 1.6)) for x in (-2.0, 0.0, 2.0)])
    boards = [_picture(rng, wall, place, share, texels) for place, share in zip(places, shares, strict=True)]
    return [*planes, *boards]  # from back to front: every picture stands out further than the balconies


def _picture(rng: Random, wall: _Wall, place: Array, share: float, texels: float) -> Plane:
    """Return a framed picture around a place of the wall."""
    size = (rng.uniform(1.0, 1.7), rng.uniform(0.9, 1.3))
    middle = place + rng.uniform(-0.15, 0.15, 2)
    paint = PAINTERS[rng.integers(len(PAINTERS))]
    return wall.board((middle[0], middle[1]), size, share, render.framed(rng, cv2, paint, size, 110 * texels))


def _frame(rng: Random, width: int, height: int) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Return the mask and the grey levels of a black frame."""
    mask = np.ones((height, width), bool)
    left, right = (rng.uniform(0.03, 0.1, 2) * width).astype(int)
    top, bottom = (rng.uniform(0.03, 0.12, 2) * height).astype(int)
    mask[top : height - bottom, left : width - right] = False
    return mask, np.zeros((height, width), np.uint8)


def _caption(rng: Random, width: int, height: int) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Return the mask and the grey levels of lines of text below and of a logo in a corner."""
    mask, levels = np.zeros((height, width), bool), np.zeros((height, width), np.uint8)
    lines, scale = int(rng.integers(1, 4)), width / 640
    top = height - int((22 * lines + 8) * scale)
    mask[top:] = True
    levels[top:] = 20
    for line in range(lines):
        text = "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ 0123456789:-"), 36))
        baseline = top + int((22 * line + 20) * scale)
        cv2.putText(levels, text, (int(8 * scale), baseline), cv2.FONT_HERSHEY_DUPLEX, 0.7 * scale, 235, 1, cv2.LINE_AA)
    side = int(rng.uniform(0.08, 0.16) * width)
    corner = (slice(0, side), slice(width - side, width) if rng.integers(2) else slice(0, side))
    picture = render.framed(rng, cv2, PAINTERS[rng.integers(2)], (1.0, 1.0), side)
    mask[corner], levels[corner] = True, (235 * picture + 8).round().clip(0, 255)
    return mask, levels


def _covered(pair: RenderedPair, mask: NDArray[np.bool_], levels: NDArray[np.uint8]) -> RenderedPair:
    """Return a pair with the same pixels replaced in both images, without the correspondences there."""
    near = [_masked(mask, points) for points in (pair.points1, pair.points2)]
    kept = ~(near[0] | near[1])
    return pair._replace(
        image1=np.where(mask, levels, pair.image1),
        image2=np.where(mask, levels, pair.image2),
        points1=pair.points1[kept],
        points2=pair.points2[kept],
    )


def _masked(mask: NDArray[np.bool_], points: Array) -> NDArray[np.bool_]:
    x, y = points.round().astype(int).T
    return np.asarray(mask[y, x])


def windows(rng: Random, size: Metres, density: float, cell: Metres) -> Texture:
    """Return rows of one window with its frame, curtain and patch of wall; only stains of 2 % tell the cells apart."""
    width, height = (int(metres * density) for metres in cell)
    one = (0.55 + 0.08 * render.noise(rng, cv2, (height, width), finest=4)).astype(np.float32)
    x, y = (np.round(np.array([0.2, 0.8]) * side).astype(int) for side in (width, height))
    bar = max(1, int(0.025 * width))
    curtain = (0.45 + 0.1 * render.noise(rng, cv2, (y[1] - y[0], x[1] - x[0]), finest=4)).astype(np.float32)
    render.circles(rng, cv2, curtain)
    one[y[0] - 2 * bar : y[1] + 2 * bar, x[0] - 2 * bar : x[1] + 2 * bar] = 0.95
    one[y[0] : y[1], x[0] : x[1]] = curtain
    for share in rng.uniform(0.25, 0.75, 2):
        middle = int(x[0] + share * (x[1] - x[0])), int(y[0] + share * (y[1] - y[0]))
        one[y[0] : y[1], middle[0] - bar : middle[0] + bar] = 0.15
        one[middle[1] - bar : middle[1] + bar, x[0] : x[1]] = 0.85
    columns, rows = (int(np.ceil(side / part)) for side, part in zip(size, cell, strict=True))
    texture = np.tile(one, (rows, columns))
    texture += 0.02 * render.noise(rng, cv2, texture.shape, finest=4)
    return np.asarray(cv2.GaussianBlur(texture, None, 0.8), np.float32)

"""Pictures of an estimate, drawn with Matplotlib (extra ``report``), which is imported only when needed."""

from __future__ import annotations

import importlib
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from numpy.typing import NDArray

from kornia_learnnorm.data.images import import_cv2, scaling
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.two_view.result import PairEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Pixels = NDArray[np.uint8]
Array = NDArray[np.float64]
BACKGROUND = "#11161d"  # dark, to fit light and dark pages
TEXT = "#e8edf2"
INLIER = "#45a1ff"
OUTLIER = "#ff5c5c"
WIDTH = 8.0  # inches
DPI = 150  # pixels per inch: pictures are 1,200 pixels wide
MAX_HEIGHT = 6.0  # inches, of an image above another
WIDE = 1.8  # width over height from which two images are stacked
UNEQUAL = 2.5  # ratio of the images' aspects from which they are stacked
NUM_LINES = 24  # epipolar lines at most
LINE = 0.17  # inches, height of a line of text
COLUMNS = 120  # characters in a line of text


def import_matplotlib() -> Any:
    """Return the package ``matplotlib`` with the modules that pictures need."""
    matplotlib = import_extra("matplotlib", "report", "drawing pictures")
    for name in ("backends.backend_agg", "collections", "colors", "figure"):
        importlib.import_module(f"matplotlib.{name}")
    return matplotlib


def draw_line(axes: Axes, line: Array, **style: Any) -> Line2D | None:
    """Draw the line a x + b y + c = 0 across axes, at any scale of (a, b, c); nothing for the line at infinity."""
    norm = np.linalg.norm(line[:2])
    if not norm > 0:
        return None
    a, b, c = (line / norm).tolist()
    return axes.axline((-a * c, -b * c), slope=-a / b if b else math.inf, **style)


def draw_pair(image1: Pixels, image2: Pixels, estimate: PairEstimate, path: str | Path) -> None:
    """Draw the matches in image 1 and what the matrix says in image 2, and write the picture whole or not at all.

    Image 1 shows the inliers in blue, each with its motion to image 2, and the outliers in red. Image 2 shows the
    epipolar lines of a random subset of the inliers, line and point in one colour (as Fan et al., Figure 6), or the
    mean of it and image 1 as the homography moves it. The images are grey or RGB, uint8, and may be reduced. The suffix
    of ``path`` decides the format.
    """
    for image, size in ((image1, estimate.size1), (image2, estimate.size2)):
        if abs(image.shape[1] * size[1] - image.shape[0] * size[0]) > max(size) + max(image.shape[:2]):
            raise ValueError(f"the estimate is of an image of {size[0]} x {size[1]} pixels, got shape {image.shape}")
    if moved := estimate.model == "homography":
        image2 = blend_images(image1, image2, estimate)
        shown = "image 1 as H moves it, over image 2; predicted error of H"
    else:
        shown = f"{min(NUM_LINES, estimate.num_inliers)} epipolar lines; predicted error of F"
    outliers = estimate.num_matches - estimate.num_inliers
    above = f"Image 1: {estimate.num_inliers} inliers and their motion in blue, {outliers} outliers in red\n"
    above += f"Image 2: {shown}: typically {estimate.predicted_error:.2f} px"
    below = [f"Warning ({warning.code}): {warning.text}." for warning in estimate.warnings]
    below = [line for text in below for line in textwrap.wrap(text, COLUMNS)]
    figure, (axes1, axes2) = _panels((image1, image2), (estimate.size1, estimate.size2), LINE * (3 + len(below)))
    figure.suptitle(above, x=0.01, ha="left", color=TEXT, fontsize=9, linespacing=1.2)
    if below:
        figure.supxlabel("\n".join(below), x=0.01, ha="left", color=OUTLIER, fontsize=9, linespacing=1.2)
    points1, points2, inliers = (x.numpy() for x in (estimate.points1, estimate.points2, estimate.inliers))
    motion = np.stack([points1, points2], 1)[inliers]
    lines = import_matplotlib().collections.LineCollection(motion, colors=INLIER, linewidths=0.7, alpha=0.8)
    axes1.add_collection(lines)
    axes1.plot(*points1[inliers].T, "o", color=INLIER, markersize=2)
    axes1.plot(*points1[~inliers].T, "x", color=OUTLIER, markersize=3.5, markeredgewidth=0.8)
    if not moved:
        _draw_lines(axes2, estimate)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor=figure.get_facecolor())


def stacked(sizes: Sequence[tuple[int, int]]) -> bool:
    """Return whether images of these widths and heights are shown one above the other, not side by side."""
    aspects = [width / height for width, height in sizes]
    return min(aspects) > WIDE or max(aspects) > UNEQUAL * min(aspects)


def _panels(images: Sequence[Pixels], sizes: Sequence[tuple[int, int]], margin: float) -> tuple[Figure, NDArray[Any]]:
    """Return a figure that shows each image in its own axes, in pixels of its full size, with a margin for texts."""
    aspects = [width / height for width, height in sizes]
    if stacked(sizes):
        heights = [min(WIDTH / aspect, MAX_HEIGHT) for aspect in aspects]
        height, grid = sum(heights), {"nrows": 2, "height_ratios": heights}
    else:
        height, grid = WIDTH / sum(aspects), {"ncols": 2, "width_ratios": aspects}
    style: dict[str, Any] = {"dpi": DPI, "facecolor": BACKGROUND, "layout": "constrained"}
    figure = import_matplotlib().figure.Figure(figsize=(WIDTH, height + margin), **style)
    panels = figure.subplots(**grid)
    for image, (width, height), axes in zip(images, sizes, panels, strict=True):
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="lanczos", extent=extent)
        axes.set_axis_off()
        axes.set_autoscale_on(False)
    return figure, panels


def blend_images(image1: Pixels, image2: Pixels, estimate: PairEstimate) -> Pixels:
    """Return the mean of image 2 and image 1 moved by the homography, RGB; image 2 alone where image 1 ends."""
    colours = [np.broadcast_to(np.atleast_3d(image), (*image.shape[:2], 3)) for image in (image1, image2)]
    (height1, width1), (height2, width2) = image1.shape[:2], image2.shape[:2]
    S1, S2 = scaling(estimate.size1, (width1, height1)), scaling(estimate.size2, (width2, height2))
    H_mat = (S2 @ estimate.matrix @ torch.linalg.inv(S1)).numpy()
    covered = np.dstack([colours[0], np.full((height1, width1), 255, np.uint8)])
    moved = import_cv2().warpPerspective(covered, H_mat, (width2, height2))
    share = moved[..., 3:] / 510
    return np.asarray(share * moved[..., :3] + (1 - share) * colours[1], np.uint8)


def _draw_lines(axes: Axes, estimate: PairEstimate) -> None:
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(estimate.inliers))[:NUM_LINES]
    lines = convert_points_to_homogeneous(estimate.points1[chosen]) @ estimate.matrix.mT
    hues = np.linspace(0, 1, len(chosen), endpoint=False)
    colours = [import_matplotlib().colors.hsv_to_rgb((hue, 0.6, 1.0)) for hue in hues]
    for line, colour in zip(lines.numpy(), colours, strict=True):
        draw_line(axes, line, color=colour, linewidth=1.0)
    x, y = estimate.points2[chosen].mT
    axes.scatter(x, y, s=20, c=colours, edgecolors="black", linewidths=0.7, zorder=3)

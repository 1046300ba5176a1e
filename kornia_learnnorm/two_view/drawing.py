"""Pictures of an estimate, drawn with Matplotlib (extra ``report``), which is imported only when needed."""

from __future__ import annotations

import importlib
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.two_view.result import PairEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["INLIER", "OUTLIER", "WIDE", "draw_line", "draw_matches", "draw_pair", "import_matplotlib"]

BACKGROUND = "#11161d"  # dark, to fit light and dark pages
TEXT = "#e8edf2"
INLIER = "#45a1ff"
OUTLIER = "#ff5c5c"
WIDTH = 8.0  # inches
DPI = 150  # pixels per inch: pictures are 1,200 pixels wide
CAPTION = 0.26  # inches, height
GAP = 0.08  # inches, between images
WIDE = 1.8  # width over height from which two images are stacked
UNEQUAL = 2.5  # ratio of the images' aspects from which they are stacked
LINE = 0.17  # inches, height of a line of warnings
WARNING_COLUMNS = 120  # characters in a line of warnings
MAX_HEIGHT = 6.0  # inches, of a stacked image


def import_matplotlib() -> Any:
    """Return the package ``matplotlib`` with its modules ``collections``, ``colors`` and ``figure``."""
    matplotlib = import_extra("matplotlib", "report", "drawing pictures")
    for name in ("collections", "colors", "figure"):
        importlib.import_module(f"matplotlib.{name}")
    return matplotlib


def draw_line(axes: Axes, line: npt.NDArray[np.float64], **style: Any) -> Line2D | None:
    """Draw the line a x + b y + c = 0 across axes, at any scale of (a, b, c); nothing for the line at infinity."""
    norm = np.linalg.norm(line[:2])
    if not norm > 0:
        return None
    a, b, c = (line / norm).tolist()
    return axes.axline((-a * c, -b * c), slope=-a / b if b else math.inf, **style)


def draw_matches(
    axes: Axes, points1: npt.NDArray[np.float64], points2: npt.NDArray[np.float64], inliers: npt.NDArray[np.bool_]
) -> None:
    """Draw the matches (N, 2) in image 1: inliers as dots with their motion to image 2, outliers as crosses."""
    motion = np.stack([points1, points2], 1)[inliers]
    lines = import_matplotlib().collections.LineCollection(motion, colors=INLIER, linewidths=0.7, alpha=0.8)
    axes.add_collection(lines)
    axes.plot(*points1[inliers].T, "o", color=INLIER, markersize=2, label="inliers and their motion")
    axes.plot(*points1[~inliers].T, "x", color=OUTLIER, markersize=3.5, markeredgewidth=0.8, label="outliers")


def draw_pair(
    image1: npt.NDArray[np.uint8],
    image2: npt.NDArray[np.uint8],
    estimate: PairEstimate,
    path: str | Path,
    num_lines: int = 24,
    seed: int = 0,
) -> None:
    """Draw the matches in image 1 and epipolar lines in image 2, and write the picture whole or not at all.

    Image 1 shows the inliers in blue, each with its motion to image 2, and the outliers in red. Image 2 shows the
    epipolar lines of a random subset of the inliers, line and point in one colour (as Fan et al., Figure 10), and the
    predicted error. Warnings are written below. The images are grey or RGB, uint8, and may be reduced. Wide images and
    those of unequal shapes are stacked, others stand side by side. The suffix of ``path`` decides the format.
    """
    for image, size in ((image1, estimate.size1), (image2, estimate.size2)):
        if abs(image.shape[1] * size[1] - image.shape[0] * size[0]) > max(size) + max(image.shape[:2]):
            raise ValueError(f"the estimate is of an image of {size[0]} x {size[1]} pixels, got shape {image.shape}")
    if num_lines < 0:
        raise ValueError(f"num_lines must not be negative, got {num_lines}")
    warnings = [
        line
        for warning in estimate.warnings
        for line in textwrap.wrap(f"Warning ({warning.code}): {warning.text}.", WARNING_COLUMNS)
    ]
    figure, (axes1, axes2) = _panels((image1, image2), (estimate.size1, estimate.size2), LINE * len(warnings))
    draw_matches(axes1, estimate.points1.numpy(), estimate.points2.numpy(), estimate.inliers.numpy())
    motion, outliers = f"{estimate.num_inliers} inliers and their motion", estimate.num_matches - estimate.num_inliers
    _caption(axes1, [("image 1", TEXT), (motion, INLIER), (f"{outliers} outliers", OUTLIER)])
    _draw_lines(axes2, estimate, num_lines, seed)
    if warnings:
        x, y = (GAP / figure.get_size_inches()).tolist()
        figure.text(x, y, "\n".join(warnings), color=OUTLIER, fontsize=9, va="bottom", linespacing=1.2)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor=figure.get_facecolor())


def _panels(
    images: Sequence[npt.NDArray[np.uint8]], sizes: Sequence[tuple[int, int]], footer: float
) -> tuple[Figure, list[Axes]]:
    """Return a figure that shows each image in its own axes, in pixels of its full size, above a footer (inches)."""
    aspects = [width / height for width, height in sizes]
    if min(aspects) > WIDE or max(aspects) > UNEQUAL * min(aspects):
        heights = [min((WIDTH - 2 * GAP) / aspect, MAX_HEIGHT) for aspect in aspects]
        boxes = [(GAP, footer + heights[1] + CAPTION + GAP), (GAP, footer + GAP)]
        total = footer + sum(heights) + 2 * CAPTION + GAP
    else:
        heights = [(WIDTH - 3 * GAP) / sum(aspects)] * 2
        boxes = [(GAP, footer + GAP), (2 * GAP + heights[0] * aspects[0], footer + GAP)]
        total = footer + heights[0] + CAPTION + GAP
    figure = import_matplotlib().figure.Figure(figsize=(WIDTH, total), dpi=DPI, facecolor=BACKGROUND)
    axes = []
    for image, size, (left, bottom), height, aspect in zip(images, sizes, boxes, heights, aspects, strict=True):
        axes.append(figure.add_axes((left / WIDTH, bottom / total, height * aspect / WIDTH, height / total)))
        extent = (-0.5, size[0] - 0.5, size[1] - 0.5, -0.5)
        axes[-1].imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="lanczos", extent=extent)
        axes[-1].set_axis_off()
        axes[-1].set_autoscale_on(False)
    return figure, axes


def _draw_lines(axes: Axes, estimate: PairEstimate, num_lines: int, seed: int) -> None:
    """Draw the epipolar lines of some inliers, each with its point; write the error above."""
    hsv_to_rgb = import_matplotlib().colors.hsv_to_rgb
    rows = torch.nonzero(estimate.inliers).flatten().numpy()
    chosen = np.random.default_rng(seed).permutation(rows)[:num_lines]
    points1, points2 = estimate.points1[chosen].numpy(), estimate.points2[chosen].numpy()
    lines = np.pad(points1, ((0, 0), (0, 1)), constant_values=1.0) @ estimate.F_mat.numpy().T
    hues = np.linspace(0, 1, len(chosen), endpoint=False)
    rgb = hsv_to_rgb(np.stack([hues, np.full_like(hues, 0.6), np.ones_like(hues)], 1))
    for line, color in zip(lines, rgb, strict=True):
        draw_line(axes, line, color=color, linewidth=1.0)
    axes.scatter(points2[:, 0], points2[:, 1], s=20, c=rgb, edgecolors="black", linewidths=0.7, zorder=3)
    error = f"predicted error of F: typically {estimate.predicted_error:.2f} px"
    _caption(axes, [("image 2", TEXT), (f"{len(chosen)} epipolar lines", TEXT), (error, TEXT)])


def _caption(axes: Axes, parts: list[tuple[str, str]], size: float = 9) -> None:
    """Write texts in a row above an image, each in its colour; shrink them to the width of the image."""
    style: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "bottom"}
    labels = [axes.annotate(text, (0, 1), (0, 4), color=color, fontsize=size, **style) for text, color in parts]
    widths = [label.get_window_extent().width * 72 / DPI + 12 for label in labels]
    shrink = min(1.0, axes.get_window_extent().width * 72 / DPI / sum(widths))
    for label, left in zip(labels, np.cumsum([0, *widths[:-1]]), strict=True):
        label.set_position((shrink * left, 4))
        label.set_fontsize(shrink * size)

"""One image of the page with its matches, the pixel under the mouse and epipolar lines, as a Bokeh figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from bokeh.events import Event, MouseMove, PointEvent, Tap
from bokeh.layouts import column, gridplot
from bokeh.models import ColumnDataSource, Range1d
from bokeh.models.widgets import Div
from bokeh.plotting import figure
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.demo.compute import METHODS, ImageFile, epipolar_segment
from kornia_learnnorm.two_view.drawing import INLIER, OUTLIER

__all__ = ["ImageView"]

COLORS = dict(zip(METHODS, ("#ffd43b", "#51e898", "#b000ff"), strict=True))
POINTER = "#00e5ff"
WIDTHS = dict(zip(METHODS, (2, 5, 2), strict=True))  # of lines, pixels: where two coincide, both are seen
NOTHING = {"x": [math.nan], "y": [math.nan]}  # without a row, the legend has no colour
MIN_ASPECT = 4 / 3  # width over height of a figure; a higher image has margins
EMPTY_SIZE = (640, 480)  # width and height where there is no image yet


class ImageView:
    """An image in its own pixels, which can be zoomed."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._size = EMPTY_SIZE
        self._image = ColumnDataSource({"image": [], "width": [], "height": []})
        self._inliers, self._outliers, self._pointer = (ColumnDataSource(NOTHING) for _ in range(3))
        self._lines = {name: ColumnDataSource(NOTHING, name=f"{title}, {name}") for name in METHODS}
        self._caption = Div(text=title, render_as_text=True, disable_math=True, sizing_mode="stretch_width")
        self._figure = self._make_figure()
        self.show(None)
        styles = {"flex": "1 1 340px", "min-width": "0"}
        # a grid of one: its toolbar stands outside of the figure, whose pixels stay square
        grid = gridplot([[self._figure]], toolbar_location="above", sizing_mode="scale_width")
        grid.toolbar.logo = None
        self.layout = column(self._caption, grid, sizing_mode="stretch_width", styles=styles)

    def _make_figure(self) -> figure:
        style: dict[str, Any] = {"sizing_mode": "scale_width", "background_fill_color": "#11161d", "min_border": 0}
        style |= {"tools": "pan,wheel_zoom,box_zoom,reset", "outline_line_color": None}
        plot = figure(name=self._title, x_range=Range1d(), y_range=Range1d(), **style)
        plot.axis.visible = plot.grid.visible = False
        plot.image_rgba("image", x=-0.5, y=-0.5, dw="width", dh="height", source=self._image)
        plot.scatter("x", "y", source=self._outliers, marker="x", size=7, color=OUTLIER, line_width=1.2)
        plot.scatter("x", "y", source=self._inliers, marker="circle", size=4, color=INLIER, line_color=None)
        for name, source in self._lines.items():
            plot.line("x", "y", source=source, color=COLORS[name], line_width=WIDTHS[name], legend_label=name)
        plot.scatter("x", "y", source=self._pointer, marker="cross", size=20, color=POINTER, line_width=3)
        plot.legend.update(location="bottom_left", orientation="horizontal", click_policy="hide", padding=4, margin=4)
        plot.legend.update(label_text_font_size="11px", background_fill_alpha=0.7, spacing=8)
        return plot

    def on_pointer(self, callback: Callable[[float, float], None]) -> None:
        """Call back with the pixel under the mouse, or where the screen is touched."""

        def handle(event: Event) -> None:
            x, y = (event.x, event.y) if isinstance(event, PointEvent) else (None, None)
            if x is not None and y is not None and -0.5 <= x < self._size[0] and -0.5 <= y < self._size[1]:
                callback(x, y)

        self._figure.on_event(MouseMove, handle)
        self._figure.on_event(Tap, handle)

    def show(self, image: ImageFile | None) -> None:
        """Show an image, or none."""
        self._size = width, height = EMPTY_SIZE if image is None else image.size
        self._figure.aspect_ratio = max(width / height, MIN_ASPECT)
        margin = (self._figure.aspect_ratio * height - width) / 2
        left, right = -0.5 - margin, width - 0.5 + margin
        self._figure.x_range.update(start=left, end=right, reset_start=left, reset_end=right)
        self._figure.y_range.update(start=height - 0.5, end=-0.5, reset_start=height - 0.5, reset_end=-0.5)
        shown = [] if image is None else [image]
        self._caption.text = self._title + "".join(f": {x.name}, {width} x {height} pixels" for x in shown)
        data = {"image": [_rgba(x.pixels) for x in shown]}
        self._image.data = {**data, "width": [width] * len(shown), "height": [height] * len(shown)}

    def clear(self) -> None:
        """Remove everything but the image."""
        for source in (self._inliers, self._outliers, self._pointer, *self._lines.values()):
            source.data = NOTHING

    def show_matches(self, points: NDArray[np.float64], inliers: NDArray[np.bool_], with_outliers: bool) -> None:
        """Show the matches (N, 2) that are inliers by a mask (N,), and the others too if wanted."""
        self._inliers.data = dict(zip("xy", points[inliers].T, strict=True))
        self._outliers.data = dict(zip("xy", points[~inliers & with_outliers].T, strict=True))

    def mark(self, point: tuple[float, float]) -> None:
        """Mark the pixel under the mouse and remove the lines."""
        self._pointer.data = {"x": [point[0]], "y": [point[1]]}
        for source in self._lines.values():
            source.data = NOTHING

    def draw_lines(self, matrices: Mapping[str, Tensor], point: tuple[float, float]) -> None:
        """Draw the epipolar lines F x of a pixel of the other image by the methods' matrices F (3, 3)."""
        self._pointer.data = NOTHING
        for name, source in self._lines.items():
            ends = epipolar_segment(matrices[name], point, self._size) if name in matrices else None
            source.data = NOTHING if ends is None else dict(zip("xy", ends.T, strict=True))


def _rgba(pixels: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return colours (H, W, 3) as Bokeh takes them, (H, W)."""
    opaque = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=-1)
    return np.ascontiguousarray(opaque).view(np.uint32)[..., 0]

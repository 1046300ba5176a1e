"""How the figures of a report are drawn, with Matplotlib (extra ``report``).

Lines and letters have the colour of the text around them, so that the pictures fit light and dark pages.
"""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any, NamedTuple

from kornia_learnnorm.evaluation.drawing import import_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLORS", "INK", "Picture", "make_figure", "make_picture"]

INK = "#010203"  # replaced by the page's colour
# Legible on white and on black; after P. Tol's and Okabe and Ito's palettes for colour blindness.
_HUES = "8b8b8b e69f00 2b9fd9 18a57a d55e00 cc79a7 a0714f 7a6ff0 b8a400 c2443f 5f8f2f"
COLORS = tuple(f"#{hue}" for hue in _HUES.split())


class Picture(NamedTuple):
    """A figure of a report.

    Attributes:
        name: file name without suffix.
        title: heading.
        text: what it shows.
        svg: the picture.
    """

    name: str
    title: str
    text: str
    svg: str


def make_figure(rows: int, columns: int, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes in rows and columns, row by row.

    Args:
        rows: number of rows.
        columns: number of columns.
        height: height in inches; the width is eight.

    Raises:
        ImportError: if Matplotlib is not installed.

    """
    matplotlib = import_matplotlib()
    style: dict[str, Any] = {
        "svg.fonttype": "none",
        "font.size": 10,
        "font.family": "sans-serif",
        "svg.hashsalt": "report",
    }
    matplotlib.rcParams.update(style)
    figure = matplotlib.figure.Figure(figsize=(8.0, height), layout="constrained", facecolor="none")
    axes = [figure.add_subplot(rows, columns, place + 1, facecolor="none") for place in range(rows * columns)]
    for one in axes:
        one.grid(color=INK, alpha=0.15, linewidth=0.6)
        one.tick_params(colors=INK, which="both")
        one.xaxis.label.set_color(INK)
        one.yaxis.label.set_color(INK)
        one.spines[["top", "right"]].set_visible(False)
        one.spines[["left", "bottom"]].set_color(INK)
    return figure, axes


def make_picture(figure: Figure, name: str, title: str, text: str, legend: bool = True) -> Picture:
    """Return a figure as SVG, with one legend of all its axes above.

    Args:
        figure: from :func:`make_figure`.
        name: file name without suffix.
        title: heading.
        text: what it shows.
        legend: whether there is one.

    """
    if legend:
        entries: dict[str, Any] = {}
        for axes in figure.axes:
            handles, labels = axes.get_legend_handles_labels()
            entries |= dict(zip(labels, handles, strict=True))
        where: dict[str, Any] = {"loc": "outside upper center", "ncols": 5, "frameon": False, "labelcolor": INK}
        figure.legend([*entries.values()], [*entries], **where)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    # Several pictures share a page: their identifiers must differ.
    svg = re.sub(r'id="([^"]+)"', rf'id="{name}-\1"', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", svg)
    return Picture(name, title, text, svg)

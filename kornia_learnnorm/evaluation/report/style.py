"""Layout and colours of the pictures of a report, drawn with Matplotlib (extra ``report``).

Lines and letters take the colour of the text around them, so that the pictures fit light and dark pages.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from kornia_learnnorm.evaluation.methods import CLOSED_FORMS, base_name
from kornia_learnnorm.two_view.drawing import import_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#010203"  # placeholder that make_picture replaces by the text colour of the page
# Legible on white and on black; after P. Tol's and Okabe and Ito's palettes for colour blindness.
HUES = "8b8b8b e69f00 2b9fd9 18a57a d55e00 cc79a7 a0714f 7a6ff0 b8a400 c2443f 5f8f2f"
WIDTH = 8.0  # inches
SETTINGS: dict[str, Any] = {
    **{f"{key}.color": INK for key in ("text", "xtick", "ytick", "grid")},
    **{f"axes.{key}color": INK for key in ("label", "edge")},
    **{f"axes.spines.{side}": False for side in ("top", "right")},
    **{f"{key}.facecolor": "none" for key in ("figure", "axes")},
    "axes.grid": True,
    "grid.alpha": 0.15,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "font.size": 10,
    "font.family": "sans-serif",
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
}


class ReportPicture(NamedTuple):
    """A picture and its caption."""

    name: str  # of the file, without suffix
    title: str
    text: str  # what the picture shows
    svg: str


@contextmanager
def report_style() -> Iterator[None]:
    """Apply the Matplotlib settings of a report to the figures made inside, and restore them."""
    with import_matplotlib().rc_context(SETTINGS):
        yield


def method_colors(names: Iterable[str]) -> dict[str, str]:
    """Return a colour for each method; they repeat after eleven methods."""
    hues = HUES.split()
    return {name: f"#{hues[place % len(hues)]}" for place, name in enumerate(names)}


def line_style(name: str) -> str:
    """Return the line style of a method: dashed for one with weights, which often lies on a closed form."""
    return "-" if base_name(name) in CLOSED_FORMS or ":" in name else "--"


def make_figure(rows: int, columns: int, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """Return a figure of eight inches with axes row by row; call it inside :func:`report_style`."""
    figure = import_matplotlib().figure.Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False).flatten().tolist()


def make_picture(figure: Figure, name: str, title: str, text: str, legend: bool = True) -> ReportPicture:
    """Return a figure as SVG, with one legend of all axes above it; call it inside :func:`report_style`."""
    if legend:
        entries: dict[str, Any] = {}
        for axes in figure.axes:
            handles, labels = axes.get_legend_handles_labels()
            entries |= dict(zip(labels, handles, strict=True))
        figure.legend([*entries.values()], [*entries], loc="outside upper center", ncols=5)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    # The pictures share a page, so their identifiers must differ.
    svg = re.sub(r'id="([^"]+)"', rf'id="{name}-\1"', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", svg)
    return ReportPicture(name, title, text, svg)

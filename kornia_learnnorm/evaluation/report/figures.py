"""Pictures of a run of predictions, drawn with Matplotlib (extra ``report``).

Lines and letters take the colour of the text around them, so that the pictures fit light and dark pages.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from kornia_learnnorm.evaluation.methods import CLOSED_FORMS, REFINED, SHIPPED, base_name
from kornia_learnnorm.evaluation.report.method_tables import papers_data
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell
from kornia_learnnorm.two_view.drawing import import_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#010203"  # placeholder that _make_picture replaces by the text colour of the page
# Of methods, in turn. Legible on white and on black; after P. Tol's and Okabe and Ito's palettes for colour blindness.
HUES = "8b8b8b e69f00 2b9fd9 18a57a d55e00 cc79a7 a0714f 7a6ff0 b8a400 c2443f 5f8f2f"
SIZE = 8.0, 3.8  # inches
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
Colors = dict[str, str]  # by the method
DOTS: dict[str, Any] = {"marker": "o", "markersize": 3}
MAX_FRAMES = 20  # image pairs on the axis of Figure 4a
RHO_WINDOW = 100  # successive samples in a mean of Figure 9
NORMALISATIONS = ("none", "Hartley", "whitening", "reweighted", "paper", "crossview", "searched")


class ReportPicture(NamedTuple):
    """A picture and its caption."""

    name: str  # of the file, without suffix
    title: str
    text: str  # what the picture shows
    svg: str


def report_figures(run: Run) -> list[ReportPicture]:
    """Draw all pictures of a run, of the first store with filtered samples."""
    cell = next((cell for cell in run.cells if cell.protocol == "filtered"), run.cells[0])
    colors = dict(zip(run.about["methods"], cycle(f"#{hue}" for hue in HUES.split()), strict=False))
    papers, pictures = papers_data(run.about["stores"][cell.store]), []
    with import_matplotlib().rc_context(SETTINGS):
        for number, (title, draw) in DRAWINGS.items():
            if draw is not _rho or len(cell.pair) >= RHO_WINDOW:
                figure = import_matplotlib().figure.Figure(figsize=SIZE, layout="constrained")
                text, svg = draw(figure, cell, colors), _to_svg(figure, f"figure-{number}")
                title += f" (Figure {number})" * bool(papers)  # of Fan et al.
                pictures.append(ReportPicture(f"figure-{number}", title, text, svg))
    return pictures


def _per_frame(figure: Figure, cell: RunCell, colors: Colors) -> str:
    chosen = _present(cell, "Hartley", "paper", "crossview", "Hartley+LM", "crossview+LM")
    axes, pair = figure.subplots(), cell.pair.numpy()
    frames = np.unique(pair)[:MAX_FRAMES]
    for name in chosen:
        own = cell.predictions[name]["own"].numpy()
        means = [own[(pair == frame) & np.isfinite(own)].mean() for frame in frames]
        dashes = "--" if name.endswith(REFINED) else "-"
        axes.plot(frames, means, dashes, color=colors[name], label=name, **DOTS)
    axes.set(xlabel="image pair", ylabel="mean error of a pair's samples, px", yscale="log")
    axes.locator_params(axis="x", integer=True)
    text = f"Mean symmetric epipolar distance of a pair's samples, first {len(frames)} image pairs of {cell.store}."
    return text + " Dashed: with non-linear refinement." * any(name.endswith(REFINED) for name in chosen)


def _distribution(figure: Figure, cell: RunCell, colors: Colors) -> str:
    axes, names = figure.subplots(), _present(cell, *NORMALISATIONS, "Hartley+optimal")
    for name in names:
        own = np.sort(cell.predictions[name]["own"].numpy())
        axes.plot(own, np.arange(1, len(own) + 1) / len(own), _line_style(name), color=colors[name], label=name)
    axes.set(xlabel="symmetric epipolar distance of a sample, px", ylabel="share of samples below", xscale="log")
    axes.set(xlim=(0.01, 60), ylim=(0, 1))
    text = f"Distribution of the errors of {len(cell.pair)} samples of eight correspondences of {cell.title}."
    return text + _dashes(names)


def _distances(figure: Figure, cell: RunCell, colors: Colors) -> str:
    views, bins = figure.subplots(1, 2), np.geomspace(0.7, 30, 60).tolist()
    for view, axes in enumerate(views, 1):
        for name in _present(cell, "reweighted", "paper", "crossview", "searched"):
            values = cell.predictions[name][f"distance{view}"].numpy()
            axes.hist(values, bins, histtype="step", color=colors[name], label=name, linewidth=1.5)
        axes.axvline(2**0.5, color=colors.get("Hartley", INK), label="Hartley")
        axes.set(xscale="log", xlabel=f"mean distance from the origin, view {view} (no unit)")
        axes.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axes.minorticks_off()
    views[0].set_ylabel("samples")
    return f"Mean distances of the normalised points from the origin, {cell.title}. Hartley's is the square root of 2."


def _conditions(figure: Figure, cell: RunCell, colors: Colors) -> str:
    axes, names = figure.subplots(), _present(cell, *NORMALISATIONS)[::-1]
    for place, name in enumerate(names):
        low, middle, high = np.nanquantile(cell.predictions[name]["condition_number"].numpy(), [0.25, 0.5, 0.75])
        axes.plot([low, high], [place, place], color=colors[name], linewidth=6, solid_capstyle="round", alpha=0.5)
        axes.plot(middle, place, "o", color=colors[name], markersize=8)
        axes.annotate(f"{middle:.3g}", (middle, place), (0, 8), textcoords="offset points", ha="center", color=INK)
    axes.set_yticks(range(len(names)), names)
    axes.set(xscale="log", xlabel="condition number of the design matrix (no unit)", ylim=(-0.6, len(names) - 0.2))
    return f"Largest over eighth singular value of the design matrix. Dot: median; bar: quartiles. {cell.title}."


def _rho(figure: Figure, cell: RunCell, colors: Colors) -> str:
    axes, names = figure.subplots(), _present(cell, "Hartley", "whitening", "paper", "crossview")
    for name in names:
        rho = cell.predictions[name]["rho"].numpy()
        means = [np.mean(rho[i : i + RHO_WINDOW]) for i in range(0, len(rho) - RHO_WINDOW + 1, RHO_WINDOW)]
        places = np.arange(len(means)) * RHO_WINDOW
        axes.plot(places, means, _line_style(name), color=colors[name], label=name, **DOTS)
    axes.set(yscale="log", xlabel="sample", ylabel=f"mean rho of {RHO_WINDOW} samples (no unit)")
    return (
        "Second over third singular value of the normalised matrix before the projection to rank 2, which changes the "
        f"less the larger it is. Means of {RHO_WINDOW} successive samples, {cell.title}.{_dashes(names)}"
    )


DRAWINGS: dict[str, tuple[str, Callable[[Figure, RunCell, Colors], str]]] = {
    "4a": ("Error by frame", _per_frame),
    "4b": ("Distribution of errors", _distribution),
    "5": ("Normalised distances", _distances),
    "8": ("Condition numbers", _conditions),
    "9": ("Singularity ratio", _rho),
}


def _dashes(names: list[str]) -> str:
    return " Dashed: learned." if "--" in map(_line_style, names) else ""


def _present(cell: RunCell, *names: str) -> list[str]:
    """Return the methods of the run among ``names``, and all methods that are not built in, such as own weights."""
    own = [name for name in cell.predictions if "+" not in name and name not in {*CLOSED_FORMS, *SHIPPED}]
    return [name for name in names if name in cell.predictions] + own


def _line_style(name: str) -> str:
    """Return the line style of a method: dashed for one with weights, which often lies on a closed form."""
    return "-" if base_name(name) in CLOSED_FORMS or ":" in name else "--"


def _to_svg(figure: Figure, name: str) -> str:
    """Return a figure as SVG, with one legend above its axes, whose entries are the same."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper center", ncols=5)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    # The pictures share a page, so their identifiers must differ.
    svg = re.sub(r'id="([^"]+)"', rf'id="{name}-\1"', svg)
    return re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", svg)

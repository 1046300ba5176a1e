"""Pictures of a run of predictions, drawn with Matplotlib (extra ``report``).

Lines and letters take the colour of the text around them, so that the pictures fit light and dark pages.
"""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.evaluation.methods import CLOSED_FORMS, REFINED, base_name
from kornia_learnnorm.evaluation.report.rates import papers_data
from kornia_learnnorm.evaluation.runs.example import TRIALS
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell
from kornia_learnnorm.evaluation.runs.results_store import Arrays
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.protocol import INLIER_THRESHOLD
from kornia_learnnorm.two_view.drawing import INLIER, WIDE, draw_line, draw_matches, import_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#010203"  # placeholder that _make_picture replaces by the text colour of the page
# Of methods, in turn. Legible on white and on black; after P. Tol's and Okabe and Ito's palettes for colour blindness.
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
DOTS: dict[str, Any] = {"marker": "o", "markersize": 3}
NUM_LINES = 5  # epipolar lines of each matrix
LINE_METHODS = ("Hartley", "crossview")
TRUTH = "ground truth"  # name of its epipolar lines
MAX_FRAMES = 20  # image pairs on the axis of Figure 4a
RHO_WINDOW = 100  # successive samples in a mean of Figure 13
NORMALISATIONS = ("none", "Hartley", "whitening", "reweighted", "paper", "crossview", "searched")
BUILT_IN = {*NORMALISATIONS, "crossview-synthetic"}


class ReportPicture(NamedTuple):
    """A picture and its caption."""

    name: str  # of the file, without suffix
    title: str
    text: str  # what the picture shows
    svg: str


def report_figures(run: Run) -> list[ReportPicture]:
    """Draw all pictures of a run; those of samples use the first store with filtered samples."""
    cell = next((cell for cell in run.cells if cell.protocol == "filtered"), run.cells[0])
    hues = HUES.split()
    colors = {name: f"#{hues[place % len(hues)]}" for place, name in enumerate(run.about["methods"])}
    last = [_conditions, _rho] if len(cell.pair) >= RHO_WINDOW else [_conditions]
    with import_matplotlib().rc_context(SETTINGS):
        pictures = [(cell.store, draw(cell, colors)) for draw in (_per_frame, _distribution, _distances)]
        example = [*draw_example(run, colors), *([_by_size(run, colors)] if run.sizes else [])]
        pictures += [(str(run.example["store"]), picture) for picture in example]
        pictures += [(cell.store, draw(cell, colors)) for draw in last]
    # The numbers of Fan et al. are in the titles where a store has their test data.
    return [
        p._replace(title=f"{p.title} (Figure {p.name.removeprefix('figure-')})")
        if papers_data(run.about["stores"][store])
        else p
        for store, p in pictures
    ]


def _per_frame(cell: RunCell, colors: dict[str, str]) -> ReportPicture:
    chosen = _present(cell, "Hartley", "paper", "crossview", "Hartley+LM", "crossview+LM")
    figure, (axes,) = _make_figure(1, 1)
    pair = cell.pair.numpy()
    frames = np.unique(pair)[:MAX_FRAMES]
    for name in chosen:
        own = cell.predictions[name]["own"].numpy()
        means = [own[(pair == frame) & np.isfinite(own)].mean() for frame in frames]
        dashes = "--" if name.endswith(REFINED) else "-"
        axes.plot(frames, means, dashes, color=colors[name], label=name, **DOTS)
    axes.set(xlabel="image pair", ylabel="mean error of a pair's samples, px", yscale="log")
    axes.locator_params(axis="x", integer=True)
    text = f"Mean symmetric epipolar distance of a pair's samples, first {len(frames)} image pairs of {cell.store}."
    if any(name.endswith(REFINED) for name in chosen):
        text += " Dashed: with non-linear refinement."
    return _make_picture(figure, "figure-4a", "Error by frame", text)


def _distribution(cell: RunCell, colors: dict[str, str]) -> ReportPicture:
    figure, (axes,) = _make_figure(1, 1)
    names = _present(cell, *NORMALISATIONS, "Hartley+optimal")
    for name in names:
        own = np.sort(cell.predictions[name]["own"].numpy())
        axes.plot(own, np.arange(1, len(own) + 1) / len(own), _line_style(name), color=colors[name], label=name)
    axes.set(xlabel="symmetric epipolar distance of a sample, px", ylabel="share of samples below", xscale="log")
    axes.set(xlim=(0.01, 60), ylim=(0, 1))
    text = f"Distribution of the errors of {len(cell.pair)} samples of eight correspondences of {cell.title}."
    text += _dashes(names)
    return _make_picture(figure, "figure-4b", "Distribution of errors", text)


def _distances(cell: RunCell, colors: dict[str, str]) -> ReportPicture:
    figure, views = _make_figure(1, 2)
    bins = np.geomspace(0.7, 30, 60).tolist()
    for view, axes in enumerate(views, 1):
        for name in _present(cell, "reweighted", "paper", "crossview", "searched"):
            values = cell.predictions[name][f"distance{view}"].numpy()
            axes.hist(values, bins, histtype="step", color=colors[name], label=name, linewidth=1.5)
        axes.axvline(2**0.5, color=colors.get("Hartley", INK), label="Hartley")
        axes.set(xscale="log", xlabel=f"mean distance from the origin, view {view} (no unit)")
        axes.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axes.minorticks_off()
    views[0].set_ylabel("samples")
    text = f"Mean distances of the normalised points from the origin, {cell.title}. Hartley's is the square root of 2."
    return _make_picture(figure, "figure-5", "Normalised distances", text)


def _by_size(run: Run, colors: dict[str, str]) -> ReportPicture:
    figure, panels = _make_figure(1, 2)
    titles = {"own": "the sample's points", "truth": "ground-truth inliers"}
    for axes, (key, title) in zip(panels, titles.items(), strict=True):
        for name, sizes in run.sizes.items():
            axes.plot(sizes["size"], sizes[key], color=colors[name], label=name, **DOTS)
        axes.set(xscale="log", yscale="log", xlabel="correspondences in a sample")
        axes.set(ylabel=f"median error of {title}, px")
        axes.set_xticks(ticks := [8, 16, 32, 64, 128, 256], map(str, ticks))
        axes.minorticks_off()
    pair = run.example
    outliers = 1 - float(example_inliers(pair).mean())
    text = (
        f"Median of {TRIALS:,} random samples of one random image pair, {' and '.join(pair['names'])} of "
        f"{pair['store']}, against the number of correspondences in a sample. They are drawn from the "
        f"{len(pair['points1'])} matches that pass the ratio test, of which {100 * outliers:.0f} % are outliers, "
        f"farther than {INLIER_THRESHOLD:g} px from the ground truth. Least squares does not reject outliers, so "
        "errors of ground-truth inliers can grow with the size of the sample."
    )
    return _make_picture(figure, "figure-11", "Number of correspondences", text)


def _conditions(cell: RunCell, colors: dict[str, str]) -> ReportPicture:
    figure, (axes,) = _make_figure(1, 1)
    names = _present(cell, *NORMALISATIONS)[::-1]
    for place, name in enumerate(names):
        low, middle, high = np.nanquantile(cell.predictions[name]["condition_number"].numpy(), [0.25, 0.5, 0.75])
        axes.plot([low, high], [place, place], color=colors[name], linewidth=6, solid_capstyle="round", alpha=0.5)
        axes.plot(middle, place, "o", color=colors[name], markersize=8)
        axes.annotate(f"{middle:.3g}", (middle, place), (0, 8), textcoords="offset points", ha="center", color=INK)
    axes.set_yticks(range(len(names)), names)
    axes.set(xscale="log", xlabel="condition number of the design matrix (no unit)")
    axes.set_ylim(-0.6, len(names) - 0.2)
    text = f"Largest over eighth singular value of the design matrix. Dot: median; bar: quartiles. {cell.title}."
    return _make_picture(figure, "figure-12", "Condition numbers", text, legend=False)


def _rho(cell: RunCell, colors: dict[str, str]) -> ReportPicture:
    figure, (axes,) = _make_figure(1, 1)
    names = _present(cell, "Hartley", "whitening", "paper", "crossview")
    for name in names:
        rho = cell.predictions[name]["rho"].numpy()
        means = [np.mean(rho[i : i + RHO_WINDOW]) for i in range(0, len(rho) - RHO_WINDOW + 1, RHO_WINDOW)]
        places = np.arange(len(means)) * RHO_WINDOW
        axes.plot(places, means, _line_style(name), color=colors[name], label=name, **DOTS)
    axes.set(yscale="log", xlabel="sample", ylabel=f"mean rho of {RHO_WINDOW} samples (no unit)")
    text = (
        "Second over third singular value of the normalised matrix before the projection to rank 2, which changes the "
        f"less the larger it is. Means of {RHO_WINDOW} successive samples, {cell.title}.{_dashes(names)}"
    )
    return _make_picture(figure, "figure-13", "Singularity ratio", text)


def _dashes(names: list[str]) -> str:
    return " Dashed: learned." if "--" in map(_line_style, names) else ""


def _present(cell: RunCell, *names: str) -> list[str]:
    """Return the methods of the run among ``names``, and all methods that are not built in, such as own weights."""
    own = [name for name in cell.predictions if "+" not in name and name not in BUILT_IN]
    return [name for name in names if name in cell.predictions] + own


def draw_example(run: Run, colors: dict[str, str]) -> list[ReportPicture]:
    """Draw the example image pair of a run, without the images; nothing where the run has no sample of it."""
    pair = run.example
    place = (str(pair["store"]), "filtered") if pair else ("", "")
    cell = next((cell for cell in run.cells if (cell.store, cell.protocol) == place), None)
    if cell is None or not (cell.pair == int(pair["pair"])).any():
        return []
    methods = [name for name in LINE_METHODS if name in cell.predictions]
    rows = torch.nonzero(cell.pair == int(pair["pair"])).flatten()
    errors = {name: cell.predictions[name]["truth"] for name in methods}
    middle = rows[errors[methods[0]][rows].argsort()[(len(rows) - 1) // 2]]
    wide = float((pair["size"][:, 0] / pair["size"][:, 1]).min()) > WIDE
    figure, (first, second) = _make_figure(2, 1, 6.2) if wide else _make_figure(1, 2)
    near = example_inliers(pair)
    draw_matches(first, pair["points1"], pair["points2"], near)
    _frame(first, pair["size"][0], "view 1")
    matrices = {name: cell.predictions[name]["F_mat"][middle].numpy() for name in methods} | {TRUTH: pair["F"]}
    _draw_lines(second, pair, near, matrices, {TRUTH: INK, **colors})
    medians = ", ".join(f"{errors[name][middle].item():.2f} px under {name}" for name in methods)
    text = (
        f"{' and '.join(pair['names'])} of {cell.store}, a random pair. View 1: the {len(near)} matches that pass the "
        f"ratio test; {int(near.sum())} are inliers, with a symmetric epipolar distance to the ground truth below "
        f"{INLIER_THRESHOLD:g} px. View 2: some inliers with their epipolar lines under the ground truth and under the "
        f"matrices of one sample of eight, the sample with the pair's median error for {methods[0]}. Median distance "
        f"of the ground-truth inliers: {medians}."
    )
    return [_make_picture(figure, "figure-10", "Inliers, outliers and epipolar lines", text)]


def example_inliers(pair: Arrays) -> NDArray[np.bool_]:
    """Return a mask of the matches of the example within 1 px of the ground truth, (M,)."""
    points1, points2, F_mat = (torch.from_numpy(pair[key]) for key in ("points1", "points2", "F"))
    near: NDArray[np.bool_] = (symmetric_epipolar_distance(points1, points2, F_mat) < INLIER_THRESHOLD).numpy()
    return near


def _draw_lines(axes: Axes, pair: Arrays, near: NDArray[np.bool_], matrices: Arrays, colors: dict[str, str]) -> None:
    """Draw the epipolar lines of some inliers, and the inliers, in the second view."""
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(near))[:NUM_LINES]
    points = np.pad(pair["points1"][chosen], ((0, 0), (0, 1)), constant_values=1.0)
    for order, (name, F_mat) in enumerate(matrices.items()):
        # Ever thinner lines, so that lines that coincide remain visible.
        look = {"linestyle": "--" if name == TRUTH else "-", "color": colors[name], "linewidth": 3.2 / (1 + order)}
        for place, line in enumerate(points @ F_mat.T):
            draw_line(axes, line, label=name if place == 0 else None, **look)
    axes.plot(*pair["points2"][chosen].T, "o", color=INLIER, markersize=5, markeredgecolor=INK)
    _frame(axes, pair["size"][1], "view 2")


def _frame(axes: Axes, size: NDArray[np.int32], name: str) -> None:
    """Give axes the extent of an image, y down."""
    width, height = size.tolist()
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel=f"x in {name}, px")
    axes.set_ylabel("y, px")


def _line_style(name: str) -> str:
    """Return the line style of a method: dashed for one with weights, which often lies on a closed form."""
    return "-" if base_name(name) in CLOSED_FORMS or ":" in name else "--"


def _make_figure(rows: int, columns: int, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """Return a figure of eight inches with axes row by row."""
    figure = import_matplotlib().figure.Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False).flatten().tolist()


def _make_picture(figure: Figure, name: str, title: str, text: str, legend: bool = True) -> ReportPicture:
    """Return a figure as SVG, with one legend of all axes above it."""
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

"""Tables and plots of the numbers in docs/results, for the directive ``results`` of the pages (results_directive.py).

A page shows the file ``results/NAME.csv`` by ``table("NAME")``. ``results/commands.toml`` has the command that printed
each file. sizes.json is what benchmarks/sizes.py writes with --json. The README's table and picture are made by

    python docs/results_tables.py docs/images/sizes.svg
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
import sys
from collections.abc import Sequence
from io import StringIO
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from IPython.display import HTML, Markdown
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from kornia_learnnorm.evaluation.tables import format_table

RESULTS = Path(__file__).parent / "results"
RATE = re.compile(r"(\S+) \[(\S+), (\S+)\]")  # a rate and its interval, as reports print them
STORES = {"kitti_06": "KITTI 06", "tum_fr3_office": "TUM"}
NOT_DRAWN = ("none", "Hartley")  # their rates are so low that those of the other rows would not be told apart

INK = "#010203"  # text and axes; the page's own text colour takes its place, light or dark
BLUE, ORANGE, GREEN, PURPLE, GREY = "#2f7fd6", "#d9622b", "#2a9d62", "#9a63d6", "#7b858f"  # readable on both
DRAWN_IN_INK = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color")
PLAIN = {**dict.fromkeys(DRAWN_IN_INK, INK), "figure.facecolor": "none", "axes.facecolor": "none"}
GREY_INK = "#747b84"  # of pictures in files, which is readable on light and dark pages
FIT_WIDTH = 6  # inches; a wider plot scrolls within its box on narrow pages, others shrink
REM = 6  # of the page for an inch of a plot

SIZES = (8, 16, 32, 64, 128, 512)
# As benchmarks/sizes.py names estimators: colour, mark over the time, and line over the sizes of those drawn there.
TIMED = {
    "Hartley": (GREY, "o", "-"),
    "whitening": (GREY, "^", ""),
    "reweighted": (GREY, "v", ""),
    "Hartley+optimal": (GREY, "s", "--"),
    "Hartley+LM": (GREY, "P", ":"),
    "paper": (GREY, "X", ""),
    "opencv-usac-magsac": (PURPLE, "o", "-"),
    "poselib": (GREEN, "o", "-"),
    "kornia": (GREEN, "^", "--"),
    "RANSAC": (ORANGE, "o", "-"),
    "learned:robust": (BLUE, "o", "-"),
    "learned:robust+bfloat16": (BLUE, "^", ""),
    "learned:robust-synthetic": (BLUE, "s", "--"),
    "learned:robust-tiny": (BLUE, "D", ":"),
    "learned:robust-tiny+bfloat16": (BLUE, "v", ""),
}
MARKS = "osv^<>PXD"  # of methods that have none above, in their order
ESTIMATORS = {name: (colour, line) for name, (colour, _, line) in TIMED.items() if line}
COMPARED = {  # in the picture of the landing page and the README, each divided by PoseLib's: name, colour and line
    "opencv-usac-magsac": ("OpenCV MAGSAC", PURPLE, "-"),
    "poselib": ("PoseLib", GREEN, "-"),
    "kornia": ("Kornia RANSAC", GREEN, "--"),
    "RANSAC": ("RANSAC", ORANGE, "-"),
    "learned:robust-synthetic": ("LearnedEightPoint", BLUE, "-"),
}
PLANES = {  # in the picture of homographies
    "kornia": ("Kornia RANSAC", GREEN, "--"),
    "opencv-usac-magsac": ("OpenCV MAGSAC", PURPLE, "-"),
    "poselib": ("PoseLib", GREEN, "-"),
    "pysuperansac": ("SupeRANSAC", GREY, "-"),
    "RANSAC": ("RANSAC", ORANGE, "-"),
    "learned:robust-homography": ("LearnedHomography", BLUE, "-"),
}
VIEWS = {"kitti_06": "Street from a car (KITTI 06)", "tum_fr3_office": "Office, camera in hand (TUM)"}
POSE_STORES = {"photographs": "photos", **STORES}
DETECTORS = {"xfeat": "XFeat", "aliked": "ALIKED"}
POSE_ROWS = {  # of poses.csv, and how the landing page and the README call them
    "opencv-usac-magsac": "OpenCV MAGSAC",
    "poselib": "PoseLib",
    "RANSAC": "`RANSAC`",
    "learned:robust-synthetic+scores": "`LearnedEightPoint`",
    "poselib-calibrated": "PoseLib with cameras",
    "learned:robust-pose-synthetic+scores": "`LearnedRelativePose`",
}
EIGHTS, SOLVERS, ROBUST = "sets of eight", "larger sets: solvers", "larger sets: robust estimators"
LAYERS = {  # as benchmarks/speed.py names them, and the parts in which they take turns with Kornia's solver
    "Kornia": ("kornia", (EIGHTS, SOLVERS)),
    "Hartley": ("Hartley", (EIGHTS, SOLVERS)),
    "`EightPoint`": ("EightPoint", (EIGHTS, SOLVERS)),
    '`rank2="optimal"`': ("optimal", (EIGHTS, SOLVERS)),
    "Kornia, in turn with the rows below": ("kornia", (EIGHTS, ROBUST)),
    "`crossview`": ("crossview", (EIGHTS, ROBUST)),
    "`LearnedEightPoint`": ("learned", (EIGHTS, ROBUST)),
}
NORMALIZERS = ("Hartley", "whitening", "reweighted", "paper", "crossview", "crossview-synthetic", "crossview-sets")
NORMALIZERS += ("Hartley+optimal", "RANSAC")  # beside them
LOSSES = {  # of the rows that train the network of Fan et al. with each of them
    "paper-base": "symmetric epipolar",
    "paper-loss-sampson": "Sampson",
    "paper-loss-algebraic": "algebraic",
    "paper-reduction-log": "symmetric epipolar, mean logarithm",
}
CASES = ("1 x 8", "64 x 8", "1 x 128", "32 x 128", "1 x 512", "32 x 512")  # batch x correspondences
GPU_CASES = ("1 x 8", "2048 x 8", "65536 x 8", "32 x 128", "32 x 512")


def read_rows(name: str) -> list[list[str]]:
    """Return the rows of a file of results, the header first."""
    with (RESULTS / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def read_json(name: str) -> Any:
    """Return the content of a file of results; ``sizes`` has errors (px) and times by title, method and size."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def cross_table(corner: str, cells: dict[tuple[str, str], str]) -> Markdown:
    """Return a table of cells by the names of their row and column; those that were not measured have a dash."""
    names, columns = (dict.fromkeys(key[k] for key in cells) for k in (0, 1))
    rows = [[name, *(cells.get((name, column), "-") for column in columns)] for name in names]
    return Markdown(format_table([corner, *columns], rows))


def table(name: str) -> Markdown:
    """Return a file of results as a table."""
    header, *rows = read_rows(name)
    return Markdown(format_table(header, rows))


def _on(machine: dict[str, object]) -> str:
    """Return the machine of a measurement as a line below its table."""
    words = "; ".join(f"{name}: {machine[name]}" for name in ("processor", "device", "threads", "load", "torch"))
    return f"\n\nMeasured with {words}."


def layer_times(name: str = "speed") -> Markdown:
    """Return the milliseconds of one forward and backward pass of the layers, and their ratios to Kornia's solver."""
    found, rows = read_json(name), []
    columns = CASES if name == "speed" else GPU_CASES
    for layer, (method, parts) in LAYERS.items():
        both = [found[f"{part}, forward and backward"] for part in parts]
        times = {case: row for part in both for case, row in part.items() if method in row}
        cells = {case: f"{row[method]:.3g} ({row[method] / row['kornia']:.1f})" for case, row in times.items()}
        rows.append([layer, *(cells.get(case, "-") for case in columns)])
    return Markdown(format_table(["ms (ratio to Kornia's)", *columns], rows) + _on(found["machine"]))


def compile_times() -> Markdown:
    """Return what compiling a layer takes and gains: seconds of the first call, milliseconds of later ones."""
    found = read_json("compile")
    columns = ("first call, processor s", "later calls, ms", "not compiled, ms")
    rows = [[name, *(f"{times[key]:.3g}" for key in columns)] for name, times in found.items() if name != "machine"]
    return Markdown(format_table(["layer, batch x correspondences", *columns], rows) + _on(found["machine"]))


def speed_tables(memory: bool = False) -> Markdown:
    """Return the times of all parts of a measurement and their ratios to Kornia's, or the memory."""
    found = read_json("speed")
    machine, texts = found.pop("machine"), []
    for title, cases in found.items():
        if title.endswith(", memory") == memory:
            methods = dict.fromkeys(name for case in cases.values() for name in case)
            rows = [[name, *(_beside_kornia(case, name) for case in cases.values())] for name in methods]
            texts += [f"**{title}**", format_table(["method", *cases], rows)]
    return Markdown("\n\n".join(texts) + _on(machine))


def _beside_kornia(case: dict[str, float], name: str) -> str:
    return f"{case[name]:.3g} ({case[name] / case['kornia']:.2f})" if name in case else "-"


def losses_table() -> Markdown:
    """Return the better rates on KITTI of the network of Fan et al. after training with different losses."""
    files = "ablations-hartley", "ablations-whitening"
    rates = [{row[0]: row[1] for row in read_rows(name)} for name in files]
    rows = [[words, *(by_row[row] for by_row in rates)] for row, words in LOSSES.items()]
    return Markdown(format_table(["loss", "better than Hartley %", "better than whitening %"], rows))


def _words(title: str) -> str:
    store, _, protocol = title.partition(", ")
    return f"{STORES.get(store, store)}, {protocol} matches"


def sizes_rows(title: str, methods: Sequence[str], sizes: Sequence[int] = SIZES) -> list[list[str]]:
    """Return a row of median errors for each method, from the measurements of one store and protocol."""
    found = read_json("sizes")[title]
    if missing := [name for name in methods if name not in found]:
        raise ValueError(f"sizes.json has no {', '.join(missing)} for {title}: run benchmarks/sizes.py with --methods")
    errors = {name: {int(size): f"{values[0]:.3f}" for size, values in found[name].items()} for name in methods}
    return [[name, *(by_size.get(size, "-") for size in sizes)] for name, by_size in errors.items()]


def sizes_table(
    title: str,
    methods: Sequence[str] = tuple(ESTIMATORS),
    sizes: Sequence[int] = SIZES,
    corner: str = "median error, px",
) -> Markdown:
    """Return the median errors of one store and protocol as a table."""
    return Markdown(format_table([corner, *(f"N = {size}" for size in sizes)], sizes_rows(title, methods, sizes)))


def poses_summary() -> Markdown:
    """Return the pose errors of the landing page and the README: rows of poses.csv, in words."""
    found = {(row[0], row[1]): row[2] for row in read_rows("poses")[1:]}
    stores = [f"{store}_{detector}_lightglue" for store in ("photographs", "tum_fr3_office") for detector in DETECTORS]
    rows = POSE_ROWS.items()
    return cross_table("", {(words, _store_words(s)): found[s, name] for name, words in rows for s in stores})


def _store_words(store: str) -> str:
    name, detector, _ = store.rsplit("_", 2)
    return f"{POSE_STORES[name]}, {DETECTORS[detector]}"


def poses_table(column: str, matcher: str, name: str = "poses") -> Markdown:
    """Return a column of poses.csv or refined.csv by row and store, of the stores that a matcher's name ends."""
    header, *rows = read_rows(name)
    place = header.index(column)
    return cross_table(column, {(r[1], _store_words(r[0])): r[place] for r in rows if r[0].endswith(matcher)})


def planes_plot() -> HTML:
    """Draw the median corner errors of planes.csv against the number of matches, a panel for each share of outliers."""
    header, *rows = read_rows("planes")
    names, size, error = header.index("estimator"), header.index("N"), header.index("median")
    with plt.rc_context(PLAIN):
        shares = list(dict.fromkeys(row[0] for row in rows))
        figure, axes = plt.subplots(1, len(shares), figsize=(6, 3.4), layout="constrained", sharex=True, sharey=True)
        for share, ax in zip(shares, axes, strict=True):
            for name, (label, colour, line) in PLANES.items():
                drawn = [(int(row[size]), float(row[error])) for row in rows if (row[0], row[names]) == (share, name)]
                width = 2.2 if name.startswith("learned") else 1.2
                ax.plot(*zip(*drawn, strict=True), line, marker=".", color=colour, label=label, linewidth=width)
            ax.set(title=f"{share} outliers", xlabel="matches", xscale="log", yscale="log", ylim=(0.3, 20))
            ax.set_xticks(*zip(*((n, str(n)) for n in dict(drawn)), strict=True))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.minorticks_off()
            ax.grid(visible=True)
        axes[0].set_ylabel("median corner error, px", fontsize=9)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        return show(figure, "Median corner error of homographies against the number of matches")


def scores_table(title: str) -> Markdown:
    """Return the median errors of one store and protocol where the estimators get Lowe's ratio as scores."""
    names = ["RANSAC", *(name for name in ESTIMATORS if name.startswith("learned"))]
    corner = f"{_words(title)}: median error, px"
    return sizes_table(title, [f"{name}+scores" for name in names], SIZES[1:], corner)


def sizes_ratios(method: str, reference: str) -> Markdown:
    """Return by how much the errors of a method are above those of a reference, percent, for every size of both."""
    rows, sizes = [], SIZES[1:]
    for title in read_json("sizes"):
        pair = zip(*sizes_rows(title, [method, reference], sizes), strict=True)
        next(pair)  # the names
        rows.append([_words(title), *(f"{100 * (float(error) / float(other) - 1):+.0f} %" for error, other in pair)])
    return Markdown(format_table([f"{method} against {reference}", *(f"N = {size}" for size in sizes)], rows))


def show(figure: Figure, alt: str) -> HTML:
    """Return a figure as SVG in the text colour of the page; on narrow pages it shrinks, or scrolls if it is wide."""
    width, text = figure.get_figwidth(), StringIO()
    with plt.rc_context({"svg.hashsalt": alt}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    plt.close(figure)
    svg = text.getvalue().replace(INK, "currentColor")
    least = f"min-width: {REM * width * 0.75:.0f}rem; " if width > FIT_WIDTH else ""
    style = f'style="width: 100%; {least}max-width: {REM * width:.0f}rem; height: auto"'
    svg = svg[svg.index("<svg") :].replace("<svg", f"<svg {style}", 1)
    return HTML(f'<div role="img" aria-label="{alt}" style="overflow-x: auto">{svg}</div>')


def draw_relative(ink: str) -> Figure:
    """Draw the median errors on unfiltered matches divided by PoseLib's, a panel for each store."""
    with plt.rc_context({**PLAIN, **dict.fromkeys(DRAWN_IN_INK, ink)}):
        figure, axes = plt.subplots(2, 1, figsize=(4.4, 5.4), layout="constrained", sharex=True)
        sizes = SIZES[1:]
        for ax, (store, words) in zip(axes, VIEWS.items(), strict=True):
            found = read_json("sizes")[f"{store}, unfiltered"]
            for name, (label, colour, line) in COMPARED.items():
                ratios = [found[name][str(size)][0] / found["poselib"][str(size)][0] for size in sizes]
                width = 2.8 if name.startswith("learned") else 1.6
                ax.plot(sizes, ratios, line, marker="o", markersize=4, color=colour, label=label, linewidth=width)
            ax.set(xscale="log", ylim=(0, 2))
            ax.set_title(words, fontsize=11)
            ax.set_xticks(sizes, map(str, sizes))
            ax.tick_params(labelsize=10)
            ax.minorticks_off()
            ax.grid(visible=True)
        axes[-1].set_xlabel("matches, with outliers", fontsize=10)
        figure.supylabel("median error, divided by PoseLib's", fontsize=10)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=10)
        return figure


def relative_plot() -> HTML:
    """Return the picture of the landing page."""
    return show(draw_relative(INK), "Median error divided by PoseLib's, by the number of matches, on KITTI and TUM")


def sizes_plot(protocols: Sequence[str] = ("unfiltered", "filtered")) -> HTML:
    """Draw the median error against the number of matches, a row for each protocol and a panel for each store."""
    with plt.rc_context(PLAIN):
        options = {"figsize": (6, 1.4 + 2.2 * len(protocols)), "layout": "constrained", "squeeze": False}
        figure, axes = plt.subplots(len(protocols), len(STORES), sharex=True, sharey="row", **options)
        titles = [f"{store}, {protocol}" for protocol in protocols for store in STORES]
        for title, ax in zip(titles, axes.flat, strict=True):
            found = read_json("sizes")[title]
            for name, (colour, style) in ESTIMATORS.items():
                errors = {int(size): values[0] for size, values in found[name].items()}
                width = 2.2 if name.startswith("learned") else 1.2
                ax.plot(errors.keys(), errors.values(), style, marker=".", color=colour, label=name, linewidth=width)
            ax.set(title=_words(title), xscale="log", yscale="log")
            ax.yaxis.set_major_formatter("{x:g}")
            ax.set_xticks(SIZES, map(str, SIZES))
            ax.minorticks_off()
            ax.grid(visible=True)
        _label_errors(figure, axes, "matches in the set")
        return show(figure, f"Median error against the number of matches, on KITTI and TUM, {' and '.join(protocols)}")


def _label_errors(figure: Figure, axes: Any, xlabel: str) -> None:
    """Label the axes of panels of errors, and add their legend."""
    for ax in axes[-1]:
        ax.set_xlabel(xlabel)
    figure.supylabel("median error of true inliers, px", fontsize=9)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


def time_plot(name: str) -> HTML:
    """Draw the median error against the time of a set of unfiltered matches, a row for each of two sizes of sets."""
    with plt.rc_context(PLAIN):
        found = read_json(name)
        methods = found[f"{next(iter(STORES))}, unfiltered"]
        styles = {method: TIMED.get(method, (BLUE, mark, "")) for method, mark in zip(methods, cycle(MARKS))}
        sizes = [*next(iter(methods.values()))]
        figure, axes = plt.subplots(len(sizes), 2, figsize=(6, 6.4), layout="constrained", sharex=True)
        cells = [(size, store) for size in sizes for store in STORES]
        for (size, store), ax in zip(cells, axes.flat, strict=True):
            for method, (colour, mark, _) in styles.items():
                error, milliseconds = found[f"{store}, unfiltered"][method][size]
                ax.plot(milliseconds, error, mark, color=colour, label=method, markersize=6)
            ax.set(title=f"{_words(f'{store}, unfiltered')}, N = {size}", xscale="log", yscale="log")
            ax.xaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_major_formatter("{x:g}")
            ax.grid(visible=True)
        _label_errors(figure, axes, "ms per set")
        of = " and of ".join(sizes)
        return show(figure, f"Median error against time, on KITTI and TUM, unfiltered, sets of {of} matches")


def _draw_dots(ax: Axes, rows: Sequence[Sequence[str]], column: int, offset: float, **style: str) -> None:
    """Draw the numbers of one column as dots, with their intervals where they have any."""
    for y, row in enumerate(rows):
        if row[column] == "-":
            continue
        rate = RATE.fullmatch(row[column])
        value, *interval = map(float, rate.groups() if rate else [row[column]])
        ax.plot(value, y + offset, "o", markersize=3.5, **style)
        if interval:
            ax.plot(interval, [y + offset] * 2, "-", linewidth=1.2, **style)


def dot_plot(panels: dict[str, tuple[str, dict[str, int]]], alt: str, log: bool = False) -> HTML:
    """Draw columns of tables as dots with their intervals, a line for each row of the tables.

    Args:
        panels: by title, the name of a file of results, and its columns by the name in the legend.
        alt: description for readers who do not see the figure.
        log: whether the horizontal axis is logarithmic.

    """
    tables = {
        title: ([row for row in read_rows(name)[1:] if row[0] not in NOT_DRAWN], columns)
        for title, (name, columns) in panels.items()
    }
    first = next(iter(tables.values()))[0]
    with plt.rc_context(PLAIN):
        size = (2 + 2 * len(tables), 1.1 + 0.21 * len(first))
        figure, axes = plt.subplots(1, len(tables), figsize=size, layout="constrained", sharey=True, squeeze=False)
        for ax, (title, (rows, columns)) in zip(axes[0], tables.items(), strict=True):
            for index, (label, column) in enumerate(columns.items()):
                colour, offset = (BLUE, ORANGE, GREEN, PURPLE)[index], 0.18 * (index - (len(columns) - 1) / 2)
                _draw_dots(ax, rows, column, offset, color=colour)
                ax.plot([], [], "o", markersize=3.5, color=colour, label=label)
            ax.set_xlabel(title)
            ax.grid(visible=True)
            if log:
                ax.set_xscale("log", subs=[])
                ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
                ax.xaxis.set_major_formatter("{x:g}")
        axes[0, 0].set_yticks(range(len(first)), [row[0].replace("`", "") for row in first])
        axes[0, 0].set_ylim(len(first) - 0.4, -0.6)
        if len(axes[0, 0].get_legend_handles_labels()[1]) > 1:
            figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
        return show(figure, alt)


def rates_plot(name: str, stores: dict[str, int]) -> HTML:
    """Draw the better rates of three files of results, ``NAME-hartley.csv`` and so on, by the columns of stores."""
    files = {"better than Hartley %": "hartley", "better than whitening %": "whitening"}
    files["truth: better than Hartley %"] = "truth"
    alt = "Better rates of all rows with 95 % intervals, but for none and Hartley; the tables below have the numbers"
    return dot_plot({title: (f"{name}-{file}", stores) for title, file in files.items()}, alt)


if __name__ == "__main__":
    plt.style.use(Path(__file__).parent / "matplotlibrc")
    with plt.rc_context({"svg.hashsalt": "sizes"}):
        source = hashlib.sha256((RESULTS / "sizes.json").read_bytes()).hexdigest()  # tests ask whether it is current
        draw_relative(GREY_INK).savefig(sys.argv[1], metadata={"Date": None, "Source": source}, transparent=True)
    print(poses_summary().data)

"""ReportPicture of an image pair: its inliers and outliers, and the epipolar lines of one of its samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.evaluation.report.style import INK, ReportPicture, make_figure, make_picture
from kornia_learnnorm.evaluation.runs.prediction_run import Run
from kornia_learnnorm.evaluation.runs.results_store import Arrays
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.protocol import INLIER_THRESHOLD
from kornia_learnnorm.two_view.drawing import INLIER, WIDE, draw_line, draw_matches

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NUM_LINES = 5  # epipolar lines of each matrix
METHODS = ("Hartley", "crossview")
TRUTH = "ground truth"


def draw_example(run: Run, colors: dict[str, str]) -> list[ReportPicture]:
    """Draw the example image pair of a run, without the images; nothing where the run has no sample of it."""
    pair = run.example
    place = (str(pair["store"]), "filtered") if pair else ("", "")
    cell = next((cell for cell in run.cells if (cell.store, cell.protocol) == place), None)
    if cell is None or not (cell.pair == int(pair["pair"])).any():
        return []
    methods = [name for name in METHODS if name in cell.predictions]
    rows = torch.nonzero(cell.pair == int(pair["pair"])).flatten()
    errors = {name: cell.predictions[name]["truth"] for name in methods}
    middle = rows[errors[methods[0]][rows].argsort()[(len(rows) - 1) // 2]]
    wide = float((pair["size"][:, 0] / pair["size"][:, 1]).min()) > WIDE
    figure, (first, second) = make_figure(2, 1, 6.2) if wide else make_figure(1, 2)
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
    return [make_picture(figure, "figure-10", "Inliers, outliers and epipolar lines", text)]


def example_inliers(pair: Arrays) -> NDArray[np.bool_]:
    """Return a mask of the matches of the example image pair within 1 px of the ground truth, boolean (M,)."""
    points1, points2, F_mat = (torch.from_numpy(pair[key]) for key in ("points1", "points2", "F"))
    near: NDArray[np.bool_] = (symmetric_epipolar_distance(points1, points2, F_mat) < INLIER_THRESHOLD).numpy()
    return near


def _draw_lines(axes: Axes, pair: Arrays, near: NDArray[np.bool_], matrices: Arrays, colors: dict[str, str]) -> None:
    """Draw the epipolar lines of some inliers, and the inliers, in the second view."""
    chosen = np.flatnonzero(near)[_far_apart(pair["points2"][near])]
    points = np.pad(pair["points1"][chosen], ((0, 0), (0, 1)), constant_values=1.0)
    for order, (name, F_mat) in enumerate(matrices.items()):
        # Ever thinner lines, so that lines that coincide remain visible.
        style = {"linestyle": "--" if name == TRUTH else "-", "color": colors[name], "linewidth": 3.2 / (1 + order)}
        for place, line in enumerate(points @ F_mat.T):
            draw_line(axes, line, label=name if place == 0 else None, **style)
    axes.plot(*pair["points2"][chosen].T, "o", color=INLIER, markersize=5, markeredgecolor=INK)
    _frame(axes, pair["size"][1], "view 2")


def _far_apart(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices of points far from each other: the first one, then always the farthest from all chosen."""
    chosen = [0]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(NUM_LINES, len(points)):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)


def _frame(axes: Axes, size: NDArray[np.int32], name: str) -> None:
    """Give axes the extent of an image, y down."""
    width, height = size.tolist()
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel=f"x in {name}, px")
    axes.set_ylabel("y, px")

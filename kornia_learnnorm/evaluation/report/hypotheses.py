"""The hypotheses of minimal solvers in a report: tables and a figure."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.report.rates import BASELINE, Table
from kornia_learnnorm.evaluation.report.style import COLORS, Picture, make_figure, make_picture
from kornia_learnnorm.evaluation.robust.hypotheses import MOST_ERROR, NUMBERS, expected_best, picked
from kornia_learnnorm.evaluation.robust.run import RobustCell, RobustRun
from kornia_learnnorm.metrics.bootstrap import paired_bootstrap

__all__ = ["hypothesis_figures", "hypothesis_tables"]

TESTED = (1, 3, 10, 30, 100, 1000)
TITLES = {"best": "Best of k hypotheses", "picked": "Hypothesis that MSAC picks among k"}
TEXTS = {
    "best": "Expected smallest error of k minimal samples, exact for those drawn. ",
    "picked": "Error of the hypothesis of highest MSAC score (1 px, all matches), mean over disjoint groups of k. ",
}


def _at(figure: str, hypotheses: dict[str, Tensor], number: int, most: int | None = None) -> Tensor:
    """Return a figure of each pair at k, (P,), from the first ``most`` samples."""
    known = ~hypotheses["error"].isnan().any(-1)
    error, score = (hypotheses[key][known, :most] for key in ("error", "score"))
    return expected_best(error, number) if figure == "best" else picked(error, score, number)


def hypothesis_tables(run: RobustRun) -> list[Table]:
    """Make the tables of hypotheses of a run.

    Args:
        run: its figures.

    """
    cells = [cell for cell in run.cells if cell.hypotheses]
    return [table for cell in cells for table in (_values(cell, "best"), _values(cell, "picked"), *_tests(cell))]


def _curve(figure: str, hypotheses: dict[str, Tensor]) -> Iterator[tuple[int, float]]:
    for number in NUMBERS:
        if number <= hypotheses["error"].shape[1]:
            yield number, _at(figure, hypotheses, number).mean().item()


def _values(cell: RobustCell, figure: str) -> Table:
    rows = []
    for name, hypotheses in cell.hypotheses.items():
        found = dict(_curve(figure, hypotheses))
        rows.append([name, *(f"{found[number]:.3f}" if number in found else "" for number in NUMBERS)])
    error = next(iter(cell.hypotheses.values()))["error"]
    left_out = int(error.isnan().any(-1).sum())
    text = (
        f"{TEXTS[figure]}A hypothesis' error is the mean symmetric epipolar distance of the pair's ground-truth "
        f"inliers (1 px) under it, at most {MOST_ERROR:g} px; mean over {len(error) - left_out} image pairs, px. All "
        "solvers get the same samples, the slow ones the first of them; the seven-point solver the first seven points "
        "of each, and the one of its candidates with the highest score counts."
    )
    text += f" Pairs with too few ground-truth inliers are left out: {left_out}." if left_out else ""
    return Table(f"{TITLES[figure]}: {cell.title}", text, ["solver", *(f"k = {k}" for k in NUMBERS)], rows)


def _tests(cell: RobustCell) -> list[Table]:
    if BASELINE not in cell.hypotheses:
        return []
    rows = [
        [name, TITLES[figure], *(_test(cell, name, figure, number) for number in TESTED)]
        for name in cell.hypotheses
        if name != BASELINE
        for figure in TITLES
    ]
    text = (
        f"Difference of the two errors from those of {BASELINE}'s normalisation, on the samples that both solved, px, "
        "with the 95 % interval of a paired bootstrap over image pairs. Negative is better."
    )
    header = ["solver", "figure", *(f"k = {number}" for number in TESTED)]
    return [Table(f"Hypotheses against {BASELINE}'s: {cell.title}", text, header, rows)]


def _test(cell: RobustCell, name: str, figure: str, number: int) -> str:
    both = cell.hypotheses[name], cell.hypotheses[BASELINE]
    most = min(hypotheses["error"].shape[1] for hypotheses in both)
    if number > most:
        return ""
    values, baseline = (_at(figure, hypotheses, number, most) for hypotheses in both)
    if len(values) < 2:
        return ""
    found = paired_bootstrap(values, baseline, torch.arange(len(values)))
    return f"{found.mean:+.3f} [{found.low:+.3f}, {found.high:+.3f}]"


def hypothesis_figures(run: RobustRun) -> list[Picture]:
    """Draw the errors of each store's hypotheses by their number.

    Args:
        run: its figures.

    Raises:
        ImportError: if Matplotlib is not installed.

    """
    colors = dict(zip(run.about["solvers"], COLORS * 10, strict=False))
    pictures = []
    for place, store in enumerate(run.about["stores"], 1):
        cells = [cell for cell in run.cells if cell.store == store and cell.hypotheses]
        based = [cell for cell in cells if BASELINE in cell.hypotheses]
        if cells:
            pictures.append(_draw(cells, f"hypotheses-{place}", colors, relative=False))
        if based:
            pictures.append(_draw(based, f"hypotheses-{place}-relative", colors, relative=True))
    return pictures


def _draw(cells: list[RobustCell], name: str, colors: dict[str, str], relative: bool) -> Picture:
    figure, panels = make_figure(len(cells), len(TITLES), 6.5)
    unit = f" over {BASELINE}'s" if relative else ", px"
    for axes, (cell, kind) in zip(panels, product(cells, TITLES), strict=True):
        for solver, hypotheses in cell.hypotheses.items():
            x, y = _relative(kind, cell, solver) if relative else zip(*_curve(kind, hypotheses), strict=True)
            axes.plot(x, y, "--" if solver in ("paper", "crossview") else "-", color=colors[solver], label=solver)
        axes.set(xscale="log", xlabel="k, minimal samples", yscale="linear" if relative else "log")
        axes.set_ylabel(f"{cell.protocol}, {kind}: error{unit}")
    text = (
        f"{cells[0].store}: expected smallest error of k minimal samples (left) and error of the one that MSAC picks "
        "(right), mean over image pairs"
    )
    text += f", over that of {BASELINE}'s normalisation on the same samples." if relative else "."
    title = f"Hypotheses{f' against {BASELINE}' if relative else ''}: {cells[0].store}"
    return make_picture(figure, name, title, text)


def _relative(figure: str, cell: RobustCell, solver: str) -> tuple[list[int], list[float]]:
    """Return k, and the mean error over that of the baseline on the samples that both solved."""
    both = cell.hypotheses[solver], cell.hypotheses[BASELINE]
    most = min(hypotheses["error"].shape[1] for hypotheses in both)
    numbers = [number for number in NUMBERS if number <= most]
    means = ([_at(figure, hypotheses, k, most).mean().item() for k in numbers] for hypotheses in both)
    return numbers, [value / other for value, other in zip(*means, strict=True)]

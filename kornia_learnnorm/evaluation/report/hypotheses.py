"""Tables and pictures of the hypotheses of minimal solvers."""

from __future__ import annotations

from itertools import product
from math import nan

from torch import Tensor

from kornia_learnnorm.evaluation.report.formatting import BASELINE, MIN_BOOTSTRAP_PAIRS, number_text, paired_text
from kornia_learnnorm.evaluation.report.style import (
    Picture,
    line_style,
    make_figure,
    make_picture,
    method_colors,
    report_style,
)
from kornia_learnnorm.evaluation.robust.hypotheses import MAX_ERROR, NUMBERS, expected_best, picked
from kornia_learnnorm.evaluation.robust.run import RobustCell, RobustRun
from kornia_learnnorm.evaluation.tables import Table

__all__ = ["hypothesis_figures", "hypothesis_tables"]

TESTED = (1, 3, 10, 30, 100, 1000)  # numbers of samples in the table of paired tests
TITLES = {"best": "Best of k hypotheses", "picked": "Hypothesis that MSAC picks among k"}
TEXTS = {
    "best": "Expected smallest error of k minimal samples, computed exactly from the samples drawn. ",
    "picked": "Error of the hypothesis of highest MSAC score (1 px, all matches), mean over disjoint groups of k. ",
}


def hypothesis_tables(run: RobustRun) -> list[Table]:
    """Return all tables of the hypotheses of minimal solvers, of the stores with ground truth."""
    cells = [cell for cell in run.cells if cell.hypotheses and _has_truth(cell)]
    return [table for cell in cells for table in (_values(cell, "best"), _values(cell, "picked"), *_tests(cell))]


def _has_truth(cell: RobustCell) -> bool:
    """Return whether there is an error to show: the ground truth of a pair is known."""
    return any(not found["error"].isnan().all() for found in cell.hypotheses.values())


def _errors(kind: str, hypotheses: dict[str, Tensor], number: int, num_samples: int | None = None) -> Tensor:
    """Return the error of each pair with ground truth at k = ``number``, (P,), from the first ``num_samples``."""
    known = ~hypotheses["error"].isnan().any(-1)
    error, score = (hypotheses[key][known, :num_samples] for key in ("error", "score"))
    return expected_best(error, number) if kind == "best" else picked(error, score, number)


def _curve(kind: str, hypotheses: dict[str, Tensor], num_samples: int | None = None) -> dict[int, float]:
    """Return the mean error by k, for each k that the samples allow; NaN if no pair has ground truth."""
    available = num_samples or hypotheses["error"].shape[1]
    numbers = [number for number in NUMBERS if number <= available]
    return {number: _errors(kind, hypotheses, number, num_samples).mean().item() for number in numbers}


def _shared(cell: RobustCell, solver: str) -> int:
    """Return the number of samples that a solver and the baseline have both solved."""
    return min(cell.hypotheses[name]["error"].shape[1] for name in (solver, BASELINE))


def _values(cell: RobustCell, kind: str) -> Table:
    """Return the table of mean errors by solver and k."""
    rows = []
    for name, hypotheses in cell.hypotheses.items():
        found = _curve(kind, hypotheses)
        rows.append([name, *(number_text(found.get(number, nan)) for number in NUMBERS)])
    error = next(iter(cell.hypotheses.values()))["error"]
    left_out = int(error.isnan().any(-1).sum())
    text = (
        f"{TEXTS[kind]}The error of a hypothesis is the mean symmetric epipolar distance of the pair's ground-truth "
        f"inliers (1 px), at most {MAX_ERROR:g} px. Mean over {len(error) - left_out} image pairs, px. All solvers get "
        "the same samples, the slow solvers only the first ones. The seven-point solver gets the first seven points of "
        "each sample; of its candidates the one with the highest score counts."
    )
    text += f" Pairs with too few ground-truth inliers are left out: {left_out}." if left_out else ""
    return Table(f"{TITLES[kind]}: {cell.title}", text, ["solver", *(f"k = {k}" for k in NUMBERS)], rows)


def _tests(cell: RobustCell) -> list[Table]:
    """Return the table of paired tests against the baseline, if the run has it."""
    if BASELINE not in cell.hypotheses:
        return []
    solvers = [name for name in cell.hypotheses if name != BASELINE]
    rows = [
        [name, TITLES[kind], *(_test(cell, name, kind, number) for number in TESTED)]
        for name, kind in product(solvers, TITLES)
    ]
    text = (
        f"Difference of both errors from those of {BASELINE}'s normalisation, on the samples that both have solved, "
        "px, with the 95 % interval of a paired bootstrap over image pairs; fewer than "
        f"{MIN_BOOTSTRAP_PAIRS} pairs have none. Negative is better."
    )
    header = ["solver", "error", *(f"k = {number}" for number in TESTED)]
    return [Table(f"Hypotheses against {BASELINE}'s: {cell.title}", text, header, rows)]


def _test(cell: RobustCell, name: str, kind: str, number: int) -> str:
    shared = _shared(cell, name)
    if number > shared:
        return ""
    errors = (_errors(kind, cell.hypotheses[solver], number, shared) for solver in (name, BASELINE))
    return paired_text(*errors, with_p_value=False)


@report_style()
def hypothesis_figures(run: RobustRun) -> list[Picture]:
    """Draw the errors of each store's hypotheses against their number, where it has ground truth."""
    colors = method_colors(run.about["solvers"])
    pictures = []
    for (place, store), relative in product(enumerate(run.about["stores"], 1), (False, True)):
        found = [cell for cell in run.cells if cell.store == store and _has_truth(cell)]
        cells = [cell for cell in found if BASELINE in cell.hypotheses] if relative else found
        if cells:
            pictures.append(_draw(cells, f"hypotheses-{place}{'-relative' * relative}", colors, relative))
    return pictures


def _draw(cells: list[RobustCell], name: str, colors: dict[str, str], relative: bool) -> Picture:
    figure, panels = make_figure(len(cells), len(TITLES), 6.5)
    unit = f" over {BASELINE}'s" if relative else ", px"
    for axes, (cell, kind) in zip(panels, product(cells, TITLES), strict=True):
        for solver, hypotheses in cell.hypotheses.items():
            curve = _relative(kind, cell, solver) if relative else _curve(kind, hypotheses)
            axes.plot([*curve], [*curve.values()], line_style(solver), color=colors[solver], label=solver)
        axes.set(xscale="log", xlabel="k, minimal samples", yscale="linear" if relative else "log")
        axes.set_ylabel(f"{cell.protocol}, {kind}: error{unit}")
    text = (
        f"{cells[0].store}: expected smallest error of k minimal samples (left) and error of the one that MSAC picks "
        "(right), mean over image pairs"
    )
    text += f", divided by the error of {BASELINE}'s normalisation on the same samples." if relative else "."
    title = f"Hypotheses{f' against {BASELINE}' if relative else ''}: {cells[0].store}"
    return make_picture(figure, name, title, text)


def _relative(kind: str, cell: RobustCell, solver: str) -> dict[int, float]:
    """Return the mean error over the baseline's by k, on the samples that both have solved."""
    shared = _shared(cell, solver)
    values, baseline = (_curve(kind, cell.hypotheses[name], shared) for name in (solver, BASELINE))
    return {number: value / baseline[number] if baseline[number] else nan for number, value in values.items()}

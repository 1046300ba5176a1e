"""Tables of a run of predictions: better rates, accuracy, inliers and paired tests."""

import math
import re
from collections.abc import Iterable, Mapping
from itertools import product

import torch
from torch import Tensor

from kornia_learnnorm.evaluation import tables
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell
from kornia_learnnorm.evaluation.tables import Cell, Number, Table, median_number
from kornia_learnnorm.metrics.statistics import better_rate, comparable
from kornia_learnnorm.protocol import PAPERS_DATA, PROTOCOLS, TABLE1, THRESHOLDS

BASELINE = "Hartley"  # the method that all others are compared with
MIN_DISTANCE = 1e-6  # pixels; smaller distances are clamped before the logarithm
# Columns of the table that learnnorm evaluate prints.
HEADER = ["method", "better than Hartley %", "than whitening %", "mean px", "median px"]
HEADER += ["truth: median px", "truth: better than Hartley %"]


def with_baseline(run: Run) -> Run:
    """Return a run without the stores and protocols that lack Hartley's normalisation; ``missing`` names them."""
    cells = [cell for cell in run.cells if BASELINE in cell.predictions]
    if not cells:
        found = sorted({name for cell in run.cells for name in cell.predictions})
        has = f"the run has predictions of {', '.join(found) or 'no method'}: add it by learnnorm evaluate --methods"
        raise ValueError(f"a report compares with {BASELINE}, {has}")
    left_out = [f"{cell.title}, without {BASELINE}" for cell in run.cells if BASELINE not in cell.predictions]
    return run._replace(cells=cells, missing=[*run.missing, *left_out])


def rate_tables(run: Run) -> list[Table]:
    """Return the tables of rates against Hartley and, where the run has it, whitening."""
    made = []
    for baseline, protocol in product((BASELINE, "whitening"), PROTOCOLS):
        if cells := [cell for cell in run.cells if cell.protocol == protocol and baseline in cell.predictions]:
            made.append(_better_rates(run, cells, baseline))
    return made


def papers_data(description: str) -> str:
    """Return the part of the paper's test data, KITTI or TUM, that a description of a store names; empty for other."""
    return next((name for name, pattern in PAPERS_DATA.items() if re.match(pattern, description)), "")


def _better_rates(run: Run, cells: list[RunCell], baseline: str) -> Table:
    trained, protocol = run.about["trained_on"], cells[0].protocol
    rows: list[list[Cell]] = [
        [name, *rates, ", ".join(trained[name]) or "-"]
        for name in run.about["methods"]
        if name != baseline and any(rates := [better_share(c, name, baseline, "own", trained[name]) for c in cells])
    ]
    found = [
        better_rate(prediction["own"], cell.predictions[baseline]["own"])
        for cell in cells
        for name, prediction in cell.predictions.items()
        if name != baseline
    ]
    ties, degenerate = sum(rate.ties for rate in found), sum(rate.degenerate for rate in found)
    text = (
        f"Share of samples of {run.about['size']} correspondences with a smaller mean symmetric epipolar distance than "
        f"under {baseline}, %; {ties} ties count as not better, {degenerate} degenerate comparisons are left out. An "
        "asterisk marks a method that was trained on pairs of the store. The header gives the number of samples used "
        "and drawn: those with a mean distance without normalisation of "
        f"{run.about['max_residual']:g} px or more are not used."
    )
    papers = [papers_data(run.about["stores"][cell.store]) for cell in cells]
    papers = papers if baseline == BASELINE and protocol == "filtered" else []
    if any(papers):
        rows += [
            ["Fan et al., as printed", *(Number(values[p], ".2f") if p in values else "" for p in papers), train]
            for train, values in TABLE1.items()
        ]
        text += " Fan et al. test on KITTI 06-10 and on TUM freiburg3_long_office at KITTI's size."
    header = ["method", *(f"{cell.store}: {len(cell.pair)} of {cell.drawn}" for cell in cells), "trained on"]
    title = f"Better than {baseline}, {protocol}{' (Table 1)' if any(papers) else ''}"
    return Table(title, text, header, rows)


def better_share(cell: RunCell, name: str, baseline: str, quantity: str, trained_on: Iterable[str] = ()) -> Cell:
    """Return a better rate with its interval, %, marked if the method was trained on the store; unknown if absent."""
    if name not in cell.predictions:
        return ""
    value, other = cell.predictions[name][quantity], cell.predictions[baseline][quantity]
    valid = comparable(value, other)
    rate = tables.mean_share((value < other)[valid].double(), cell.pair[valid])
    return rate._replace(trained_on=was_trained_on(cell.store, trained_on)) if isinstance(rate, Number) else rate


def was_trained_on(store: str, trained_on: Iterable[str]) -> bool:
    """Return whether image pairs of a store are in the training data, going by names such as ``tum@0:9``."""
    name, first, stop = _pairs_of(store)
    return any(name == other and first < end and start < stop for other, start, end in map(_pairs_of, trained_on))


def _pairs_of(store: str) -> tuple[str, float, float]:
    match = re.fullmatch(r"(.+)@(\d+):(\d+)", store)
    return (match[1], float(match[2]), float(match[3])) if match else (store, 0.0, float("inf"))


def method_rows(predictions: Mapping[str, Mapping[str, Tensor]]) -> list[list[Cell]]:
    """Return a row per method for ``HEADER``; means leave out samples with an infinite residual of any method."""

    def rate(name: str, baseline: str, quantity: str) -> Cell:
        if name == baseline or baseline not in predictions:
            return "-"
        errors, other = predictions[name][quantity], predictions[baseline][quantity]
        better = (errors < other)[comparable(errors, other)].double()
        return tables.number(100 * better.mean().item(), ".1f") or "-"

    finite = torch.stack([errors["own"] for errors in predictions.values()]).isfinite().all(0)
    return [
        [
            name,
            *(rate(name, baseline, "own") for baseline in (BASELINE, "whitening")),
            tables.number(errors["own"][finite].mean().item()) or "-",
            *(median_number(errors[key]) or "-" for key in ("own", "truth")),
            rate(name, BASELINE, "truth"),
        ]
        for name, errors in predictions.items()
    ]


def report_tables(run: Run) -> list[Table]:
    """Return all tables of a run with Hartley's normalisation; numbers without a ground truth are empty cells."""
    made = rate_tables(run)
    for cell in run.cells:
        made += [_accuracy(cell), _consensus(cell, run), _tests(cell)]
    return made


def _accuracy(cell: RunCell) -> Table:
    header = ["method", "fit px", "held out px", "truth px", f"truth: better than {BASELINE} %"]
    header += ["rotation deg", "translation deg", *tables.POSE_HEADER, "condition number", "rho"]
    header += ["distance 1", "distance 2", "error due to rank 2 %"]
    errors = torch.stack([p["translation_error"] for p in cell.predictions.values()])
    # Samples whose pair has a ground-truth pose: any method has an error on any of them.
    posed, rows = torch.isin(cell.pair, cell.pair[errors.isfinite().any(0)]), list[list[Cell]]()
    for name, p in cell.predictions.items():
        angles = [p[key] for key in ("rotation_error", "translation_error")]
        row = [name, *(median_number(p[key]) for key in ("own", "heldout", "truth"))]
        row.append("-" if name == BASELINE else better_share(cell, name, BASELINE, "truth"))
        row += [median_number(angle, ".2f") for angle in angles]
        row += tables.pose_numbers(*(angle.nan_to_num(math.inf)[posed] for angle in angles))
        row += [median_number(p[key], ".4g") for key in ("condition_number", "rho", "distance1", "distance2")]
        rows.append([*row, median_number(100 * p["rank2_share"], "z.0f")])
    truth = int((~cell.predictions[BASELINE]["truth"].isnan()).sum())
    known = f"of which {truth} have ground-truth inliers and {int(posed.sum())} a ground-truth pose"
    text = (
        f"Medians over {len(cell.pair)} samples, {known if truth else 'without truth'}, of symmetric epipolar "
        "distances: `fit` is the mean of the sample's own points, `held out` the median of 16 other matches of the "
        "pair, some of which may be wrong, `truth` that of the pair's ground-truth inliers. Angles are errors of the "
        "relative pose, summarised by AUC and mAA(10), %; a pose that cannot be found is a failure. `+LM` is refined "
        "on the sample's points: nothing fits them more closely. Condition number: largest over eighth singular value "
        "of the design matrix. `rho`: second over third singular value of the normalised matrix before the projection "
        "to rank 2, which changes the less the larger it is. Distances: mean ones of the normalised points from the "
        "origin. Error due to rank 2: share of the fit."
    )
    return Table(f"Fit and accuracy: {cell.title}", text, header, rows)


def _consensus(cell: RunCell, run: Run) -> Table:
    """Return the table of inlier shares and F1; samples without ground truth are left out, unless none has one."""
    header = ["method", *(f"{name} @{threshold:g} px" for threshold in THRESHOLDS for name in ("inliers %", "F1 %"))]
    known = next(iter(cell.predictions.values()))["f1"].isfinite()
    columns = [*product(enumerate((known | ~known.any(0)).T), ("inliers", "f1"))]
    rows: list[list[Cell]] = [
        [name, *(tables.mean_share(p[key][keep, place], cell.pair[keep]) for (place, keep), key in columns)]
        for name, p in cell.predictions.items()
    ]
    truth = bool(known.any())
    dropped = " and ".join(f"{int((~keep).sum())} at {t:g} px" for t, keep in zip(THRESHOLDS, known.T, strict=True))
    text = (
        "Each sample's matrix on all matches of its pair, by the same ratio test; no RANSAC and no refinement. "
        "`inliers` is the share of the matches with a symmetric epipolar distance below the threshold."
    )
    if truth:
        text += (
            " `F1` is the harmonic mean of the precision and recall of these inliers against those of the ground truth."
            f" Samples of pairs without ground-truth inliers are left out: {dropped}."
        )
    if papers_data(run.about["stores"][cell.store]):
        text += " Fan et al., Tables 2 and 3, measure something else."
    return Table(f"Inliers{' and F1' * truth}: {cell.title}", text, header, rows)


def _tests(cell: RunCell) -> Table:
    quantities, baseline = {"own": "fit", "heldout": "held out", "truth": "truth"}, cell.predictions[BASELINE]
    header = ["method", *(f"{name}: change %, p" for name in quantities.values())]
    rows = list[list[Cell]]()
    for name, p in cell.predictions.items():
        if name != BASELINE:
            logs = ([q[key].clamp(min=MIN_DISTANCE).log() for key in quantities] for q in (p, baseline))
            both = zip(*logs, strict=True)
            rows.append([name, *(tables.paired_change(a, b, cell.pair, logarithms=True) for a, b in both)])
    truth = cell.pair[~baseline["truth"].isnan()]
    used, known = (f"{len(pair)} samples of {len(torch.unique(pair))} pairs" for pair in (cell.pair, truth))
    text = (
        f"Change of the geometric mean of each distance against {BASELINE}, with the 95 % interval and two-sided "
        f"p-value of a paired bootstrap of {tables.RESAMPLES:,} resamples. Negative is better. `fit` and "
        f"`held out` use {used}{f', `truth` uses {known}' if len(truth) else ''}."
    )
    return Table(f"Paired tests: {cell.title}", text, header, rows)

"""Tables of a run of predictions."""

from __future__ import annotations

import math
from itertools import product

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.report import numbers
from kornia_learnnorm.evaluation.report.numbers import BASELINE, better_share, median_number
from kornia_learnnorm.evaluation.report.rates import papers_data, rate_tables
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell
from kornia_learnnorm.evaluation.tables import Cell, Table
from kornia_learnnorm.protocol import THRESHOLDS


def report_tables(run: Run) -> list[Table]:
    """Return all tables of a run with Hartley's normalisation; numbers without a ground truth are empty cells."""
    tables = rate_tables(run)
    for cell in run.cells:
        tables += [_accuracy(cell), _consensus(cell, run), _tests(cell)]
    return tables


def _accuracy(cell: RunCell) -> Table:
    header = ["method", "fit px", "held out px", "truth px", f"truth: better than {BASELINE} %"]
    header += ["rotation deg", "translation deg", *numbers.POSE_HEADER, "condition number", "rho"]
    header += ["distance 1", "distance 2", "error due to rank 2 %"]
    errors = torch.stack([p["translation_error"] for p in cell.predictions.values()])
    # Samples whose pair has a ground-truth pose: any method has an error on any of them.
    posed, rows = torch.isin(cell.pair, cell.pair[errors.isfinite().any(0)]), list[list[Cell]]()
    for name, p in cell.predictions.items():
        angles = [p[key] for key in ("rotation_error", "translation_error")]
        row = [name, *(median_number(p[key]) for key in ("own", "heldout", "truth"))]
        row.append("-" if name == BASELINE else better_share(cell, name, BASELINE, "truth"))
        row += [median_number(angle, ".2f") for angle in angles]
        row += numbers.pose_numbers(*(angle.nan_to_num(math.inf)[posed] for angle in angles))
        row += [median_number(p[key], ".4g") for key in ("condition_number", "rho", "distance1", "distance2")]
        rows.append([*row, median_number(100 * p["rank2_share"], "z.0f")])
    truth = int(_with_truth(cell).sum())
    known = "without truth"
    if truth:
        known = f"of which {truth} have ground-truth inliers and {int(posed.sum())} a ground-truth pose"
    text = (
        f"Medians over {len(cell.pair)} samples, {known}, of symmetric epipolar distances: `fit` is the mean of the "
        "sample's own points, `held out` the median of 16 other matches of the pair, some of which may be wrong, "
        "`truth` that of the pair's ground-truth inliers. Angles are errors of the relative pose, summarised by AUC "
        "and mAA(10), %; a pose that cannot be found is a failure. `+LM` is refined on the sample's points: nothing "
        "fits them more closely. Condition number: largest over eighth singular value of the design matrix. `rho`: "
        "second over third singular value of the normalised matrix before the projection to rank 2, which changes the "
        "less the larger it is. Distances: mean ones of the normalised points from the origin. Error due to rank 2: "
        "share of the fit."
    )
    return Table(f"Fit and accuracy: {cell.title}", text, header, rows)


def _consensus(cell: RunCell, run: Run) -> Table:
    """Return the table of inlier shares and F1; samples without ground truth are left out, unless none has one."""
    header = ["method", *(f"{name} @{threshold:g} px" for threshold in THRESHOLDS for name in ("inliers %", "F1 %"))]
    known = next(iter(cell.predictions.values()))["f1"].isfinite()
    kept, rows = known | ~known.any(0), list[list[Cell]]()
    for name, prediction in cell.predictions.items():
        row: list[Cell] = [name]
        for (place, keep), key in product(enumerate(kept.T), ("inliers", "f1")):
            row.append(numbers.mean_share(prediction[key][keep, place], cell.pair[keep]))
        rows.append(row)
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


def _with_truth(cell: RunCell) -> Tensor:
    """Return a mask of the samples whose pair has ground-truth inliers, (S,)."""
    return ~cell.predictions[BASELINE]["truth"].isnan()


def _tests(cell: RunCell) -> Table:
    quantities, baseline = {"own": "fit", "heldout": "held out", "truth": "truth"}, cell.predictions[BASELINE]
    header = ["method", *(f"{name}: change %, p" for name in quantities.values())]
    rows = list[list[Cell]]()
    for name, p in cell.predictions.items():
        if name != BASELINE:
            logs = ([q[key].clamp(min=numbers.MIN_DISTANCE).log() for key in quantities] for q in (p, baseline))
            both = zip(*logs, strict=True)
            rows.append([name, *(numbers.paired_change(a, b, cell.pair, logarithms=True) for a, b in both)])
    truth = cell.pair[_with_truth(cell)]
    used, known = (f"{len(pair)} samples of {len(torch.unique(pair))} pairs" for pair in (cell.pair, truth))
    text = (
        f"Change of the geometric mean of each distance against {BASELINE}, with the 95 % interval and two-sided "
        f"p-value of a paired bootstrap of {numbers.RESAMPLES:,} resamples. Negative is better. `fit` and "
        f"`held out` use {used}{f', `truth` uses {known}' if len(truth) else ''}."
    )
    return Table(f"Paired tests: {cell.title}", text, header, rows)

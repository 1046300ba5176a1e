"""The tables of a report, from the predictions of a run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.evaluation.report.motion import by_motion, worst_failures
from kornia_learnnorm.evaluation.report.rates import (
    BASELINE,
    RESAMPLES,
    Table,
    mean_text,
    p_text,
    rate_tables,
    rate_text,
)
from kornia_learnnorm.evaluation.runs.run import Cell, Run
from kornia_learnnorm.metrics.pairs import paired_bootstrap
from kornia_learnnorm.metrics.pose_accuracy import mean_average_accuracy, pose_auc
from kornia_learnnorm.protocol import THRESHOLDS

__all__ = ["report_tables"]


def report_tables(run: Run) -> list[Table]:
    """Make all tables of a run.

    Args:
        run: predictions with ``Hartley`` in every store and protocol.

    """
    tables = rate_tables(run)
    for cell in run.cells:
        tables += [_accuracy(cell), _consensus(cell), _tests(cell)]
    for cell in run.cells:
        learned = next((name for name in ("crossview", "paper", "whitening") if name in cell.predictions), None)
        if learned and cell.protocol == "filtered":
            tables += [by_motion(cell, run, learned), worst_failures(cell, run, learned)]
    return tables


def _accuracy(cell: Cell) -> Table:
    header = [
        "method",
        "own px",
        "held out px",
        "truth px",
        "truth: better than Hartley %",
        "rotation deg",
        "translation deg",
    ]
    header += ["AUC@5", "AUC@10", "AUC@20", "mAA(10)", "condition number", "rho", "distance 1", "distance 2"]
    rows = []
    for name, p in cell.predictions.items():
        numbers = [_median(p[key]) for key in ("own", "heldout", "truth")]
        error = torch.maximum(p["rotation_error"], p["translation_error"])
        error = error.nan_to_num(float("inf"))[_posed(cell)]
        pose = (
            [f"{100 * value:.1f}" for value in (*pose_auc(error), mean_average_accuracy(error))]
            if len(error)
            else [""] * 4
        )
        angles = [_median(p[key], 2) for key in ("rotation_error", "translation_error")]
        inside = [f"{p[key].nanmedian().item():.4g}" for key in ("condition_number", "rho", "distance1", "distance2")]
        truth = "-" if name == BASELINE else rate_text(cell, name, BASELINE, "truth")
        rows.append([name, *numbers, truth, *angles, *pose, *inside])
    text = (
        f"Medians over {len(cell.pair)} samples, of which {int(_with_truth(cell).sum())} have ground-truth inliers and "
        f"{int(_posed(cell).sum())} a ground-truth pose. `own` is fit: the mean symmetric epipolar distance of the "
        "sample's eight points. `held out` (16 other matches of the pair) and `truth` (the pair's ground-truth "
        "inliers), medians of the same distance, are accuracy, and so are the angles of the relative pose, their AUC "
        "at 5, 10 and 20 degrees and mAA(10), %. A pose that cannot be found counts as failed. `+LM` is refined on the "
        "eight points: the limit. The rest is what the normalisation did: the condition number is the largest over the "
        "eighth singular value of the design matrix, `rho` the second over the third singular value of the normalised "
        "matrix before the projection to rank 2 (the larger, the less that takes away), distances 1 and 2 are the mean "
        "distances of the normalised points from the origin in views 1 and 2; none has a unit."
    )
    return Table(f"Fit and accuracy: {cell.title}", text, header, rows)


def _consensus(cell: Cell) -> Table:
    """Share of inliers and F1 of the matrices of samples."""
    header = ["method", *(f"{name} @{threshold:g} px" for threshold in THRESHOLDS for name in ("inliers %", "F1 %"))]
    known = next(iter(cell.predictions.values()))["f1"].isfinite()
    rows = []
    for name, prediction in cell.predictions.items():
        cells = [
            mean_text(prediction[key][keep, place], cell.pair[keep])
            for place, keep in enumerate(known.T)
            for key in ("inliers", "f1")
        ]
        rows.append([name, *cells])
    kind = "that pass the ratio test" if cell.protocol == "filtered" else "with or without the ratio test"
    dropped = " and ".join(f"{int((~keep).sum())} at {t:g} px" for t, keep in zip(THRESHOLDS, known.T, strict=True))
    text = (
        f"Of one sample's matrix over all matches of its pair {kind}: mean over samples, 95 % bootstrap interval over "
        "image pairs. `inliers`: share of the matches with a symmetric epipolar distance below the threshold. `F1`: "
        "harmonic mean of precision and recall of these against the ground truth's inliers at the same threshold. "
        f"Samples of pairs without any of those are left out: {dropped}. There is no RANSAC here and no refinement on "
        "inliers: these are not the figures of Fan et al., Tables 2 and 3."
    )
    return Table(f"Inliers and F1: {cell.title}", text, header, rows)


def _with_truth(cell: Cell) -> Tensor:
    """Samples whose pair has ground-truth inliers, (S,)."""
    return ~cell.predictions[BASELINE]["truth"].isnan()


def _posed(cell: Cell) -> Tensor:
    """Samples whose pair has a ground-truth pose: where any method has an error on any of its samples, (S,)."""
    errors = torch.stack([p["translation_error"] for p in cell.predictions.values()])
    return torch.isin(cell.pair, cell.pair[errors.isfinite().any(0)])


def _median(values: Tensor, digits: int = 3) -> str:
    known = values[~values.isnan()]
    return (
        f"{known.quantile(0.5).item() if len(known) < 10**7 else known.median().item():.{digits}f}"
        if len(known)
        else ""
    )


def _tests(cell: Cell) -> Table:
    quantities = {"own": "own", "heldout": "held out", "truth": "truth"}
    header = ["method", *(f"{name}: change %, p" for name in quantities.values())]
    rows = []
    for name, prediction in cell.predictions.items():
        if name != BASELINE:
            tests = [_test(prediction[key], cell.predictions[BASELINE][key], cell.pair) for key in quantities]
            rows.append([name, *tests])
    text = (
        f"Change of the geometric mean of each distance against {BASELINE}, with its 95 % interval and two-sided "
        f"p-value from a paired bootstrap over image pairs of {RESAMPLES:,} resamples, which cannot tell p-values "
        f"below 0.001 apart. Negative is better. `own` and `held out` are of {_count(cell.pair)}, `truth` is of "
        f"{_count(cell.pair[_with_truth(cell)])}."
    )
    return Table(f"Paired tests: {cell.title}", text, header, rows)


def _count(pair: Tensor) -> str:
    return f"{len(pair)} samples of {len(torch.unique(pair))} pairs"


def _test(values: Tensor, baseline: Tensor, pair: Tensor) -> str:
    logs = values.clamp(min=1e-6).log() - baseline.clamp(min=1e-6).log()
    valid = logs.isfinite()
    if len(torch.unique(pair[valid])) < 2:
        return ""
    found = paired_bootstrap(logs[valid], torch.zeros_like(logs[valid]), pair[valid], draws=RESAMPLES)
    change: Callable[[float], str] = lambda value: f"{100 * np.expm1(value):+.1f}"  # noqa: E731
    return f"{change(found.mean)} [{change(found.low)}, {change(found.high)}], {p_text(found.p_value)}"

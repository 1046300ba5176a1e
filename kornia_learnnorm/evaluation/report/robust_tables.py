"""Tables of robust estimators in a report."""

from torch import Tensor

from kornia_learnnorm.evaluation import tables
from kornia_learnnorm.evaluation.report.method_tables import papers_data
from kornia_learnnorm.evaluation.robust.robust_estimators import TRUTH
from kornia_learnnorm.evaluation.robust.robust_run import RobustCell, RobustRun
from kornia_learnnorm.evaluation.tables import Cell, Number, Table, median_number
from kornia_learnnorm.protocol import MAX_RESIDUAL, TABLES2_AND_3, THRESHOLDS

MAX_ERROR = MAX_RESIDUAL  # pixels; larger errors are clamped
BASELINE = "RANSAC"  # that RANSAC with other normalisers is compared with
TABLE_NUMBER = {"filtered": " (Table 2)", "unfiltered": " (Table 3)"}  # in Fan et al.
SCALES = {"inliers": 100.0, "f1": 100.0, "error": 1.0}  # shares are printed in %


def robust_tables(run: RobustRun) -> list[Table]:
    """Return all tables of robust estimators of a run; numbers without a ground truth are empty cells."""
    made = []
    for cell in run.cells:
        if cell.estimates:
            if not any(bool(pairs_with_truth(cell, threshold).any()) for threshold in THRESHOLDS):
                cell = cell._replace(estimates={n: found for n, found in cell.estimates.items() if n != TRUTH})
            made += [_agreement(cell, run), _pose_and_time(cell), *_tests(cell)]
    return made


def pairs_with_truth(cell: RobustCell, threshold: float) -> Tensor:
    """Return a mask of the pairs whose ground truth has inliers at a threshold and at 1 px, (P,)."""
    results = next(iter(cell.estimates.values()))[threshold]
    return results["f1"][:, 0].isfinite() & ~results["error"][:, 0].isnan()


def kept_pairs(cell: RobustCell, threshold: float) -> Tensor:
    """Return a mask of the pairs of the means, (P,): those with ground truth, all where no pair has one."""
    known = pairs_with_truth(cell, threshold)
    return known | ~known.any()


def _agreement(cell: RobustCell, run: RobustRun) -> Table:
    names = ("inliers %", "F1 %", "error px")
    header = ["estimator", *(f"{name} @{t:g} px" for t in THRESHOLDS for name in names), "median error px @1 px"]
    known = {threshold: pairs_with_truth(cell, threshold) for threshold in THRESHOLDS}
    truth = any(bool(found.any()) for found in known.values())
    rows: list[list[Cell]] = []
    for name, by_threshold in cell.estimates.items():
        cells: list[Cell] = []
        for threshold in THRESHOLDS:
            inliers, f1, error = (by_threshold[threshold][key][kept_pairs(cell, threshold)] for key in SCALES)
            error = error.clamp(max=MAX_ERROR)
            cells += [_mean(100 * inliers, 2), _mean(100 * f1, 2), _mean(error, 3)]
        rows.append([name, *cells, median_number(error)])
    kind = papers_data(run.about["stores"][cell.store]), cell.protocol
    printed = [row[2:] for row in TABLES2_AND_3 if row[:2] == kind]
    for name, *values in printed:
        a, b, c, d = ("" if value is None else Number(value, ".2f") for value in values)
        rows.append([f"Fan et al., as printed: {name}", a, b, "", c, d, "", ""])
    dropped = " and ".join(f"{int((~kept).sum())} at {threshold:g} px" for threshold, kept in known.items())
    agreement = (
        "F1: agreement of these inliers with the ground truth's at the threshold. Error: mean distance of the ground "
        f"truth's inliers at 1 px; {MAX_ERROR:g} px at most, also for a failure. Pairs without ground-truth inliers "
        f"are left out: {dropped}. `ground-truth` is the true matrix: where it has few inliers, F1 says little."
    )
    text = (
        "Mean over image pairs and runs, ± standard deviation of the mean of a run. Inliers: share of the matches with "
        "a symmetric epipolar distance below the threshold. "
        f"{agreement if truth else 'There is no ground truth: more inliers do not prove a more accurate matrix.'} "
        "`RANSAC`, `learned:` and `guided:` are the package's own; all run with their defaults."
    )
    title = f"Robust estimation: {cell.title}{TABLE_NUMBER[cell.protocol] if printed else ''}"
    return Table(title, text, header, rows)


def _mean(values: Tensor, digits: int) -> Cell:
    """Return the mean of numbers (P, S) and the standard deviation of the mean over the S runs; empty if unknown."""
    runs = values.mean(0)
    if bool(runs.isnan().any()):
        return ""
    return Number(runs.mean().item(), f".{digits}f", std=runs.std().item() if len(runs) > 1 else None)


def _pose_and_time(cell: RobustCell) -> Table:
    names = (*tables.POSE_HEADER, "ms", "samples")
    header = ["estimator", *(f"{name} @{threshold:g} px" for threshold in THRESHOLDS for name in names)]
    rows: list[list[Cell]] = []
    for name, by_threshold in cell.estimates.items():
        cells: list[Cell] = []
        for results in by_threshold.values():
            cells += tables.pose_numbers(results["rotation_error"], results["translation_error"])
            cells.append(median_number(1000 * results["seconds"], ".1f"))
            cells.append(tables.number(results["samples"].mean().item(), ".0f"))
        rows.append([name, *cells])
    posed = any(row[1] for row in rows)
    poses = (
        "AUC up to 5, 10 and 20 degrees and mAA(10) of the pose error, the larger of the angles of rotation and "
        "translation, %, over all pairs and runs; failures count. "
    )
    text = f"{poses if posed else ''}`ms` is the median time of a run, `samples` the mean number of minimal samples."
    return Table(f"{'Pose and time' if posed else 'Time'}: {cell.title}", text, header, rows)


def _tests(cell: RobustCell) -> list[Table]:
    """Return the table of paired tests of RANSAC with other normalisers, if there are any to compare."""
    names = ("inliers", "F1", "error px")
    header = ["estimator", "against", *(f"{name} @{t:g} px: change, p" for t in THRESHOLDS for name in names)]
    own = [name for name in cell.estimates if name.startswith(f"{BASELINE}:") and BASELINE in cell.estimates]
    rows: list[list[Cell]] = [
        [name, BASELINE, *(_test(cell, name, t, key) for t in THRESHOLDS for key in SCALES)] for name in own
    ]
    text = (
        "Change of the mean against another estimator, in percentage points and in px, with the 95 % interval and "
        "two-sided p-value of a paired bootstrap, over the runs that both have. More inliers, a higher F1 and a "
        "smaller error are better."
    )
    return [Table(f"Paired tests of robust estimation: {cell.title}", text, header, rows)] if rows else []


def _test(cell: RobustCell, name: str, threshold: float, key: str) -> Cell:
    both = [cell.estimates[n][threshold][key][kept_pairs(cell, threshold)] for n in (name, BASELINE)]
    runs = min(values.shape[1] for values in both)
    return tables.paired_change(*(values[:, :runs].clamp(max=MAX_ERROR).mean(1) * SCALES[key] for values in both))

"""The tables of robust estimators in a report."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.report.rates import TESTS, Table, p_text
from kornia_learnnorm.evaluation.robust.hypotheses import MOST_ERROR
from kornia_learnnorm.evaluation.robust.run import RobustCell, RobustRun
from kornia_learnnorm.metrics.pairs import paired_bootstrap
from kornia_learnnorm.metrics.pose_accuracy import mean_average_accuracy, pose_auc
from kornia_learnnorm.protocol import THRESHOLDS

__all__ = ["about_robust", "robust_tables"]

# Fan et al., Tables 2 and 3: share of inliers and F1 at 0.1 px, then at 1 px, %.
PRINTED: dict[tuple[Sequence[str], str], dict[str, Sequence[str]]] = {
    (TESTS[0], "filtered"): {
        "Ranftl and Koltun": ("24.61", "14.65", "85.87", "75.77"),
        "MLESAC": ("18.60", "12.54", "84.48", "75.15"),
        "LMEDS": ("20.01", "13.34", "84.23", "75.44"),
        "USAC": ("21.43", "13.90", "85.13", "75.70"),
        "RANSAC, Hartley": ("21.85", "13.84", "84.96", "75.65"),
        "RANSAC, learned": ("21.89", "13.86", "84.98", "75.66"),
    },
    (TESTS[0], "unfiltered"): {
        "RANSAC, Hartley": ("4.40", "", "30.50", ""),
        "RANSAC, learned": ("4.38", "", "30.55", ""),
    },
    (TESTS[1], "unfiltered"): {
        "RANSAC, Hartley": ("7.60", "", "44.13", ""),
        "RANSAC, learned": ("7.64", "", "44.18", ""),
    },
}
NUMBER = {"filtered": " (Table 2)", "unfiltered": " (Table 3)"}


def about_robust(run: RobustRun) -> str:
    """Say what a run of robust estimation is of."""
    about = run.about
    stores = "; ".join(f"`{name}`: {text}" for name, text in about["stores"].items())
    absent = [name for name, identity in about["estimators"].items() if identity is None]
    peers = {
        identity for name, identity in about["estimators"].items() if identity and " " in identity and ":" not in name
    }
    versions = ", ".join(
        dict.fromkeys([*(f"{name} {text}" for name, text in about["versions"].items()), *sorted(peers)])
    )
    left = f" Left out, since not installed: {', '.join(absent)}." if absent else ""
    left += f" Not there yet, so left out: {'; '.join(run.missing)}." if run.missing else ""

    def most(number: int) -> str:
        return f"at most {number} evenly spaced" if number else "all"

    return (
        f"Robust estimation: {stores}; {most(about['pairs'])} image pairs of each, {about['seeds']} runs on each pair "
        f"from seed {about['seed']} ({about['slow_seeds']} of the slow estimators), hypotheses of "
        f"{most(about['hypotheses'])} pairs; PyTorch on {about['threads']} threads; {versions}.{left}"
    )


def robust_tables(run: RobustRun) -> list[Table]:
    """Make the tables of robust estimators of a run.

    Args:
        run: its figures.

    """
    return [
        table
        for cell in run.cells
        if cell.estimates
        for table in (_agreement(cell), _pose_and_time(cell), *_tests(cell))
    ]


def _known(cell: RobustCell, threshold: float) -> Tensor:
    """Pairs whose ground truth has inliers at a threshold and at 1 px, (P,)."""
    figures = next(iter(cell.estimates.values()))[threshold]
    return figures["f1"][:, 0].isfinite() & ~figures["error"][:, 0].isnan()


def _agreement(cell: RobustCell) -> Table:
    """Share of inliers, F1 and epipolar error."""
    names = ("inliers %", "F1 %", "error px")
    header = ["estimator", *(f"{name} @{t:g} px" for t in THRESHOLDS for name in names), "median error px @1 px"]
    rows = []
    for name, by_threshold in cell.estimates.items():
        cells = []
        for threshold in THRESHOLDS:
            known = _known(cell, threshold)
            inliers, f1, error = (by_threshold[threshold][key][known] for key in ("inliers", "f1", "error"))
            error = error.clamp(max=MOST_ERROR)
            cells += [_mean(100 * inliers, 2), _mean(100 * f1, 2), _mean(error, 3)]
        rows.append([name, *cells, f"{error.quantile(0.5).item():.3f}" if len(error) else ""])
    for (stores, protocol), printed in PRINTED.items():
        if cell.store.startswith(tuple(stores)) and cell.protocol == protocol:
            for name, (a, b, c, d) in printed.items():
                rows.append([f"Fan et al., as printed: {name}", a, b, "", c, d, "", ""])
    dropped = " and ".join(f"{int((~_known(cell, t)).sum())} at {t:g} px" for t in THRESHOLDS)
    text = (
        "Mean over image pairs and over runs, ± standard deviation of a run's mean where there are several. Inliers: "
        "share of the matches with a symmetric epipolar distance below the threshold that the estimator got. F1: "
        "against the ground truth's inliers at the threshold. Error: mean distance of the ground truth's inliers at 1 "
        f"px, at most {MOST_ERROR:g} px, which is that of a failure. Pairs without ground-truth inliers are left out: "
        f"{dropped}. `count:` is the best of 1,000 minimal samples, the same for all, without refinement; `time:` the "
        "best of those of 50 ms, which depends on the machine; `RANSAC` is the package's own with its defaults; "
        "`ground-truth` is what the others are measured with: where its inliers are few, F1 says little. All others "
        "are other packages' with their defaults."
    )
    return Table(f"Robust estimation: {cell.title}{NUMBER[cell.protocol]}", text, header, rows)


def _mean(values: Tensor, digits: int) -> str:
    """Return the mean of figures (P, S) and the standard deviation over runs."""
    if values.numel() == 0:
        return ""
    runs = values.mean(0)
    text = f"{runs.mean().item():.{digits}f}"
    return text if len(runs) < 2 else f"{text} ± {runs.std().item():.{digits}f}"


def _pose_and_time(cell: RobustCell) -> Table:
    """Accuracy of the relative pose, time and number of samples."""
    names = ("AUC@5", "AUC@10", "AUC@20", "mAA(10)", "ms", "samples")
    header = ["estimator", *(f"{name} @{threshold:g} px" for threshold in THRESHOLDS for name in names)]
    rows = []
    for name, by_threshold in cell.estimates.items():
        cells = []
        for figures in by_threshold.values():
            error = torch.maximum(figures["rotation_error"], figures["translation_error"])
            error = error[~error.isnan()]
            pose = (*pose_auc(error), mean_average_accuracy(error)) if len(error) else (torch.nan,) * 4
            samples = figures["samples"].mean().item()
            cells += [f"{100 * value:.1f}" for value in pose]
            cells += [f"{1000 * figures['seconds'].quantile(0.5).item():.1f}", f"{samples:.0f}".replace("nan", "")]
        rows.append([name, *cells])
    text = (
        "Area under the recall curve of the pose error, the larger of the angles of rotation and translation, up to 5, "
        "10 and 20 degrees, and mAA(10), %, over all pairs and runs; a failure counts. Median time of a run, and mean "
        "number of minimal samples where it is known. Estimators of other packages may do with fewer or take more."
    )
    return Table(f"Pose and time: {cell.title}", text, header, rows)


def _baseline(name: str) -> str:
    """Return what an estimator is compared with: Hartley's normalisation under the same budget, or the defaults."""
    kind, _, method = name.partition(":")
    if kind == "RANSAC" and method:
        return kind
    return "time:Hartley" if kind == "time" else "count:Hartley"


def _tests(cell: RobustCell) -> list[Table]:
    """Paired differences of the package's own estimators."""
    names = ("inliers", "F1", "error px")
    header = ["estimator", "against", *(f"{name} @{t:g} px: change, p" for t in THRESHOLDS for name in names)]
    rows = []
    for name, by_threshold in cell.estimates.items():
        baseline = _baseline(name)
        if name.startswith(("count:", "time:", "RANSAC")) and name != baseline and baseline in cell.estimates:
            other = cell.estimates[baseline]
            cells = [_test(by_threshold[t], other[t], key, _known(cell, t)) for t in THRESHOLDS for key in SCALES]
            rows.append([name, baseline, *cells])
    text = (
        "Change of the mean against another estimator, in points of % and in px, with its 95 % interval and two-sided "
        "p-value from a paired bootstrap over image pairs; the runs on a pair that both have are averaged first. More "
        "inliers and F1 and less error are better."
    )
    return [Table(f"Paired tests of robust estimation: {cell.title}", text, header, rows)] if rows else []


SCALES = {"inliers": 100.0, "f1": 100.0, "error": 1.0}


def _test(values: dict[str, Tensor], baseline: dict[str, Tensor], key: str, known: Tensor) -> str:
    runs = min(values[key].shape[1], baseline[key].shape[1])
    first, second = (f[key][known, :runs].clamp(max=MOST_ERROR).mean(1) * SCALES[key] for f in (values, baseline))
    if len(first) < 2:
        return ""
    found = paired_bootstrap(first, second, torch.arange(len(first)))
    return f"{found.mean:+.3f} [{found.low:+.3f}, {found.high:+.3f}], {p_text(found.p_value)}"

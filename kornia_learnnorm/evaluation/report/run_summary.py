"""Summary of a run: which method or estimator won in each store and protocol, by how much, and on what."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.methods import SHIPPED, base_name
from kornia_learnnorm.evaluation.report.method_tables import BASELINE, MIN_DISTANCE
from kornia_learnnorm.evaluation.report.robust_tables import MAX_ERROR, kept_pairs, pairs_with_truth
from kornia_learnnorm.evaluation.robust.robust_estimators import TRUTH
from kornia_learnnorm.evaluation.robust.robust_run import RobustCell, RobustRun
from kornia_learnnorm.evaluation.runs.prediction_run import Run, RunCell
from kornia_learnnorm.evaluation.tables import MIN_BOOTSTRAP_PAIRS, RESAMPLES, median_number, percent_change
from kornia_learnnorm.metrics.statistics import PairedDifference, median, paired_bootstrap
from kornia_learnnorm.protocol import INLIER_THRESHOLD, THRESHOLDS

# The errors of methods, the most telling first: what is known of the first that is known decides.
ERRORS = {
    "truth": "error on the ground-truth inliers",
    "heldout": "error on held-out matches",
    "own": "error of the fit (there are neither held-out matches nor a ground truth)",
}
AT_INLIERS = THRESHOLDS.index(INLIER_THRESHOLD)


class _Ranking(NamedTuple):
    """Methods by a score of each sample, of which less is better."""

    winner: str
    second: str  # empty for a single method
    against: dict[str, PairedDifference]  # the winner's difference from each other method; empty for too few pairs
    samples: int  # compared
    pairs: int  # their image pairs


def run_summary(run: Run) -> list[str]:
    """Return a sentence or two for each store and protocol of a run of predictions, Markdown."""
    trained_on = run.about.get("trained_on", {})
    own = [name for name, data in trained_on.items() if data and base_name(name) not in SHIPPED]
    return [_about_methods(cell, own) for cell in run.cells]


def robust_summary(run: RobustRun) -> list[str]:
    """Return a sentence or two for each store and protocol of a run of robust estimators, Markdown."""
    return [text for cell in run.cells if (text := _about_estimators(cell))]


def _rank(values: dict[str, float], scores: dict[str, Tensor], pair: Tensor) -> _Ranking:
    """Rank methods by the values that the summary quotes, and compare the winner's scores (S,) with each other's."""
    valid = torch.stack([*scores.values()]).isfinite().all(0)
    winner, *others = sorted(values, key=lambda name: math.inf if math.isnan(values[name]) else values[name])
    pair = pair[valid]
    pairs = len(torch.unique(pair))
    against = {
        name: paired_bootstrap(scores[winner][valid], scores[name][valid], pair, draws=RESAMPLES)
        for name in others
        if pairs >= MIN_BOOTSTRAP_PAIRS
    }
    return _Ranking(winner, others[0] if others else "", against, len(pair), pairs)


def _about_methods(cell: RunCell, own: list[str]) -> str:
    """Return which method has the smallest median error, as the table shows it, beside others: the user's own too."""
    key = next((key for key in ERRORS if not cell.predictions[BASELINE][key].isnan().all()), "own")
    logs = {name: p[key].clamp(min=MIN_DISTANCE).log() for name, p in cell.predictions.items()}
    ranking = _rank({name: median(p[key]).item() for name, p in cell.predictions.items()}, logs, cell.pair)
    winner, best = ranking.winner, cell.predictions[ranking.winner]
    text = f"**{cell.title}** ({ranking.samples:,} samples of {ranking.pairs} image pairs): "
    text += f"`{winner}` has the smallest {ERRORS[key]}, median {median_number(best[key])} px"
    text += f"{_compared(cell, ranking, key)}.{_level(ranking)}"
    for name in own:
        if name in cell.predictions and name != winner:
            text += f" `{name}` has {median_number(cell.predictions[name][key])} px."
    if ahead := [f"`{name}`" for name, found in ranking.against.items() if found.low > 0]:
        text += f" The geometric mean of the errors is smaller for {', '.join(ahead)}."
    if key != "truth" and "inliers" in best:
        means = {n: cell.predictions[n]["inliers"][:, AT_INLIERS].nanmean().item() for n in (winner, BASELINE)}
        shares = [f"`{name}` {100 * mean:.1f} %" for name, mean in means.items()]
        text += f" Share of the matches within {INLIER_THRESHOLD:g} px: {', '.join(shares)}. No ground truth is known."
    return text


def _compared(cell: RunCell, ranking: _Ranking, key: str) -> str:
    """Return the baseline's error, or the second's where the baseline has won, and the change against the baseline."""
    won = ranking.winner == BASELINE
    other = ranking.second if won else BASELINE
    error = median_number(cell.predictions[other][key]) if other else ""
    if not error:
        return ""
    text = f"; next is `{other}` with {error} px" if won else f"; {other} has {error} px"
    if found := ranking.against.get(other):
        logs = (-found.mean, -found.high, -found.low) if won else (found.mean, found.low, found.high)
        mean, low, high = map(percent_change, logs)
        text += f" (change of the geometric mean {mean:+.1f} % [{low:+.1f}, {high:+.1f}])"
    return text


def _level(ranking: _Ranking) -> str:
    """Return which methods cannot be distinguished from the winner."""
    if not ranking.second:
        return " There is nothing to test it against."
    if not ranking.against:
        count = "is 1 image pair" if ranking.pairs == 1 else f"are {ranking.pairs} image pairs"
        return f" Not tested: there {count}, a test needs {MIN_BOOTSTRAP_PAIRS}."
    level = [f"`{name}`" for name, found in ranking.against.items() if found.low <= 0 <= found.high]
    return f" Level with it: {', '.join(level)}." if level else ""


def _about_estimators(cell: RobustCell) -> str:
    """Return which robust estimator has the smallest error, or without ground truth the most inliers."""
    found = {name: by[INLIER_THRESHOLD] for name, by in cell.estimates.items() if name != TRUTH}
    if not found:
        return ""
    truth, kept = bool(pairs_with_truth(cell, INLIER_THRESHOLD).any()), kept_pairs(cell, INLIER_THRESHOLD)
    key, sign = ("error", 1) if truth else ("inliers", -1)
    scores = {name: sign * r[key][kept].clamp(max=MAX_ERROR).mean(1) for name, r in found.items()}
    ranking = _rank({n: s.mean().item() for n, s in scores.items()}, scores, torch.arange(int(kept.sum())))

    def describe(name: str) -> str:
        mean = abs(scores[name].mean().item())
        value = f"{mean:.3f} px" if truth else f"{100 * mean:.1f} %"
        return f"{value} in {median(1000 * found[name]['seconds'].flatten()).item():.1f} ms"

    what = f"smallest error on the ground-truth inliers at {INLIER_THRESHOLD:g} px"
    what = what if truth else f"largest share of inliers at {INLIER_THRESHOLD:g} px (there is no ground truth)"
    text = f"**{cell.title}, robust estimation** ({int(kept.sum())} image pairs): `{ranking.winner}` has the {what}, "
    text += f"mean {describe(ranking.winner)}"
    text += f"; next is `{ranking.second}` with {describe(ranking.second)}" if ranking.second else ""
    return f"{text}.{_level(ranking)}"

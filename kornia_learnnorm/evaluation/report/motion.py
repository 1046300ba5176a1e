"""Where a method helps and where it fails: the tables by motion and of the worst samples."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.report.rates import BASELINE, Table, rate_text
from kornia_learnnorm.evaluation.runs.run import Cell, Run

__all__ = ["by_motion", "worst_failures"]

FAILURES = 10
FEWEST = 4  # pairs that make two halves
SPREAD = 0.01  # of the median: figures that differ less make no halves worth telling apart
MOTIONS = {
    "rotation": "rotation, degrees",
    "forward": "forward share of the translation",
    "parallax": "parallax, px",
    "inliers": "share of inliers among the matches",
}


def by_motion(cell: Cell, run: Run, learned: str) -> Table:
    """Compare rates within the halves of the pairs on either side of the median of a figure of their motion.

    Args:
        cell: predictions of a store and protocol.
        run: what they belong to.
        learned: the method.

    """
    rows, left = [], []
    truth = ~cell.predictions[BASELINE]["truth"].isnan()
    for key, name in MOTIONS.items():
        values = torch.from_numpy(run.pairs[cell.store][key])
        if reason := _no_halves(values):
            left.append(f"{name}, {reason}")
            continue
        middle = values[values.isfinite()].quantile(0.5)
        text = _distinct(middle, values)
        for half, chosen in ((f"up to {text}", values <= middle), (f"above {text}", values > middle)):
            inside = chosen[cell.pair]
            rates = [rate_text(cell, learned, BASELINE, quantity, inside) for quantity in ("own", "heldout", "truth")]
            counts = [int(chosen.sum()), int(inside.sum()), int((inside & truth).sum())]
            rows.append([name, half, *map(str, counts), *rates])
    header = ["motion", "half", "pairs", "samples", "with truth", "own: better %", "held out: better %"]
    text = (
        f"Where `{learned}` helps: its rate against {BASELINE} in the halves of the pairs below and above each median. "
        "`with truth` counts the samples whose pair has ground-truth inliers, of which the last column is. "
        "A rate without an interval is of one pair."
    )
    if left:
        text += f" Not shown: {'; '.join(left)}."
    return Table(f"By motion: {cell.title}", text, [*header, "truth: better %"], rows)


def _no_halves(values: Tensor) -> str:
    """Return why pairs do not fall into halves by a figure; nothing where they do."""
    known = values[values.isfinite()]
    if len(known) < FEWEST:
        return f"known of {len(known)} of {len(values)} pairs"
    low, middle, high = known.quantile(known.new_tensor([0.0, 0.5, 1.0])).tolist()
    if high - low <= SPREAD * abs(middle) or high == middle:
        return f"from {low:.4g} to {high:.4g} in all pairs" if high > low else f"{low:.4g} in all pairs"
    return ""


def _distinct(middle: Tensor, values: Tensor) -> str:
    """Return a median with as many digits as tell it from the values above."""
    above = values[values > middle].min().item()
    texts = [f"{middle.item():.{digits}g}" for digits in (3, 4, 5, 6)]
    return next((text for text in texts if float(text) < above), texts[-1])


def worst_failures(cell: Cell, run: Run, learned: str) -> Table:
    """List the samples on which a method is worst against the baseline, by ground truth.

    Args:
        cell: predictions of a store and protocol.
        run: what they belong to.
        learned: the method.

    """
    mine, other = cell.predictions[learned], cell.predictions[BASELINE]
    ratio = (mine["truth"] / other["truth"]).nan_to_num(-1.0)
    worst = ratio.argsort(descending=True)[:FAILURES]
    header = ["pair", "truth px", f"{BASELINE}: truth px", "ratio", "own px", f"{BASELINE}: own px"]
    rows = []
    for row in worst[ratio[worst] > 0].tolist():
        pair = int(cell.pair[row])
        numbers = [mine["truth"][row], other["truth"][row], ratio[row], mine["own"][row], other["own"][row]]
        cells = [f"{float(number):.2f}" for number in numbers]
        parallax = float(run.pairs[cell.store]["parallax"][pair])
        name = str(run.pairs[cell.store]["names"][pair])
        rows.append([name, *cells, f"{float(mine['condition_number'][row]):.3g}", f"{parallax:.1f}"])
    text = (
        f"The {len(rows)} samples with the largest ratio of the error on the ground-truth inliers (`truth`, the median "
        f"symmetric epipolar distance) under `{learned}` to that under {BASELINE}, of "
        f"{int((ratio >= 0).sum())} samples with ground truth. `own` is the mean of the sample's eight points."
    )
    return Table(f"Worst failures: {cell.title}", text, [*header, "condition number", "parallax px"], rows)

"""Tables that show where a method helps and where it fails: by motion, and the worst samples."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.evaluation.report.formatting import BASELINE, Table, number_text, rate_text
from kornia_learnnorm.evaluation.runs.run import Cell, Run
from kornia_learnnorm.metrics.summary import median

__all__ = ["by_motion", "worst_failures"]

MAX_FAILURES = 10  # rows of the table of the worst samples
MIN_PAIRS = 4  # pairs with a known value; fewer are not split in halves
MIN_RELATIVE_RANGE = 0.01  # of the median; pairs whose values differ less are not split in halves
MOTIONS = {
    "rotation": "rotation, degrees",
    "forward": "forward share of the translation",
    "parallax": "parallax, px",
    "inliers": "share of inliers among the matches",
}


def by_motion(cell: Cell, run: Run, learned: str) -> Table:
    """Return the better rates of a method in two halves of the image pairs, split at the median of each motion."""
    rows, left_out = [], []
    truth = ~cell.predictions[BASELINE]["truth"].isnan()
    for key, name in MOTIONS.items():
        values = torch.from_numpy(run.pairs[cell.store][key])
        if reason := _why_not_split(values):
            left_out.append(f"{name}, {reason}")
            continue
        middle = median(values[values.isfinite()])
        text = _distinct(middle, values)
        for half, chosen in ((f"up to {text}", values <= middle), (f"above {text}", values > middle)):
            inside = chosen[cell.pair]
            rates = [rate_text(cell, learned, BASELINE, quantity, inside) for quantity in ("own", "heldout", "truth")]
            counts = [int(chosen.sum()), int(inside.sum()), int((inside & truth).sum())]
            rows.append([name, half, *map(str, counts), *rates])
    header = ["motion", "half", "pairs", "samples", "with truth", "own: better %", "held out: better %"]
    text = (
        f"Better rate of `{learned}` against {BASELINE} in the halves of the image pairs below and above the median of "
        "each motion. `with truth` is the number of samples whose pair has ground-truth inliers; the last column is "
        "the rate on them. A rate of one pair has no interval."
    )
    if left_out:
        text += f" Not shown: {'; '.join(left_out)}."
    return Table(f"By motion: {cell.title}", text, [*header, "truth: better %"], rows)


def _why_not_split(values: Tensor) -> str:
    """Return why image pairs cannot be split at the median of their values; an empty text where they can."""
    known = values[values.isfinite()]
    if len(known) < MIN_PAIRS:
        return f"known of {len(known)} of {len(values)} pairs"
    low, middle, high = known.quantile(known.new_tensor([0.0, 0.5, 1.0])).tolist()
    if high - low <= MIN_RELATIVE_RANGE * abs(middle) or high == middle:
        return f"from {low:.4g} to {high:.4g} in all pairs" if high > low else f"{low:.4g} in all pairs"
    return ""


def _distinct(middle: Tensor, values: Tensor) -> str:
    """Return a median with as many digits as distinguish it from the next larger value."""
    above = values[values > middle].min().item()
    texts = [f"{middle.item():.{digits}g}" for digits in (3, 4, 5, 6)]
    return next((text for text in texts if float(text) < above), texts[-1])


def worst_failures(cell: Cell, run: Run, learned: str) -> Table:
    """Return the samples with the largest ratio of a method's ground-truth error to the baseline's."""
    mine, other = cell.predictions[learned], cell.predictions[BASELINE]
    ratio = (mine["truth"] / other["truth"]).nan_to_num(nan=-1.0, posinf=torch.inf)
    worst = ratio.argsort(descending=True)[:MAX_FAILURES]
    header = ["pair", "truth px", f"{BASELINE}: truth px", "ratio", "own px", f"{BASELINE}: own px"]
    pairs, rows = run.pairs[cell.store], []
    for row in worst[ratio[worst] > 0].tolist():
        pair = int(cell.pair[row])
        numbers = (mine["truth"][row], other["truth"][row], ratio[row], mine["own"][row], other["own"][row])
        cells = [number_text(float(number), ".2f") for number in numbers]
        condition, parallax = float(mine["condition_number"][row]), float(pairs["parallax"][pair])
        rows.append([str(pairs["names"][pair]), *cells, number_text(condition, ".3g"), number_text(parallax, ".1f")])
    text = (
        f"The {len(rows)} samples with the largest ratio of `truth`, the median symmetric epipolar distance of the "
        f"ground-truth inliers, under `{learned}` to that under {BASELINE}, of {int((ratio >= 0).sum())} samples with "
        "ground truth. `own` is the mean distance of the sample's eight points."
    )
    return Table(f"Worst failures: {cell.title}", text, [*header, "condition number", "parallax px"], rows)

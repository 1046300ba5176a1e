"""Tables of better rates: how often a method has a smaller error than Hartley's normalisation or whitening."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

from kornia_learnnorm.evaluation.report.formatting import BASELINE, Table, rate_text
from kornia_learnnorm.evaluation.runs.run import Cell, Run
from kornia_learnnorm.metrics.better_rate import better_rate
from kornia_learnnorm.protocol import PROTOCOLS, RATIO

__all__ = ["TESTS", "rate_tables", "was_trained_on", "with_baseline"]

# Fan et al., Table 1: better than Hartley % by training set, on KITTI 06-10 and on TUM at KITTI's size.
PRINTED = {"KITTI 00-05": ("86.68", "90.04"), "TUM": ("84.22", "89.73"), "KITTI 00-05 and TUM": ("87.05", "91.43")}
TESTS = (("kitti_06", "kitti_07", "kitti_08", "kitti_09", "kitti_10"), ("tum",))  # beginnings of stores' names


def with_baseline(run: Run) -> Run:
    """Return a run without the stores and protocols that lack Hartley's normalisation; ``missing`` names them."""
    cells = [cell for cell in run.cells if BASELINE in cell.predictions]
    if not cells:
        found = sorted({name for cell in run.cells for name in cell.predictions})
        raise ValueError(
            f"a report compares with {BASELINE}, the run has predictions of {', '.join(found) or 'no method'} so far:"
            f" run learnnorm evaluate with {BASELINE} among --methods and the same --out"
        )
    left_out = [f"{cell.title}, without {BASELINE}" for cell in run.cells if BASELINE not in cell.predictions]
    return replace(run, cells=cells, missing=[*run.missing, *left_out])


def rate_tables(run: Run) -> list[Table]:
    """Return the tables of rates against Hartley and, where the run has it, whitening."""
    tables = []
    for baseline in (BASELINE, "whitening"):
        for protocol in PROTOCOLS:
            cells = [cell for cell in run.cells if cell.protocol == protocol and baseline in cell.predictions]
            if cells:
                tables.append(_better_rates(run, cells, baseline))
    return tables


def _better_rates(run: Run, cells: list[Cell], baseline: str) -> Table:
    trained, protocol = run.about["trained_on"], cells[0].protocol
    rows = []
    for name in run.about["methods"]:
        rates = [
            _rate(cell, name, baseline) + (" *" if was_trained_on(cell.store, trained[name]) else "") for cell in cells
        ]
        rows.append([name, ", ".join(trained[name]) or "-", *rates])
    found = [
        better_rate(prediction["own"], cell.predictions[baseline]["own"])
        for cell in cells
        for name, prediction in cell.predictions.items()
        if name != baseline
    ]
    ties, degenerate = sum(rate.ties for rate in found), sum(rate.degenerate for rate in found)
    text = (
        f"Share of samples of {run.about['size']} correspondences with a smaller mean symmetric epipolar distance than "
        f"under {baseline}, %, with the 95 % bootstrap interval over image pairs. An asterisk marks a method that was "
        f"trained on pairs of the store. The whole table has {ties} ties, which count as not better, and leaves out "
        f"{degenerate} degenerate comparisons. The header gives the number of samples used and drawn; samples with a "
        "mean symmetric epipolar distance under the eight-point algorithm without normalisation of "
        f"{run.about['max_residual']:g} px or more are not used."
    )
    if protocol == "filtered":
        text += f" Filtered matches: the nearest descriptor is less than {RATIO:g} times as far as the second nearest."
    if (protocol, baseline) == ("filtered", BASELINE):
        rows += [["Fan et al., as printed", train, *_printed(cells, values)] for train, values in PRINTED.items()]
        text += " Fan et al. test on KITTI 06-10 and on TUM freiburg3_long_office at KITTI's size."
    header = ["method", "trained on", *(f"{cell.store}: {len(cell.pair)} of {cell.drawn}" for cell in cells)]
    title = f"Better than {baseline}, {protocol}{' (Table 1)' if baseline == BASELINE else ''}"
    return Table(title, text, header, rows)


def _rate(cell: Cell, name: str, baseline: str) -> str:
    if name == baseline:
        return "-"
    return rate_text(cell, name, baseline, "own") if name in cell.predictions else ""


def _printed(cells: list[Cell], values: tuple[str, str]) -> list[str]:
    both = list(zip(TESTS, values, strict=True))
    return [next((value for names, value in both if cell.store.startswith(names)), "") for cell in cells]


def was_trained_on(store: str, trained_on: Iterable[str]) -> bool:
    """Return whether image pairs of a store are in the training data, going by names such as ``tum@0:9``."""
    name, first, stop = _pairs_of(store)
    return any(name == other and first < end and start < stop for other, start, end in map(_pairs_of, trained_on))


def _pairs_of(store: str) -> tuple[str, float, float]:
    match = re.fullmatch(r"(.+)@(\d+):(\d+)", store)
    return (match[1], float(match[2]), float(match[3])) if match else (store, 0.0, float("inf"))

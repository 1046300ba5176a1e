"""Ranges in the sentences of pages, which no table has, against the results that they are computed from."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
SIZES, SPEED, COMPILED, TIMED = (
    json.loads((DOCS / f"results/{name}.json").read_text(encoding="utf-8"))
    for name in ("sizes", "speed", "compile", "sizes-time")
)
SOLVERS, ROBUST_GROUP = "larger sets: solvers", "larger sets: robust estimators"
UNFILTERED, FILTERED = "kitti_06, unfiltered", "kitti_06, filtered"
INDOOR, INDOOR_FILTERED = "tum_fr3_office, unfiltered", "tum_fr3_office, filtered"
OWN, ROBUST, TINY = "learned:robust-synthetic", "learned:robust", "learned:robust-tiny"
PEERS = "opencv-usac-magsac", "poselib", "kornia", "RANSAC"
ALL = (16, 32, 64, 128, 512)


def cells(name, row, *columns):
    """Numbers of a row of a file of results, by the names or indices of the columns; several stand in a cell of AUC."""
    with (DOCS / f"results/{name}.csv").open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    found = next(cells for cells in rows if cells[0].strip("`") == row)
    chosen = [found[column if isinstance(column, int) else header.index(column)] for column in columns]
    return [float(number) for cell in chosen for number in cell.split(", ")]


def ratios(title, method, reference, sizes=ALL, column=0):
    """Ratios of the errors (column 0) or times (column 1) of two methods."""
    found = SIZES[title]
    return [found[method][str(size)][column] / found[reference][str(size)][column] for size in sizes]


def smaller(*args):
    """By how many percent errors are smaller."""
    return [100 * (1 - ratio) for ratio in ratios(*args)]


def larger(*args):
    return [-percent for percent in smaller(*args)]


def ahead_of_all(title, sizes=ALL):
    """By how many percent the errors of the layer are smaller than the smallest of the estimators without training."""
    errors = {n: [SIZES[title][name][str(n)][0] for name in (OWN, *PEERS)] for n in sizes}
    return [100 * (1 - own / min(others)) for own, *others in errors.values()]


def speed(method, reference, group, cases=None):
    """Ratios of the times of two methods for all or some cases of a group."""
    return [times[method] / times[reference] for case, times in SPEED[group].items() if cases is None or case in cases]


def hartley(way):
    return [ratio for group in ("sets of eight", SOLVERS) for ratio in speed("Hartley", "kornia", f"{group}, {way}")]


def layer_times(size):
    """Times of the layer by those of RANSAC where that needs few samples: on filtered matches, and with scores."""
    plain = [ratio for title in (FILTERED, INDOOR_FILTERED) for ratio in ratios(title, OWN, "RANSAC", [size], 1)]
    return plain + [ratio for title in SIZES for ratio in ratios(title, f"{OWN}+scores", "RANSAC+scores", [size], 1)]


def gains(case):
    """How many times as fast layers are when compiled."""
    times = [times for name, times in COMPILED.items() if name.endswith(f", {case}")]
    return [row["not compiled, ms"] / row["later calls, ms"] for row in times]


LARGE_BATCHES = [case for case in SPEED[f"{ROBUST_GROUP}, forward"] if not case.startswith("1 x") and " 32" not in case]
# By page: a sentence with a range, or a number, in it, the decimals, and the values that it sums up.
STATEMENTS = [
    ("estimation", "are {} % smaller than those of RANSAC; on TUM's", 0, smaller(UNFILTERED, OWN, "RANSAC")),
    ("estimation", "on TUM's they are {} % smaller up to 32 matches", 0, smaller(INDOOR, OWN, "RANSAC", (16, 32))),
    ("estimation", "up to 32 matches, {} % larger at 64", 0, larger(INDOOR, OWN, "RANSAC", (64,))),
    ("estimation", "On unfiltered matches of KITTI its errors are {} % smaller", 0, smaller(UNFILTERED, OWN, "RANSAC")),
    ("estimation", "it is level at 16 and {} % ahead from 32 on", 0, smaller(FILTERED, OWN, "RANSAC", ALL[1:])),
    ("estimation", "it is {} % behind up to 128", 0, larger(INDOOR_FILTERED, OWN, "RANSAC", ALL[:-1])),
    ("estimation", "it is ahead up to 32, {} % behind at 64", 0, larger(INDOOR, OWN, "RANSAC", (64,))),
    ("estimation", "at 64 and {} % ahead from 128 on", 0, smaller(INDOOR, OWN, "RANSAC", (128, 512))),
    ("estimation", "It is {} % ahead of it at 16 unfiltered", 0, smaller(UNFILTERED, ROBUST, OWN, (16,))),
    ("estimation", "on TUM it is {} % behind at 16 matches and at 32 filtered ones", 0,
     [*larger(INDOOR, ROBUST, OWN, (16,)), *larger(INDOOR_FILTERED, ROBUST, OWN, (16, 32))]),
    ("estimation", "unfiltered matches and {} % behind at 16 filtered", 0, larger(FILTERED, TINY, ROBUST, (16,))),
    ("estimation", "unfiltered ones and {} % behind from 32 on", 0, larger(INDOOR, TINY, ROBUST, ALL[1:])),
    ("estimation", "takes {} % of the time of `RANSAC`", 0,
     [100 * times[OWN][size][1] / times["RANSAC"][size][1] for times in TIMED.values() for size in ("128", "512")]),
    ("estimation", "{} ms against", 1, [TIMED[UNFILTERED][OWN]["128"][1]]),
    ("estimation", "ms against {} at N = 128 on KITTI", 0, [TIMED[UNFILTERED]["RANSAC"]["128"][1]]),
    ("estimation", "the layer takes {} times as long at 128", 1, layer_times(128)),
    ("estimation", "at 128 and {} times as long at 512", 1, layer_times(512)),
    ("estimation", "at 64, and {} % smaller from 128 on.", 0, smaller(INDOOR, OWN, "RANSAC", (128, 512))),
    ("benchmarks", "on unfiltered ones from 16 on and by {} %", 0, ahead_of_all(UNFILTERED)),
    ("benchmarks", "behind at 64 and ahead by {} % from 128 on", 0, smaller(INDOOR, OWN, "RANSAC", (128, 512))),
    ("benchmarks", "with the ratio test it is {} % behind up to 128", 0,
     larger(INDOOR_FILTERED, OWN, "RANSAC", ALL[:-1])),
    ("normalizers", "`crossview-sets`, lower it by {} %", 0, smaller(FILTERED, "crossview-sets", "Hartley")),
    ("normalizers", "its errors are {} % smaller than with those", 0, smaller(FILTERED, "crossview-sets", "Hartley")),
    ("normalizers", "and on unfiltered matches {} %, which", 0, smaller(UNFILTERED, "crossview-sets", "Hartley")),
    ("normalizers", "which still leaves {} px", 0,
     [SIZES[UNFILTERED]["crossview-sets"][str(size)][0] for size in ALL]),
    ("pair", "two-view estimation it solves {};", 0, cells("pair-rendered", "all", "right")),
    ("pair", "all {} wrong answers have a warning", 0, cells("pair-rendered", "all", "wrong")),
    ("pair", "The price is a warning on {} of the", 0, cells("pair-rendered", "all", "right, but warned")),
    ("ransac", "{} points ahead on TUM's filtered matches", 0,
     [own - other for own, other in zip(cells("ransac-calibrated", "RANSAC-calibrated", 3),
                                        cells("ransac-calibrated", "poselib-calibrated", 3), strict=True)]),
    ("speed", "normalisation takes {} times Kornia's time forward", 1, hartley("forward")),
    ("speed", "and {} times forward and backward", 1, hartley("forward and backward")),
    ("speed", "the learned layer takes {} % of the time of `RANSAC`", 0,
     [100 * r for r in speed("learned", "RANSAC", f"{ROBUST_GROUP}, forward", LARGE_BATCHES)]),
    ("speed", "comes nearest, with {} at 2,048 eights", 1,
     speed("Hartley", "kornia", "sets of eight, forward", ["2048 x 8"])),
    ("speed", "and {} at 16,384, forward and backward", 1,
     speed("Hartley", "kornia", "sets of eight, forward and backward", ["16384 x 8"])),
    ("speed", "at 64 eights it makes Kornia and this package {} times as fast", 1, gains("64 x 8")),
    ("speed", "at 2,048 eights {} times", 1, gains("2048 x 8")),
]  # fmt: skip


@pytest.mark.parametrize(
    ("page", "sentence", "decimals", "values"), STATEMENTS, ids=lambda value: value if isinstance(value, str) else ""
)
def test_ranges_in_sentences(page, sentence, decimals, values):
    low, high = (f"{limit(values):.{decimals}f}" for limit in (min, max))
    text = " ".join((DOCS / f"{page}.md").read_text(encoding="utf-8").split())
    assert sentence.format(low if low == high else f"{low} to {high}") in text


@pytest.mark.parametrize(("column", "share"), [(5, 5), (6, 8)], ids=["KITTI", "TUM"])
def test_cameras_save_samples(column, share):
    samples, fewer = (cells("ransac-calibrated", name, column)[0] for name in ("RANSAC", "RANSAC-calibrated"))
    assert samples / fewer > share


def test_no_wrong_answer_comes_without_a_warning():
    assert cells("pair-rendered", "all", "silently wrong") == [0]


def test_the_layer_is_the_most_accurate_on_kitti():
    """As the benchmarks say: with outliers, and from 32 matches on without."""
    assert min(ahead_of_all(UNFILTERED)) > 0
    assert min(ahead_of_all(FILTERED, ALL[1:])) > 0


def test_scores_lower_the_errors_on_unfiltered_matches():
    for title in (UNFILTERED, INDOOR):
        for name in (OWN, ROBUST, TINY):
            assert max(ratios(title, f"{name}+scores", name, ALL[:-1])) < 1
        assert max(ratios(title, "RANSAC+scores", "RANSAC", ALL[1:])) < 1
    assert ratios(INDOOR, "RANSAC+scores", "RANSAC", (16,))[0] == pytest.approx(7, abs=0.5)

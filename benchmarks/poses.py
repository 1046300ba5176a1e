"""Compare estimators by the relative pose, on whole image pairs of stores with cameras and poses.

The pose error is the larger of the angles of rotation and translation; failures count. Table: AUC up to 5, 10 and 20
degrees, %, median error, degrees, and median time, ms, of one thread. Every estimator gets all matches of a pair, at a
threshold of 1 px, and the scores of the matches where its name ends in +scores.

    python benchmarks/poses.py STORE.h5 [STORE.h5 ...] [--pairs 0] [--rotated 0] [--estimators NAME ...] [--csv FILE]

An estimator is one of learnnorm robust; what is not installed is left out. With --rotated 180 the second camera is
upside down: its pixels are turned about the principal point, and the true pose with them.
"""

import math

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from shared import auc_cells, make_parser, write_csv

from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.evaluation.robust.robust_estimators import (
    EvaluatedPair,
    estimator_names,
    find_estimator,
    run_estimator,
)
from kornia_learnnorm.evaluation.robust.robust_run import even_pairs, measure, shuffled_pair
from kornia_learnnorm.evaluation.tables import format_table, names_of
from kornia_learnnorm.geometry.transforms import transform_points

ESTIMATORS = (
    *("opencv-usac-magsac", "poselib", "pysuperansac", "kornia", "RANSAC"),
    *("learned:robust-synthetic", "learned:robust-synthetic+scores", "guided:robust-synthetic"),
    *("opencv-usac-magsac-calibrated", "poselib-calibrated", "RANSAC-calibrated"),
    *("learned:robust-pose-synthetic", "learned:robust-pose-synthetic+scores"),
    *("learned:robust-pose", "learned:robust-pose+scores"),
)
HEADER = ["estimator", "AUC 5", "10", "20", "median", "ms"]
THRESHOLD = 1.0  # pixels


def find_installed(names: list[str]) -> dict:
    """Return the estimators whose packages are installed, by their short names; print the others."""
    found = {}
    for name, short in estimator_names(names).items():
        try:
            found[short] = find_estimator(name)
        except ImportError as error:
            print(f"left out: {error}")
    return found


def rotate_second(pair: EvaluatedPair, degrees: float) -> EvaluatedPair:
    """Return a pair whose second camera is turned about its optical axis."""
    R = axis_angle_to_rotation_matrix(torch.tensor([[0.0, 0.0, math.radians(degrees)]]).double())[0]
    A = pair.K[1] @ R @ torch.linalg.inv(pair.K[1])
    points2, F_mat = transform_points(pair.points2[None], A[None])[0], torch.linalg.inv(A).mT @ pair.F_mat
    return pair._replace(points2=points2, F_mat=F_mat, R=R @ pair.R, t=R @ pair.t)


def measure_store(path: str, number: int, estimators: dict, degrees: float) -> list[list[str]]:
    """Return the rows of a store's table; estimators take turns on every pair."""
    store = read_store(path)
    errors: dict[str, list[float]] = {name: [] for name in estimators}
    seconds: dict[str, list[float]] = {name: [] for name in estimators}
    for index in even_pairs(len(store), number):
        pair = rotate_second(shuffled_pair(store, index, "unfiltered", seed=0), degrees)
        for name, estimator in estimators.items():
            if not seconds[name]:  # the first call loads and compiles
                run_estimator(estimator, pair, 0, THRESHOLD)
            found = run_estimator(estimator, pair, 0, THRESHOLD)
            results = measure(pair, found.F_mat, THRESHOLD)
            seconds[name].append(found.seconds)
            if not math.isnan(error := max(results["rotation_error"], results["translation_error"])):
                errors[name].append(error)
    rows = []
    for name, values in errors.items():
        error, ms = torch.tensor(values).double(), 1000 * torch.tensor(seconds[name]).median().item()
        rows.append([name, *auc_cells(error), f"{error.median().item():.2f}", f"{ms:.1f}"])
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__, csv="write all tables to this file")
    parser.add_argument("stores", nargs="+")
    parser.add_argument("--pairs", type=int, default=0, help="of each store, evenly spaced; 0: all")
    parser.add_argument("--rotated", type=float, default=0.0, help="second camera about its optical axis, degrees")
    parser.add_argument("--estimators", nargs="+", default=[*ESTIMATORS])
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    estimators, rows = find_installed(args.estimators), []
    for path, name in names_of(args.stores).items():
        found = measure_store(path, args.pairs, estimators, args.rotated)
        print(f"{name}\n\n{format_table(HEADER, found)}\n", flush=True)
        rows += [[name, *row] for row in found]
    write_csv(args.csv, [["store", *HEADER], *rows])


if __name__ == "__main__":
    main()

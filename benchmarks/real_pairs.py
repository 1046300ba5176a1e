"""Measure the pose errors of `estimate_pair` on real image pairs, beside RANSAC and other packages on its matches.

The pairs are consecutive frames of TUM RGB-D (poses up to 0.1 s away) and of KITTI odometry 06, and photographs of
buildings, neighbours and three apart. Every estimator gets the one-to-one matches of `estimate_pair`; poses are taken
from F, the true cameras and the matches within 1 px of F, or from H where it is the answer and cameras are known. The
error is the larger of the angles of rotation and translation; an answer is wrong above 10 degrees, or without a pose,
but for a homography without cameras, which has none. With cameras, as with `--K`, F has five parameters instead of
seven. The true error in pixels is that of the epipolar lines of F, where the true ones put the inliers; it is known as
well as the poses are. The last table is of random subsets of the matches of every fourth pair. Prints progress to
stderr.

    python benchmarks/real_pairs.py DATA [--datasets tum kitti photographs] [--methods DETECTOR+MATCHER ...]
        [--pairs 50] [--every 4] [--focal FACTOR] [--k1 K1] [--json FILE] [--csv FILE]

With --focal, the focal lengths given to all estimators are wrong by this factor, and nothing runs without cameras; with
--k1, matches have this radial distortion, OpenCV's k1, that no estimator is told of.
DATA holds the folders `tum/SEQUENCE`, `kitti/sequences/06`, `kitti/poses/06.txt`, and `images/photographs` with a file
cameras.json: for each image K and camera_to_world.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.geometry.epipolar import get_closest_point_on_epipolar_line
from shared import make_parser, photograph_pairs, write_csv, write_json
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.reading import read_dataset
from kornia_learnnorm.data.images import scaling
from kornia_learnnorm.evaluation.robust.peers import CALIBRATED, find_peer
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view.estimate_pair import MatchedPair, match_two_images
from kornia_learnnorm.two_view.result import PairEstimate

DATASETS: dict[str, dict[str, Any]] = {"tum": {"max_difference": 0.1}, "kitti": {"sequences": ["06"]}}
PHOTOGRAPHS, GAPS = "photographs", (1, 3)  # photographs so many images apart are pairs
PEERS = {"opencv-usac-magsac": "OpenCV USAC_MAGSAC", "poselib": "PoseLib"}  # where installed
OWN = "estimate_pair"
SIZES = (8, 32, 128, 512, 0)  # matches of a subset; 0 for all
THRESHOLD = 1.0  # pixels
MAX_RATIO = 1.1  # of an error to that of RANSAC
MAX_POSE_ERROR = 10.0  # degrees; an answer with a larger one is wrong

Record = dict[str, Any]


class Pair(NamedTuple):
    """An image pair with its truth, and the cameras that the estimators may use."""

    dataset: str
    number: int
    frames: FramePair
    calibrated: bool
    method: str  # detector and matcher
    matched: MatchedPair
    focal: float = 1.0  # of the focal lengths given over the true ones

    @property
    def cameras(self) -> dict[str, Tensor]:
        """Return the arguments K1 and K2; none without cameras."""
        return dict(zip(("K1", "K2"), self.K, strict=True)) if self.calibrated else {}

    @property
    def K(self) -> tuple[Tensor, Tensor]:  # noqa: N802
        """Return the true cameras, or those of a wrong focal length."""
        scale = torch.tensor([self.focal, self.focal, 1.0], dtype=torch.float64)
        return torch.from_numpy(self.frames.frame1.K) * scale, torch.from_numpy(self.frames.frame2.K) * scale


def read_pairs(dataset: str, data: Path) -> list[FramePair]:
    """Return the image pairs of a dataset."""
    if dataset == PHOTOGRAPHS:
        return photograph_pairs(data / "images" / dataset, GAPS)
    return [FramePair(*pair) for pair in pairwise(read_dataset(dataset, data / dataset, **DATASETS[dataset]))]


def distort(matched: MatchedPair, frames: FramePair, k1: float) -> MatchedPair:
    """Return the matches as a lens with OpenCV's k1 sees them."""
    moved = []
    sizes = (matched.full_size1, matched.size1), (matched.full_size2, matched.size2)
    for frame, points, (full, size) in zip(frames, (matched.points1, matched.points2), sizes, strict=True):
        K = scaling(full, size) @ torch.from_numpy(frame.K)
        offset = points - K[:2, 2]
        moved.append(K[:2, 2] + offset * (1 + k1 * (offset / K.diagonal()[:2]).square().sum(-1, keepdim=True)))
    return replace(matched, points1=moved[0], points2=moved[1])


def error_of_pose(pair: Pair, F_mat: Tensor, points1: Tensor, points2: Tensor) -> float:
    """Return the larger error of rotation and translation, degrees; infinite without a matrix or pose."""
    near = kln.symmetric_epipolar_distance(points1, points2, F_mat) < THRESHOLD
    if int(near.sum()) == 0:
        return math.inf
    K1, K2 = pair.K
    R, t = kln.relative_pose(F_mat[None], K1[None], K2[None], points1[near][None], points2[near][None])
    true_R, true_t = (torch.from_numpy(value)[None] for value in pair.frames.motion)
    return pose_error(R, t, true_R, true_t).nan_to_num(nan=math.inf).item()


def true_error(pair: Pair, found: PairEstimate) -> float:
    """Return the median distance of the inliers to F, each moved to the true epipolar line of its point in image 1."""
    points1, points2 = (points[found.inliers][None] for points in (found.points1, found.points2))
    exact = get_closest_point_on_epipolar_line(points1, points2, torch.from_numpy(pair.frames.F)[None])
    return kln.symmetric_epipolar_distance(points1, exact, found.matrix[None]).median().item()


def run_own(pair: Pair, solve: Callable[..., PairEstimate]) -> tuple[Record, PairEstimate | None]:
    """Return the record of an estimate of this package, and the estimate where there is one."""
    try:
        found = solve(**pair.cameras)
    except kln.NoReliableMatrixError as error:
        return {"refused": error.code, "error": math.inf, "warnings": [error.code]}, None
    record = {
        "refused": None,
        "model": found.model,
        "error": math.inf,
        "warnings": [warning.code for warning in found.warnings],
        "inliers": found.num_inliers,
        "matches": found.num_matches,
        "predicted": found.predicted_error,
    }
    if found.model == "fundamental":
        record["error"] = error_of_pose(pair, found.matrix, found.points1, found.points2)
        record["true"] = true_error(pair, found)
    elif found.R is not None and found.t is not None:
        record["error"] = pose_error(found.R, found.t, *map(torch.from_numpy, pair.frames.motion)).item()
    return record, found


def run_others(pair: Pair, peers: dict[str, Any], size: Tensor, *matches: Tensor) -> dict[str, float]:
    """Return the pose errors of RANSAC and other packages on matches."""
    points1, points2, scores = matches
    found = kln.RANSAC(inl_th=THRESHOLD, seed=0).estimate(points1, points2, scores.clamp(min=1e-3), **pair.cameras)
    errors = {"RANSAC": error_of_pose(pair, found.F_mat, points1, points2)}
    cameras = [torch.stack(pair.K).numpy()] if pair.calibrated else []
    for name, estimate in peers.items():
        try:
            F = estimate(points1.numpy(), points2.numpy(), size.numpy(), 0, THRESHOLD, *cameras)
        except Exception as error:  # OpenCV raises its own for too few matches
            print(f"{name}: {error}", file=sys.stderr)
            F = None
        known = F is not None and np.shape(F) == (3, 3) and np.isfinite(F).all()
        errors[name] = error_of_pose(pair, torch.from_numpy(np.array(F)), points1, points2) if known else math.inf
    return errors


def measure(pair: Pair, peers: dict[str, Any], sizes: Sequence[int]) -> list[Record]:
    """Return the records of all matches and of random subsets of them, with their number as `size`, 0 for all."""
    own, found = run_own(pair, pair.matched.estimate)
    base = {"dataset": pair.dataset, "method": pair.method, "pair": pair.number, "calibrated": pair.calibrated}
    if found is None:
        return [{**base, "size": 0, OWN: own}]
    pixels = torch.tensor([found.size1, found.size2], dtype=torch.int32)
    matches = (found.points1, found.points2, found.scores)
    records = [{**base, "size": 0, OWN: own, **run_others(pair, peers, pixels, *matches)}]
    order = torch.randperm(found.num_matches, generator=torch.Generator().manual_seed(pair.number))
    for size in sizes:
        if 0 < size < found.num_matches:
            chosen = tuple(value[order[:size]] for value in matches)

            def solve(chosen: tuple[Tensor, ...] = chosen, **cameras: Tensor) -> PairEstimate:
                return kln.estimate_matches(*chosen, found.size1, found.size2, **cameras)

            records.append(
                {**base, "size": size, OWN: run_own(pair, solve)[0], **run_others(pair, peers, pixels, *chosen)}
            )
    return records


def error_of(record: Record, name: str) -> float:
    """Return the pose error of an estimator in a record; infinite where there is none."""
    return float(record[OWN]["error"] if name == OWN else record.get(name, math.inf))


def pair_table(records: Sequence[Record]) -> str:
    """Return a row for each pair: errors, inliers, predicted error and warnings."""
    rows = []
    for record in records:
        own, cells = record[OWN], ["-"] * 4
        numbers = [f"{error_of(record, name):.2f}" for name in (OWN, "RANSAC")]
        if not own["refused"]:
            cells = [own["model"], f"{own['inliers']} of {own['matches']}", f"{own['predicted']:.2f}"]
            cells += [f"{own['true']:.2f}" if "true" in own else "-"]
        rows.append([str(record["pair"]), *numbers, *cells, ", ".join(own["warnings"]) or "none"])
    header = ["pair", f"{OWN}: degrees", "RANSAC: degrees", "model", "inliers", "predicted px", "true px", "warnings"]
    return format_table(header, rows)


def is_silent(record: Record, name: str) -> bool:
    """Return whether an answer is wrong without a warning; only this package's estimate can warn or choose H."""
    own = record[OWN]
    told = own["warnings"] or (own["model"] == "homography" and not record["calibrated"])
    return error_of(record, name) > MAX_POSE_ERROR and not (name == OWN and told)


def summary_rows(records: Sequence[Record], names: Sequence[str], label: Sequence[str]) -> list[list[str]]:
    """Return a row for each estimator."""
    rows = []
    reference = np.array([error_of(record, "RANSAC") for record in records])
    for name in names:
        errors = np.array([error_of(record, name) for record in records])
        numbers = [f"{value:.2f}" for value in (np.median(errors), errors.max())]
        near = str(int(((errors <= MAX_RATIO * reference) & np.isfinite(errors)).sum()))
        silent = str(sum(is_silent(record, name) for record in records))
        own = own_cells(records) if name == OWN else ["-"] * 5
        rows.append([*label, PEERS.get(name, name), str(len(records)), *numbers, near, silent, *own])
    return rows


def own_cells(records: Sequence[Record]) -> list[str]:
    """Return how many answers are flagged, how many are F, and quantiles of their predicted over their true error."""
    own = [record[OWN] for record in records]
    ratios = [record["predicted"] / record["true"] for record in own if "true" in record]
    quantiles = [f"{value:.2f}" for value in np.quantile(ratios, [0.1, 0.5, 0.9])] if ratios else ["-"] * 3
    return [str(sum(bool(record["warnings"]) for record in own)), str(len(ratios)), *quantiles]


def subset_rows(records: Sequence[Record], names: Sequence[str], label: Sequence[str]) -> list[list[str]]:
    """Return a row for each estimator: for each size the median error and the number of silently wrong answers."""
    drawn = {record["pair"] for record in records if record["size"]}
    groups = [[r for r in records if r["size"] == size and r["pair"] in drawn] for size in SIZES]
    rows = []
    for name in names if drawn else ():
        cells = [
            f"{np.median([error_of(r, name) for r in group]):.2f} ({sum(is_silent(r, name) for r in group)})"
            if group
            else "-"
            for group in groups
        ]
        rows.append([*label, PEERS.get(name, name), *cells])
    if drawn:
        flagged = [f"{sum(bool(r[OWN]['warnings']) for r in group)} of {len(group)}" for group in groups]
        rows.insert(1, [*label, f"{OWN}: flagged", *flagged])
    return rows


def print_tables(records: Sequence[Record], peers: Sequence[str], csv: str | None) -> None:
    """Print a table of pairs for each dataset, then the summary, which is also written, and the subsets."""
    names = [OWN, "RANSAC", *peers]
    summary: list[list[str]] = []
    subsets: list[list[str]] = []
    label = ["set", "matches", "cameras", "estimator"]
    for key in dict.fromkeys((r["dataset"], r["method"], r["calibrated"]) for r in records):
        mine = [r for r in records if (r["dataset"], r["method"], r["calibrated"]) == key]
        whole = [record for record in mine if record["size"] == 0]
        cells = [*key[:2], "with" if key[2] else "without"]
        print(f"{', '.join(cells)} cameras\n\n{pair_table(whole)}\n")
        summary += summary_rows(whole, names, cells)
        subsets += subset_rows(mine, names, cells)
    counts = ["pairs", "median degrees", "largest", f"within {MAX_RATIO:g} times RANSAC", "silently wrong"]
    counts += ["flagged", "F", *(f"predicted / true: {share} %" for share in (10, 50, 90))]
    print("Summary\n\n" + format_table([*label, *counts], summary))
    write_csv(csv, [[*label, *counts], *summary])
    if subsets:
        sizes = [f"{size or 'all'} matches" for size in SIZES]
        print("\nSubsets: median degrees (silently wrong)\n")
        print(format_table([*label, *sizes], subsets))


def main(args: Sequence[str] | None = None) -> None:
    """Estimate the pairs, print the tables and write the numbers."""
    files = {"json": "write a record of every pair to this file", "csv": "write the summary to this file"}
    parser = make_parser(__doc__, **files)
    parser.add_argument("data", type=Path, help="folder with tum/, kitti/ and images/photographs/")
    parser.add_argument("--datasets", nargs="+", choices=[*DATASETS, PHOTOGRAPHS], default=[*DATASETS, PHOTOGRAPHS])
    parser.add_argument("--methods", nargs="+", default=["sift+nearest"], help="DETECTOR+MATCHER")
    parser.add_argument("--pairs", type=int, default=50, help="first pairs of each set")
    parser.add_argument("--every", type=int, default=4, help="subsets are drawn of each so many-th pair; 0 for none")
    parser.add_argument("--focal", type=float, default=1.0, help="factor of the focal lengths given")
    parser.add_argument("--k1", type=float, default=0.0, help="radial distortion of the matches")
    options = parser.parse_args(args)
    peers = {name: {} for name in PEERS}
    for name in PEERS:
        try:
            peers[name] = {False: find_peer(name), True: find_peer(name + CALIBRATED)}
        except ImportError as error:
            print(error, file=sys.stderr)
            del peers[name]
    records: list[Record] = []
    for dataset, method in product(options.datasets, options.methods):
        for number, frames in enumerate(read_pairs(dataset, options.data)[: options.pairs]):
            detector, matcher = method.split("+")
            matched = match_two_images(*(frame.path for frame in frames), detector=detector, matcher=matcher)
            matched = distort(matched, frames, options.k1)
            sizes = SIZES if options.every and number % options.every == 0 else ()
            for calibrated in (False, True) if (options.focal, options.k1) == (1, 0) else (True,):
                solvers = {name: solver[calibrated] for name, solver in peers.items()}
                pair = Pair(dataset, number, frames, calibrated, method, matched, options.focal)
                records += measure(pair, solvers, sizes)
            print(f"{dataset} {method} {number}", file=sys.stderr, flush=True)
    print_tables(records, [*peers], options.csv)
    write_json(options.json, records)


if __name__ == "__main__":
    main()

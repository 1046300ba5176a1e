"""Compare detectors and matchers by the relative pose of image pairs, as learnnorm estimate finds it.

The pose error is the larger of the angles of rotation and translation; pairs without a pose count as failures. The pose
is that of F, of its inliers and of the true cameras, or with cameras that of the estimate. Table: AUC up to 5, 10 and
20 degrees, %, and median number of inliers, without cameras.

    python benchmarks/detectors.py FOLDER [--methods DETECTOR+MATCHER[+PASSES] ...] [--gap 3] [--csv FILE]

The folder, such as $LEARNNORM_DATA/images/photographs, has a file cameras.json: for each image K and camera_to_world.
With PASSES, as --refine has them, matches are moved to sub-pixel accuracy first.
"""

import math
from pathlib import Path

import torch
from shared import auc_cells, make_parser, photograph_pairs, write_csv

import kornia_learnnorm as kln
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view.estimate_pair import MatchedPair, match_two_images

HEADER = ["detector", "matcher", "refine", "AUC 5", "10", "20", "with cameras: AUC 5", "10", "20", "inliers"]
METHODS = ["sift+nearest", "sift+nearest+1", "aliked+lightglue", "aliked+lightglue+1"]
METHODS += ["xfeat+lightglue", "xfeat+lightglue+2"]


def estimate(matched: MatchedPair, pair: FramePair, calibrated: bool) -> tuple[float, int]:
    """Return the error of the pose, degrees, and the number of inliers."""
    K1, K2 = (torch.from_numpy(frame.K) for frame in pair)
    try:
        found = matched.estimate(K1=K1, K2=K2) if calibrated else matched.estimate()
    except kln.NoReliableMatrixError:
        return math.inf, 0
    R, t = found.R, found.t
    if found.model == "fundamental" and not calibrated:
        points = (points[None, found.inliers] for points in (found.points1, found.points2))
        R, t = (value[0] for value in kln.relative_pose(found.matrix[None], K1[None], K2[None], *points))
    error = math.inf if R is None or t is None else pose_error(R, t, *map(torch.from_numpy, pair.motion)).item()
    return error, found.num_inliers


def measure(folder: Path, detector: str, matcher: str, passes: int, gap: int) -> list[str]:
    """Return the row of a detector and a matcher, of pairs of images of a folder that are so far apart."""
    refiner = kln.MatchRefiner.from_pretrained() if passes else None
    if refiner is not None:
        refiner.passes = passes
    found = []
    for pair in photograph_pairs(folder, [gap]):
        paths = (frame.path for frame in pair)
        matched = match_two_images(*paths, detector=detector, matcher=matcher, refiner=refiner)
        found.append([estimate(matched, pair, calibrated) for calibrated in (False, True)])
    errors, inliers = torch.tensor(found).double().unbind(-1)
    cells = [cell for column in errors.unbind(1) for cell in auc_cells(column)]
    return [detector, matcher, str(passes), *cells, f"{int(inliers[:, 0].median())}"]


def main() -> None:
    parser = make_parser(__doc__, csv="write the table to this file")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--gap", type=int, default=3, help="images apart (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for method in args.methods:
        detector, matcher, *passes = method.split("+")
        rows.append(measure(args.folder, detector, matcher, int(*passes or "0"), args.gap))
        print(*rows[-1], flush=True)
    print(format_table(HEADER, rows))
    write_csv(args.csv, [HEADER, *rows])


if __name__ == "__main__":
    main()

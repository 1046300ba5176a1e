"""Compare detectors and matchers by the relative pose of image pairs, as learnnorm estimate finds it with cameras.

The pose error is the larger of the angles of rotation and translation; pairs without a matrix count as failures. Table:
AUC up to 5, 10 and 20 degrees, %, and median number of inliers.

    python benchmarks/detectors.py FOLDER [--methods DETECTOR+MATCHER ...] [--gap 3] [--csv FILE]

The folder, such as $LEARNNORM_DATA/images/photographs, has a file cameras.json: for each image K and camera_to_world.
"""

import math
from pathlib import Path

import torch
from shared import auc_cells, make_parser, photograph_pairs, write_csv

from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.two_view.estimate_pair import estimate_pair
from kornia_learnnorm.two_view.result import NoReliableMatrixError

HEADER = ["detector", "matcher", "AUC 5", "10", "20", "inliers"]
METHODS = [f"{detector}+nearest" for detector in ("sift", "rootsift", "xfeat", "disk", "aliked")]
METHODS += [f"{detector}+lightglue" for detector in ("xfeat", "disk", "aliked")]


def measure(folder: Path, detector: str, matcher: str, gap: int) -> list[str]:
    """Return the row of a detector and a matcher, of pairs of images of a folder that are so far apart."""
    errors, inliers = [], []
    for pair in photograph_pairs(folder, [gap]):
        K = dict(zip(("K1", "K2"), (torch.from_numpy(frame.K) for frame in pair), strict=True))
        error = math.inf
        try:
            found = estimate_pair(*(frame.path for frame in pair), **K, detector=detector, matcher=matcher)
            inliers.append(found.num_inliers)
            if found.R is not None and found.t is not None:
                error = pose_error(found.R, found.t, *map(torch.from_numpy, pair.motion)).item()
        except NoReliableMatrixError:
            inliers.append(0)
        errors.append(error)
    return [detector, matcher, *auc_cells(errors), f"{torch.tensor(inliers).median().item()}"]


def main() -> None:
    parser = make_parser(__doc__, csv="write the table to this file")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--gap", type=int, default=3, help="images apart (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for method in args.methods:
        rows.append(measure(args.folder, *method.split("+"), args.gap))
        print(*rows[-1], flush=True)
    print(format_table(HEADER, rows))
    write_csv(args.csv, [HEADER, *rows])


if __name__ == "__main__":
    main()

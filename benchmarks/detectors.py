"""Compare detectors and matchers by the relative pose of image pairs, as learnnorm estimate finds it with cameras.

The pose error is the larger of the angles of rotation and translation; pairs without a matrix count as failures. Table:
AUC up to 5, 10 and 20 degrees, %, and median number of inliers.

    python benchmarks/detectors.py FOLDER [--methods DETECTOR+MATCHER ...] [--gap 3] [--csv FILE]

The folder, such as $LEARNNORM_DATA/images/photographs, has a file cameras.json: for each image K and camera_to_world.
"""

import argparse
import json
import math
from pathlib import Path

import torch
from results_file import write_csv

from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.metrics.poses import pose_auc, pose_error
from kornia_learnnorm.two_view.estimate_pair import estimate_pair
from kornia_learnnorm.two_view.result import NoReliableMatrixError

HEADER = ["detector", "matcher", "AUC 5", "10", "20", "inliers"]
METHODS = [f"{detector}+nearest" for detector in ("sift", "rootsift", "xfeat", "disk", "aliked")]
METHODS += [f"{detector}+lightglue" for detector in ("xfeat", "disk", "aliked")]


def measure(folder: Path, detector: str, matcher: str, gap: int) -> list[str]:
    """Return the row of a detector and a matcher, of pairs of images of a folder that are so far apart."""
    cameras = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))
    K, poses = (
        {name: torch.tensor(camera[key]).double() for name, camera in cameras.items()}
        for key in ("K", "camera_to_world")
    )
    names = [
        sorted(name for name in cameras if name.startswith(place))
        for place in sorted({name.split("/")[0] for name in K})
    ]
    errors, inliers = [], []
    for name1, name2 in [pair for part in names for pair in zip(part, part[gap:], strict=False)]:
        motion = torch.linalg.solve(poses[name2], poses[name1])
        error = math.inf
        try:
            images = folder / name1, folder / name2
            found = estimate_pair(*images, K1=K[name1], K2=K[name2], detector=detector, matcher=matcher)
            inliers.append(found.num_inliers)
            if found.R is not None and found.t is not None:
                error = pose_error(found.R, found.t, motion[:3, :3], motion[:3, 3]).item()
        except NoReliableMatrixError:
            inliers.append(0)
        errors.append(error)
    auc = [f"{100 * share:.1f}" for share in pose_auc(torch.tensor(errors).double())]
    return [detector, matcher, *auc, f"{torch.tensor(inliers).median().item()}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--gap", type=int, default=3, help="images apart (default: %(default)s)")
    parser.add_argument("--csv", help="write the table to this file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for method in args.methods:
        rows.append(measure(args.folder, *method.split("+"), args.gap))
        print(*rows[-1], flush=True)
    print(format_table(HEADER, rows))
    if args.csv:
        write_csv(args.csv, [HEADER, *rows])


if __name__ == "__main__":
    main()

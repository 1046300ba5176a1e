"""Measure the weights of examples/finetune_lightglue.py by the pose of image pairs with known cameras.

The weights are trained without labels on the images of folders. The table has the example's loss on held-out pairs, and
the area under the curve of the pose error up to 5, 10 and 20 degrees, %, on the test pairs, which are one and three
images apart, of LearnedEightPoint and of RANSAC (three seeds). RANSAC draws by score times weight.

    python benchmarks/match_weights.py FOLDER [FOLDER ...] --test FOLDER [--steps 300] [--csv FILE]

The folder of the test, such as $LEARNNORM_DATA/images/photographs, has a file cameras.json: for each image K and
camera_to_world.
"""

import sys
from pathlib import Path

import torch
from torch import nn

import kornia_learnnorm as kln
from kornia_learnnorm.data.images import read_colour
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import pose_error

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import finetune_lightglue as example
from shared import auc_cells, make_parser, photograph_pairs, write_csv

HEADER = ["matches", "log px, held out", "layer AUC 5", "10", "20", "RANSAC AUC 5", "10", "20"]
SEEDS = 3


def read_test(lightglue: nn.Module, folder: Path) -> list[example.Pair]:
    """Match the image pairs of a folder with cameras and poses."""
    pairs = []
    for pair in photograph_pairs(folder, (1, 3)):
        truth = tuple(map(torch.from_numpy, (pair.frame1.K, pair.frame2.K, *pair.motion)))
        images = [read_colour(frame.path, 1024) for frame in pair]
        pairs.append(example.match(lightglue, example.features(images, 2000), truth))
    return pairs


@torch.no_grad()
def pose_shares(layer: nn.Module, weigh: nn.Module | None, pairs: list[example.Pair]) -> list[str]:
    """Return the AUC of the layer and of RANSAC; None for neither weights nor scores."""
    errors: tuple[list[torch.Tensor], list[torch.Tensor]] = ([], [])
    for pair in pairs:
        K1, K2, R, t = pair.truth
        x1, x2 = pair.points.split(2, 1)
        given: dict[str, torch.Tensor] = {}
        if weigh is not None:
            given = {"scores": pair.scores[None].double(), "weights": weigh(pair)[None]}
        order = given["scores"][0] * given["weights"][0] if given else None
        found = [layer.estimate(x1[None], x2[None], **given).F_mat]
        found += [kln.RANSAC(seed=seed)(x1, x2, order)[0][None] for seed in range(SEEDS)]
        for place, F_mat in enumerate(found):
            near = kln.symmetric_epipolar_distance(x1[None], x2[None], F_mat) < 1
            pose = relative_pose(F_mat, K1[None], K2[None], x1[None], x2[None], near)
            errors[place > 0].append(pose_error(*pose, R[None], t[None]))
    return [cell for found in errors for cell in auc_cells(torch.cat(found))]


def main() -> None:
    parser = make_parser(__doc__, csv="write the table to this file")
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=300)
    args = parser.parse_args()
    torch.set_num_threads(1)
    layer, lightglue = example.pretrained()
    pairs, test = example.read_pairs(lightglue, args.folders), read_test(lightglue, args.test)
    held_out, training = pairs[::6], [pair for i, pair in enumerate(pairs) if i % 6]
    print(f"{len(training)} pairs to train on, {len(held_out)} held out, {len(test)} of the test", flush=True)
    torch.manual_seed(0)
    weigh = example.MatchWeights()

    def row(name: str) -> list[str]:
        return [name, f"{example.held_out_loss(layer, weigh, held_out):.3f}", *pose_shares(layer, weigh, test)]

    rows = [["without scores", "", *pose_shares(layer, None, test)], row("LightGlue's scores")]
    example.train(layer, weigh, training, args.steps)
    rows.append(row("scores and trained weights"))
    print(format_table(HEADER, rows))
    write_csv(args.csv, [HEADER, *rows])


if __name__ == "__main__":
    main()
